"""Checks that each test that a page names for a promise exists."""

import re
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
PAGES = ("SECURITY.md", "docs/reliability.md")
_NAME = re.compile(r"`([\w/]*test_\w+\.py)(?:::(\w+))?`")
NAMED = [
    found.groups() for page in PAGES for found in _NAME.finditer((TESTS.parent / page).read_text())
]


@pytest.mark.parametrize(("file", "name"), NAMED)
def test_a_promise_names_a_test_that_exists(file: str, name: str | None) -> None:
    text = (TESTS / file).read_text()
    assert name is None or f"def {name}(" in text


def test_most_rows_name_a_test() -> None:
    rows = [
        line
        for page in PAGES
        for line in (TESTS.parent / page).read_text().splitlines()
        if line.startswith("| ") and "test_" in line
    ]
    assert len(rows) > 25
