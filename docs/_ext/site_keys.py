"""Lists every key of a command: `{config-keys} train`. A key without a meaning fails the build."""

import inspect
import re
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

from swarmjax.config import section
from swarmjax.config.section import KeyLine, Section
from swarmjax.shell import commands

_LOG = logging.getLogger(__name__)
_ROOT = Path(__file__).resolve().parents[2]


class ConfigKeys(SphinxDirective):
    """The keys of a command, a table for each section."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Makes the tables."""
        name = self.arguments[0]
        cls = commands.settings(name)
        for path, line, key in undocumented(cls):
            where = f"{path.relative_to(_ROOT)}:{line}"
            _LOG.warning("the key %s has no meaning", key, location=where, type="site")
        return self.parse_text_to_nodes(_page(name, cls), allow_section_headings=True)


def undocumented(cls: type[Section]) -> list[tuple[Path, int, str]]:
    """Finds keys that nothing is said about.

    Args:
      cls: a command's settings.

    Returns:
      File and line of each field, and its key.
    """
    silent = [line.key for line in section.list_keys(cls) if not line.meaning.strip()]
    return [(*_place(cls, key), key) for key in silent]


def _place(cls: type[Section], key: str) -> tuple[Path, int]:
    """Finds where a key's field is defined."""
    *outer, name = key.split(".")
    for part in outer:
        cls = section.sections(cls)[part]
    owner = next(each for each in cls.__mro__ if name in vars(each).get("__annotations__", {}))
    lines, first = inspect.getsourcelines(owner)
    at = next(i for i, line in enumerate(lines) if re.match(rf"\s+{name}\s*:", line))
    return Path(inspect.getsourcefile(owner) or ""), first + at


def _page(name: str, cls: type[Section]) -> str:
    """Writes the tables as MyST."""
    groups: dict[str, list[KeyLine]] = {}
    for line in section.list_keys(cls):
        head, dot, _ = line.key.partition(".")
        groups.setdefault(head if dot else "", []).append(line)
    parts = [f"## {name}", f"`swarmjax {name} key=value ...`: {commands.COMMANDS[name].meaning}"]
    for head, lines in groups.items():
        parts += [*([f"### {name}: {head}"] if head else []), _table(lines)]
    return "\n\n".join(parts)


def _table(lines: list[KeyLine]) -> str:
    rows = [
        f"| `{line.key}` | {_cell(line.meaning)} | {_cell(line.allowed)} | {_code(line.default)} |"
        for line in lines
    ]
    return "\n".join(["| key | meaning | allowed | default |", "|---|---|---|---|", *rows])


def _cell(text: str) -> str:
    """Writes text that has no markup into a cell of a table."""
    return re.sub(r"([\\`*_\[\]<>|$])", r"\\\1", text)


def _code(default: str) -> str:
    return _cell(default) if default.startswith("<") else f"`{default}`".replace("|", "\\|")


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the directive."""
    app.add_directive("config-keys", ConfigKeys)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
