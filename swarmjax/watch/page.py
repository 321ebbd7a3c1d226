"""Builds the page that follows a run: its static parts and its script."""

from pathlib import Path

from swarmjax.pages import builder
from swarmjax.watch.view import NAMES

# The page may load only from its own server: the requests of its script, and the replay's frame.
_SOURCES = {"img-src": "'self' data:", "connect-src": "'self'", "frame-src": "'self'"}


def page(run: Path) -> str:
    """Builds the page.

    Args:
      run: the run to follow.

    Returns:
      HTML with the run's name escaped. Everything else about the run arrives as data, which the
      script inserts as text.
    """
    return builder.render(
        "watch/watch.html",
        styles=(builder.STYLE, "watch/watch.css"),
        script=builder.read("watch/watch.js"),
        sources=_SOURCES,
        title=f"Watching {run}",
        figures=NAMES,
    )
