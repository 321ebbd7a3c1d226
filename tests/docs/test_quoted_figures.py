"""Checks that README quotes only measurements that are stored."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

_ROOT = Path(__file__).parents[2]
_README = (_ROOT / "README.md").read_text()
_QUOTED = yaml.safe_load((Path(__file__).parent / "quoted_figures.yaml").read_text())
# Matches a measurement: a share, a speed, a number of contacts, or a number in a table's cell.
_MEASURED = re.compile(
    r"\d[\d.,]* ?(?:%|[MkG]\b)|\d[\d.,]* (?:contacts|seconds|times faster)|\| *\d[\d.,]* *(?=\|)"
)


def _number(value: str) -> float:
    """Reads the number that `value` names by file, line and keys."""
    place, keys, *factor = value.split()
    file, _, line = place.partition(":")
    lines = (_ROOT / "benchmarks" / "results" / file).read_text().splitlines()
    found: Any = json.loads(lines[int(line) - 1])
    for key in _keys(keys):
        found = found[int(key)] if isinstance(found, list) else found[key]
    return found * float(factor[0] if factor else 1)


def _keys(dotted: str) -> list[str]:
    """Splits keys at dots, except at the dot of a number such as in `seconds_to_0.90`."""
    return re.split(r"(?<!_\d)\.", dotted)


def _rendered(entry: dict[str, Any]) -> str:
    return entry["text"].format(*map(_number, entry["values"]))


@pytest.mark.parametrize("entry", _QUOTED, ids=lambda entry: entry["text"][:40])
def test_a_quoted_figure_is_that_of_its_line(entry: dict[str, Any]) -> None:
    assert _rendered(entry) in _README


def test_every_measurement_has_a_line() -> None:
    page = re.sub(r"```.*?```|^    .*?$", "", _README, flags=re.DOTALL | re.MULTILINE)
    for entry in _QUOTED:
        page = page.replace(_rendered(entry), "")
    assert _MEASURED.findall(page) == []


@pytest.mark.parametrize("text", ["90.9 %", "396 M", "0.73 contacts", "| 0.20 |", "14.7 k "])
def test_measurements_are_noticed(text: str) -> None:
    assert _MEASURED.search(text)
