"""Runs the Python code of the guides as written; an error names the page and the line."""

import re
from pathlib import Path

import pytest

_DOCS = Path(__file__).parents[2] / "docs"
_BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def _blocks(page: str) -> list[tuple[int, str]]:
    """Lists the code blocks of a page, each with the number of lines above its code."""
    text = (_DOCS / page).read_text()
    return [(text.count("\n", 0, found.start(1)), found[1]) for found in _BLOCK.finditer(text)]


def _run(page: str, above: int, code: str) -> None:
    exec(compile("\n" * above + code, str(_DOCS / page), "exec"), {"__name__": page})


@pytest.mark.parametrize(("above", "code"), _blocks("extending.md"))
def test_a_piece_is_defined_as_it_is_written(above: int, code: str) -> None:
    _run("extending.md", above, code)


@pytest.mark.slow
@pytest.mark.parametrize(("above", "code"), _blocks("python.md"))
def test_a_function_is_called_as_it_is_written(
    above: int, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _run("python.md", above, code)
