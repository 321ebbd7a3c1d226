"""Docstrings: an indented example becomes a block of code, a property's colon stays a colon."""

import re
from typing import Any

from sphinx.application import Sphinx

_HEADER = re.compile(r"(Args|Attributes|Raises|Returns|Yields):")


def _mark(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Puts `::` before each indented block above the first header of a docstring."""
    found: list[str] = []
    headed = False
    for number, line in enumerate(lines):
        headed = headed or bool(_HEADER.match(line))
        begins = line.startswith("    ") and number > 1 and not lines[number - 1].strip()
        above = lines[number - 2] if number > 1 else ""
        line = re.sub(r"\[\*(?=\w)", r"[\\*", line)  # [*shape] is no emphasis
        if begins and not headed and not above.startswith(" "):
            found += ["::", ""]
        found.append(line)
    lines[:] = found


class _Kept:
    """Lines of a property, which napoleon would split into a type and a text at the first colon."""

    lines: list[str]

    def keep(self, app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: Any) -> None:
        """Remembers what is written."""
        self.lines = list(lines)

    def put_back(
        self, app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
    ) -> None:
        """Puts it back."""
        if what == "property":
            lines[:] = self.lines


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the extension, around napoleon."""
    kept = _Kept()
    app.connect("autodoc-process-docstring", _mark, priority=400)
    app.connect("autodoc-process-docstring", kept.keep, priority=410)
    app.connect("autodoc-process-docstring", kept.put_back, priority=600)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
