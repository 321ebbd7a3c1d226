"""Cells of notebooks: shell reads as shell, a file as a file; a failure names file and line.

A page keeps what each cell printed or drew in a block `text` or an image below the cell, for who
reads it unbuilt. The build shows what the cell prints now instead, and compares: names and lines
must be the same, numbers need not. Three dots stand for what was left out.
"""

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from nbclient import NotebookClient
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util import logging

_LOG = logging.getLogger(__name__)
_SHELL = "%%bash\n"
_FILE = "%%writefile "
_NUMBER = re.compile(r"(?:\d+ (?:h|min) )*-?\d[\d,.]*(?:e-?\d+)?")
_DRAWN = {"image/png", "text/html"}
_LANGUAGES = {".yaml": "yaml", ".py": "python", ".c": "c"}


def _is_cell(node: nodes.Node) -> bool:
    return isinstance(node, nodes.container) and node.get("nb_element") == "cell_code"


def _tidy(app: Sphinx, document: nodes.document) -> None:
    """Reports failed cells, and takes the magic words off the others."""
    for cell in list(document.findall(_is_cell)):
        _compare(app, cell)
        for block in list(cell.findall(nodes.literal_block)):
            if "traceback" in block["classes"]:
                _report(app, cell, block)
            elif block.rawsource.startswith(_SHELL):
                _rewrite(block, block.rawsource.removeprefix(_SHELL), "bash")
            elif block.rawsource.startswith(_FILE):
                _as_file(cell, block)


def agrees(stored: str, printed: str) -> bool:
    """Tells whether two outputs differ in numbers and spaces only.

    Args:
      stored: what the page keeps. Three dots stand for anything.
      printed: what the cell printed.
    """
    parts = [re.escape(_shape(part)) for part in re.split(r"\n?\.\.\.\n?", stored)]
    return re.fullmatch(".*".join(parts), _shape(printed), re.DOTALL) is not None


def _shape(text: str) -> str:
    return re.sub(r"[ \t]+", "", _NUMBER.sub("#", text)).strip()


def _compare(app: Sphinx, cell: Any) -> None:
    """Takes the stored output off the page, and warns if it is not that of the cell."""
    outputs = list(cell.findall(_is_output))
    if not outputs or cell.astext().startswith(_FILE):
        return
    stored = cell.next_node(descend=False, siblings=True)
    blocks = [block for output in outputs for block in output.findall(nodes.literal_block)]
    printed = "\n".join(block.astext() for block in blocks)
    if any(node.get("mime_type") in _DRAWN for node in cell.findall(nodes.container)):
        fits = isinstance(stored, nodes.paragraph) and isinstance(stored[0], nodes.image)
    else:
        is_text = isinstance(stored, nodes.literal_block) and stored["language"] == "text"
        fits = is_text and agrees(stored.astext(), printed)
    if fits:
        stored.parent.remove(stored)
        return
    where = (app.env.docname, cell.line)
    _LOG.warning("below the cell stands no such output: %s", printed, location=where, type="site")


def _report(app: Sphinx, cell: Any, block: nodes.literal_block) -> None:
    """Warns of a failed cell, with its line and the last line of its error."""
    last = block.astext().strip().splitlines()[-1]
    where = (app.env.docname, cell.line)
    _LOG.warning("a cell failed: %s", last, location=where, type="site", subtype="cell")


def _as_file(cell: Any, block: nodes.literal_block) -> None:
    """Shows a file under its name, and not that it was written."""
    first, _, text = block.rawsource.partition("\n")
    name = first.removeprefix(_FILE)
    _rewrite(block, text, _LANGUAGES[Path(name).suffix])
    title = nodes.paragraph("", "", nodes.literal(name, name), classes=["file-name"])
    cell.insert(0, title)
    for output in list(cell.findall(_is_output)):
        output.parent.remove(output)


def _is_output(node: nodes.Node) -> bool:
    return isinstance(node, nodes.container) and node.get("nb_element") == "cell_code_output"


def _rewrite(block: nodes.literal_block, text: str, language: str) -> None:
    """Shows a cell without the word that marks it for the notebook."""
    block.rawsource = text
    block["language"] = language
    block.children = []
    block += nodes.Text(text)


def _spread(app: Sphinx, env: BuildEnvironment, names: list[str]) -> None:
    """Spreads notebooks evenly over the pages: processes take several pages at a time."""
    slow = [name for name in names if name.startswith("tutorials/")]
    rest = [name for name in names if name not in slow]
    places = {index * len(names) // len(slow) for index in range(len(slow))}
    names[:] = [(slow if place in places else rest).pop(0) for place in range(len(names))]


def _join_streams(app: Sphinx) -> None:
    """Joins what a cell prints: a shell cell hands it over in pieces of a hundred bytes."""
    execute = NotebookClient.async_execute_cell

    async def joined(client: NotebookClient, cell: Any, *args: Any, **kwargs: Any) -> Any:
        client.coalesce_streams = True
        return await execute(client, cell, *args, **kwargs)

    NotebookClient.async_execute_cell = joined  # pyright: ignore[reportAttributeAccessIssue]


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the extension."""
    app.connect("builder-inited", _join_streams)
    app.connect("doctree-read", _tidy)
    app.connect("env-before-read-docs", _spread)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
