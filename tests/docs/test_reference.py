"""Checks that the reference pages, as they read unbuilt, name all that they are about."""

import re
from pathlib import Path

import swarmjax
from swarmjax.config import section
from swarmjax.shell import commands

_REFERENCE = Path(__file__).parents[2] / "docs" / "reference"


def _rows(page: str) -> dict[str, str]:
    """Reads the first and the last cell of each row of a page's table."""
    text = (_REFERENCE / page).read_text()
    return dict(re.findall(r"^\| `(\w+)` \|.*\| ([^|]+) \|$", text, re.MULTILINE))


def test_each_public_name_has_a_row() -> None:
    names = re.findall(r"^\| `(\w+)` \|", (_REFERENCE / "api.md").read_text(), re.MULTILINE)
    assert sorted(names) == sorted(swarmjax.__all__)


def test_each_section_of_keys_has_a_row_with_its_commands() -> None:
    found: dict[str, list[str]] = {}
    for name in commands.COMMANDS:
        for each in section.sections(commands.settings(name)):
            found.setdefault(each, []).append(name)
    assert _rows("keys.md") == {each: ", ".join(names) for each, names in found.items()}


def test_each_command_is_named() -> None:
    words = re.findall(r"\w+", (_REFERENCE / "keys.md").read_text())
    assert set(commands.COMMANDS) <= set(words)
