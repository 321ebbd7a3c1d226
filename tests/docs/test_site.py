"""Tests the checks of the site's build, and the notebook made from its first tutorial."""

import importlib.util
import re
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import pytest

from swarmjax.config import Section, about
from swarmjax.shell import commands

_ROOT = Path(__file__).parents[2]
_NOTEBOOK_NEEDS = "needs the group docs: uv run --group docs"
_TUTORIALS = sorted((_ROOT / "docs" / "tutorials").glob("[!i]*.md"))
_MANY = re.MULTILINE | re.DOTALL
_PICTURE = re.compile(r"^!\[.*?\]\((.*?)\)$", _MANY)


def _extension(name: str) -> ModuleType:
    path = _ROOT / "docs" / "_ext" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@dataclass(frozen=True, kw_only=True)
class _Silent(Section):
    """A section with one key that has no explanation."""

    told: int = field(default=1, metadata=about("something"))
    silent: int = field(default=1, metadata=about(" "))


def test_the_notebook_is_that_of_the_tutorial() -> None:
    made = _extension("site_notebook")
    assert made.NOTEBOOK.read_text() == made.text(made.TUTORIAL.read_text())


def test_a_key_without_a_meaning_is_found_where_it_stands() -> None:
    pytest.importorskip("sphinx", reason=_NOTEBOOK_NEEDS)
    [(path, line, key)] = _extension("site_keys").undocumented(_Silent)
    assert (path, key) == (Path(__file__), "silent")
    assert "silent: int" in path.read_text().splitlines()[line - 1]


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_every_key_has_a_meaning(name: str) -> None:
    pytest.importorskip("sphinx", reason=_NOTEBOOK_NEEDS)
    assert _extension("site_keys").undocumented(commands.settings(name)) == []


def test_a_dead_link_is_found_where_it_stands(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason=_NOTEBOOK_NEEDS)
    page = tmp_path / "page.md"
    page.write_text("# A page\n\n[here](#a-page) [there](gone.md)\n\n`examples/gone.py`\n")
    assert list(_extension("site_links").dead(page)) == [(3, "gone.md"), (5, "examples/gone.py")]


def test_a_link_within_a_block_of_code_is_no_link(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason=_NOTEBOOK_NEEDS)
    page = tmp_path / "page.md"
    page.write_text("```\n[there](gone.md)\n```\n")
    assert list(_extension("site_links").dead(page)) == []


@pytest.mark.parametrize("page", _TUTORIALS, ids=lambda page: page.stem)
def test_what_a_cell_printed_or_drew_stands_below_it(page: Path) -> None:
    text = page.read_text()
    cells = re.findall(r"^```(?:\{code-cell\} ipython3|bash)\n(.*?)^```\n\n(?=(.*?)$)", text, _MANY)
    assert len(cells) == len(re.findall(r"^```(?:\{code-cell\}|bash)", text, _MANY)) > 0
    shown = [below for code, below in cells if not code.startswith("%%writefile")]
    assert [below for below in shown if below != "```text" and not below.startswith("![")] == []


def test_the_pictures_of_the_tutorials_are_small() -> None:
    text = "".join(page.read_text() for page in _TUTORIALS)
    sizes = [(_TUTORIALS[0].parent / name).stat().st_size for name in _PICTURE.findall(text)]
    assert max(sizes) <= 150_000
    assert sum(sizes) <= 1_000_000


@pytest.mark.parametrize(
    ("stored", "agrees"),
    [
        ("one 1.5 s\n...\nlast [-0.1 2]", True),
        ("one 1.5 s\nlast [-0.1 2]", False),
        ("two ...", False),
    ],
)
def test_a_stored_output_may_differ_in_numbers(stored: str, agrees: bool) -> None:
    pytest.importorskip("myst_nb", reason=_NOTEBOOK_NEEDS)
    printed = "one 2 min 03 s\nmore\nlast [ 3.25 -2]\n"
    assert _extension("site_cells").agrees(stored, printed) == agrees


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path) -> None:
    nbclient = pytest.importorskip("nbclient", reason=_NOTEBOOK_NEEDS)
    nbformat = pytest.importorskip("nbformat", reason=_NOTEBOOK_NEEDS)
    notebook = nbformat.read(_ROOT / "examples" / "first_swarm.ipynb", as_version=4)
    where = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=900, resources=where).execute()
    assert "targets reached" in str(notebook.cells)
