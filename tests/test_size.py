"""Keeps the project small: `python tests/test_size.py` prints its sizes, the test holds ceilings.

A code line is a line with a token that is no comment and no docstring. A change that needs more
raises a ceiling here, and says in its message what pays for it.
"""

import ast
import functools
import io
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
_BLANK = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
CEILINGS = {
    "code lines of swarmjax": 19_210,
    "code lines of benchmarks": 4_360,
    "keys of train": 141,
    "longest file": 450,
    "longest function": 60,
}


def _code_lines(text: str) -> int:
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _BLANK | {tokenize.ENDMARKER}:
            lines |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if first is not None and ast.get_docstring(node, clean=False) is not None:
                lines -= set(range(first.lineno, (first.end_lineno or 0) + 1))
    return len(lines)


def _functions(text: str) -> Iterator[int]:
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            docstring = ast.get_docstring(node, clean=False)
            body = node.body[1 if docstring is not None else 0 :]
            if body:
                yield (node.end_lineno or 0) - body[0].lineno + 1


@functools.cache
def sizes() -> dict[str, int]:
    """Measures what `CEILINGS` bounds."""
    from swarmjax.config import section
    from swarmjax.run.settings import TrainConfig

    texts = {
        folder: [path.read_text() for path in sorted((ROOT / folder).rglob("*.py"))]
        for folder in ("swarmjax", "benchmarks")
    }
    every = [text for folder in texts.values() for text in folder]
    return {
        **{f"code lines of {name}": sum(map(_code_lines, each)) for name, each in texts.items()},
        "keys of train": len(section.keys(TrainConfig)),
        "longest file": max(len(text.splitlines()) for text in every),
        "longest function": max(length for text in every for length in _functions(text)),
    }


@pytest.mark.parametrize("what", CEILINGS)
def test_the_project_has_not_grown(what: str) -> None:
    assert sizes()[what] <= CEILINGS[what]


def test_comments_docstrings_and_blank_lines_are_no_code() -> None:
    text = '"""Module."""\n\n# why\ndef f(x):\n    """Doc."""\n    return (\n        x\n    )\n'
    assert _code_lines(text) == 4


if __name__ == "__main__":
    for name, size in sizes().items():
        sys.stdout.write(f"{name}: {size:,}\n")
