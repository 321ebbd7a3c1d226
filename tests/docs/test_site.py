"""Tests the checks of the site's build, and the notebook made from its first tutorial."""

import importlib.util
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import pytest

from swarmjax.config import Section, about
from swarmjax.shell import commands

_ROOT = Path(__file__).parents[2]
_NOTEBOOK_NEEDS = "needs the group docs: uv run --group docs"


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


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path) -> None:
    nbclient = pytest.importorskip("nbclient", reason=_NOTEBOOK_NEEDS)
    nbformat = pytest.importorskip("nbformat", reason=_NOTEBOOK_NEEDS)
    notebook = nbformat.read(_ROOT / "examples" / "first_swarm.ipynb", as_version=4)
    where = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=900, resources=where).execute()
    assert "targets reached" in str(notebook.cells)
