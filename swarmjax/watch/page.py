"""The page that follows a run: what stands still on it, and its script."""

from pathlib import Path

from swarmjax.pages import builder
from swarmjax.watch.view import NAMES

# Of its own server: what its script asks for, and the frame of a replay.
_SOURCES = {"img-src": "'self' data:", "connect-src": "'self'", "frame-src": "'self'"}


def page(run: Path) -> str:
    """Lays the page out.

    Args:
      run: that it follows.

    Returns:
      HTML in which the run's name is escaped. All else of the run comes as data, which the script
      puts there as text.
    """
    return builder.render(
        "watch/watch.html",
        styles=(builder.STYLE, "watch/watch.css"),
        script=builder.read("watch/watch.js"),
        sources=_SOURCES,
        title=f"Watching {run}",
        figures=NAMES,
    )
