"""Cells of notebooks: shell reads as shell, a file as a file; a failure names file and line."""

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
_LANGUAGES = {".yaml": "yaml", ".py": "python", ".c": "c"}


def _is_cell(node: nodes.Node) -> bool:
    return isinstance(node, nodes.container) and node.get("nb_element") == "cell_code"


def _tidy(app: Sphinx, document: nodes.document) -> None:
    """Reports failed cells, and takes the magic words off the others."""
    for cell in list(document.findall(_is_cell)):
        for block in list(cell.findall(nodes.literal_block)):
            if "traceback" in block["classes"]:
                _report(app, cell, block)
            elif block.rawsource.startswith(_SHELL):
                _rewrite(block, block.rawsource.removeprefix(_SHELL), "bash")
            elif block.rawsource.startswith(_FILE):
                _as_file(cell, block)


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
