"""Writes the first tutorial as a notebook: `python docs/_ext/site_notebook.py`."""

import json
import re
import sys
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = _ROOT / "docs" / "tutorials" / "first-swarm.md"
NOTEBOOK = _ROOT / "examples" / "first_swarm.ipynb"
_CELL = re.compile(r"```\{code-cell\} ipython3\n(.*?)```\n(?:\n```text\n(.*?)```\n)?", re.DOTALL)
# Jupyter asks commands for colours, and progress would be drawn again and again.
_FIRST = "%env TTY_COMPATIBLE=0"


def cells(page: str) -> list[tuple[str, str, str]]:
    """Takes a tutorial apart.

    Args:
      page: its text.

    Returns:
      Kind, `markdown` or `code`, source, and what is stored of its output, of each cell.
    """
    parts = _CELL.split(page.split("---\n", 2)[2])
    found = [("markdown", _source("markdown", part), "") for part in parts[::3]]
    code = zip(parts[1::3], parts[2::3], strict=True)
    for place, (source, printed) in enumerate(code):
        found.insert(2 * place + 1, ("code", _source("code", source), printed or ""))
    found = [cell for cell in found if cell[1]]
    return [found[0], ("code", _FIRST, ""), *found[1:]]


def _source(kind: str, part: str) -> str:
    if kind == "code":
        return re.sub(r"^:\w+:.*\n", "", part, flags=re.MULTILINE).strip()
    linked = re.sub(r"\]\(\.\./", "](../docs/", part)
    return re.sub(r"\]\(([\w-]+\.md)", r"](../docs/tutorials/\1", linked).strip()


def notebook(page: str) -> dict[str, Any]:
    """Makes a notebook of a tutorial, with the texts that its cells printed.

    Args:
      page: its text.

    Returns:
      The notebook, format 4.5.
    """
    every = []
    for number, (kind, source, printed) in enumerate(cells(page)):
        cell = {"cell_type": kind, "id": f"cell-{number}", "metadata": {}}
        cell["source"] = source.splitlines(keepends=True)
        stream = {"name": "stdout", "output_type": "stream"}
        outputs = [stream | {"text": printed.splitlines(keepends=True)}] if printed else []
        every.append(
            cell | ({"execution_count": None, "outputs": outputs} if kind == "code" else {})
        )
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": every, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}


def text(page: str) -> str:
    """Writes the notebook of a tutorial as it is stored."""
    return json.dumps(notebook(page), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    NOTEBOOK.write_text(text(TUTORIAL.read_text()))
    sys.stdout.write(f"{NOTEBOOK.relative_to(_ROOT)}\n")
