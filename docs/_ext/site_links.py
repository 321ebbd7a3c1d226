"""Links of pages outside the site, and paths of the repository in any page, lead somewhere."""

import re
from collections.abc import Iterator
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.util import logging

_LOG = logging.getLogger(__name__)
_ROOT = Path(__file__).resolve().parents[2]
_OUTSIDE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
_HISTORY = "CHANGELOG.md"  # names files that are gone
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_ABOVE = re.compile(r"\[([^\]]+)\]\(\.\./([\w/]+\.md)\)")  # in a page of docs/ itself
# A path in backticks, which no capital stands for something else in.
_PATH = re.compile(
    r"`((?:configs|examples|benchmarks|launch|swarmjax|tests|docs|typings|\.ci)/[a-z0-9_./-]+)`"
)


def dead(page: Path) -> Iterator[tuple[int, str]]:
    """Finds links and paths of a page that lead nowhere.

    Args:
      page: a Markdown file.

    Yields:
      A line's number from 1, and what it leads to.
    """
    for number, line in enumerate(_without_code(page.read_text()), 1):
        for target in _LINK.findall(line):
            if not _leads_somewhere(page, target):
                yield number, target
        for path in [] if page.name == _HISTORY else _PATH.findall(line):
            if not (_ROOT / path).exists():
                yield number, path


def _without_code(text: str) -> list[str]:
    """Empties the lines of fenced blocks."""
    found, inside = [], False
    for line in text.splitlines():
        fence = line.lstrip().startswith("```")
        found.append("" if inside or fence else line)
        inside ^= fence
    return found


def _leads_somewhere(page: Path, target: str) -> bool:
    if re.match(r"[a-z]+:", target):
        return True
    path, _, anchor = target.partition("#")
    file = page.parent / path if path else page
    return file.exists() and (not anchor or anchor in _anchors(file))


def _anchors(page: Path) -> set[str]:
    """Lists the anchors of a page's headings as GitHub makes them."""
    heads = re.findall(r"^#+ +(.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


def _check(app: Sphinx) -> None:
    pages = [_ROOT / name for name in _OUTSIDE]
    for page in [*pages, *sorted(Path(app.srcdir).rglob("*.md"))]:
        if "_build" in page.parts:
            continue
        for number, target in dead(page):
            where = f"{page.relative_to(_ROOT)}:{number}"
            _LOG.warning("dead link: %s", target, location=where, type="site", subtype="link")


def _bring_in(app: Sphinx, page: str, source: list[str]) -> None:
    """Turns links to Markdown outside the site into links to its page here, or to the file."""
    if "/" in page:
        return
    here = Path(app.srcdir)

    def replaced(link: re.Match[str]) -> str:
        inside = (here / link[2]).exists()
        return f"[{link[1]}]({link[2]})" if inside else f"{{download}}`{link[1]} <../{link[2]}>`"

    source[0] = _ABOVE.sub(replaced, source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the extension."""
    app.connect("builder-inited", _check)
    app.connect("source-read", _bring_in)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
