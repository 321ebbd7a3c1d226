"""Checks that pages quote measurements that are stored, of the stated size, and not too old."""

import importlib.util
import json
import re
import subprocess
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
# A figure may be older than the newest change of the code that it speaks of, by this many days.
_MOST_DAYS = 14
_CODE = [f"swarmjax/{room}" for room in ("sim", "task", "ppo", "curriculum", "training")]


def _load_tables() -> Any:
    path = _ROOT / "docs" / "_ext" / "readme_tables.py"
    spec = importlib.util.spec_from_file_location("readme_tables", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


_MAKER = _load_tables()
_TABLES = [table.strip() for table in _MAKER.tables(_MAKER.read())]


def _line(value: str) -> dict[str, Any]:
    """Reads the line that `value` names by file and number."""
    file, _, line = value.split()[0].partition(":")
    lines = (_ROOT / "benchmarks" / "results" / file).read_text().splitlines()
    return json.loads(lines[int(line) - 1])


def _number(value: str) -> float:
    """Reads the number that `value` names by file, line and keys."""
    _, keys, *factor = value.split()
    found: Any = _line(value)
    for key in _keys(keys):
        found = found[int(key)] if isinstance(found, list) else found[key]
    return found * float(factor[0] if factor else 1)


def _keys(dotted: str) -> list[str]:
    """Splits keys at dots, except at the dot of a number such as in `seconds_to_0.90`."""
    return re.split(r"(?<!_\d)\.", dotted)


def _rendered(entry: dict[str, Any]) -> str:
    return entry["text"].format(*map(_number, entry["values"]))


def _git(*words: str) -> str:
    found = subprocess.run(["git", *words], cwd=_ROOT, capture_output=True, text=True, check=False)
    return found.stdout.strip()


def _days_behind(commit: str) -> float:
    """Returns how much older a commit is than the newest change of `_CODE`."""
    measured = _git("show", "-s", "--format=%ct", commit)
    assert measured, f"commit {commit} is not in the history"
    return (int(_git("log", "-1", "--format=%ct", "--", *_CODE)) - int(measured)) / 86400.0


_by_text = pytest.mark.parametrize("entry", _QUOTED, ids=lambda entry: entry["text"][:40])


@_by_text
def test_a_quoted_figure_is_that_of_its_line(entry: dict[str, Any]) -> None:
    page = entry.get("page", "README.md")
    assert _rendered(entry) in (_ROOT / page).read_text()


@pytest.mark.parametrize("entry", [each for each in _QUOTED if "per_s" in str(each["values"])])
def test_a_quoted_speed_is_of_the_stated_size(entry: dict[str, Any]) -> None:
    assert [_line(value)["arenas"] for value in entry["values"]] == entry["arenas"]


@_by_text
def test_a_quoted_figure_is_not_too_old(entry: dict[str, Any]) -> None:
    if _git("rev-parse", "--is-shallow-repository") != "false":
        pytest.skip("the history is not here")
    for value in entry["values"]:
        assert _days_behind(_line(value)["commit"]) <= _MOST_DAYS


@pytest.mark.parametrize("table", _TABLES, ids=lambda table: table[:40])
def test_a_table_of_the_comparison_is_that_of_the_lines(table: str) -> None:
    pages = ("benchmarks.md", "performance.md")
    assert any(table in (_ROOT / "docs" / page).read_text() for page in pages)
    if _git("rev-parse", "--is-shallow-repository") == "false":
        assert _days_behind(table.rpartition("commit ")[2].rstrip(".")) <= _MOST_DAYS


def test_every_measurement_has_a_line() -> None:
    page = re.sub(r"```.*?```|^    .*?$", "", _README, flags=re.DOTALL | re.MULTILINE)
    for known in [*map(_rendered, _QUOTED), *_TABLES]:
        page = page.replace(known, "")
    assert _MEASURED.findall(page) == []


@pytest.mark.parametrize("text", ["90.9 %", "396 M", "0.73 contacts", "| 0.20 |", "14.7 k "])
def test_measurements_are_noticed(text: str) -> None:
    assert _MEASURED.search(text)
