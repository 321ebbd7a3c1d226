"""The page that follows a run: what stands still on it, and its script."""

from html import escape
from importlib import resources
from pathlib import Path
from string import Template

from swarmjax.replay.page import source_hash
from swarmjax.report.page import STYLE
from swarmjax.watch.view import NAMES


def page(run: Path) -> str:
    """Lays the page out.

    A policy of what it may load or run stands in it: its own style and script, by their digests,
    and pictures, a frame and data of its own server.

    Args:
        run: that it follows.

    Returns:
        HTML in which the run's name is escaped. All else of the run comes as data, which the script
        puts there as text.
    """
    files = resources.files("swarmjax.watch") / "templates"
    style = STYLE + (files / "watch.css").read_text(encoding="utf-8")
    script = (files / "watch.js").read_text(encoding="utf-8")
    own = "img-src 'self' data:; connect-src 'self'; frame-src 'self'; "
    allowed = f"style-src {source_hash(style)}; script-src {source_hash(script)}; {own}"
    return Template((files / "watch.html").read_text(encoding="utf-8")).substitute(
        title=f"Watching {escape(str(run))}",
        policy=f"default-src 'none'; {allowed}base-uri 'none'; form-action 'none'",
        style=style,
        script=script,
        figures="".join(_figure(*each) for each in NAMES.items()),
    )


def _figure(name: str, text: str) -> str:
    """Makes room for a figure."""
    return f'<figure id="{name}" hidden><img alt="{escape(text)}"></figure>\n'
