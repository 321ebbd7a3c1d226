"""Tests the model of several devices by hand, and the page that its results are written into."""

import json
from pathlib import Path

import pytest
from sentences import refusal

from benchmarks import devices_page

LINE = {
    "benchmark": "devices_speed",
    "robot": "planar",
    "scaling": "weak",
    "processes": 1,
    "arenas": 1000,
    "arenas_in_all": 2000,
    "sums": 21,
    "arena_steps_per_s_of_one": 3.2e6,  # 10 ms for 1000 arenas of 32 control steps.
    "arena_steps_per_s": 5.0e6,  # 12.8 ms for 2000 arenas.
    "efficiency": [0.78, 0.7, 0.8],
}
SUM = {"benchmark": "all_reduce", "bytes": 65_536, "microseconds": 20.0}


@pytest.mark.parametrize(
    ("devices", "expected"),
    [
        (1, 1.0),
        (2, 10.0 / (10.0 + 13 * 0.02 + 0.564 * 0.5)),
        (64, 10.0 / (10.0 + 13 * (0.02 + 0.015 * 3) + 2.34 * 0.5)),  # 8 hosts are three doublings
    ],
)
def test_predict(devices: int, expected: float) -> None:
    assert devices_page.predict(10.0, devices, 20.0, 0.5) == pytest.approx(expected)


def test_the_wait_is_what_two_devices_lose_beyond_their_sums() -> None:
    found = devices_page.deviation_ms(LINE, 20.0)
    assert found == pytest.approx((12.8 - 10.0 - 21 * 0.02) / 0.564)


def test_the_page_gets_tables_and_a_plot(tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    page = tmp_path / devices_page.PAGE
    page.write_text("<!-- measured -->\n<!-- /measured -->\n<!-- model -->\n<!-- /model -->\n")
    lines = tmp_path / "lines.jsonl"
    lines.write_text(f"{json.dumps(LINE)}\n{json.dumps(SUM)}\n")
    assert devices_page.main([f"lines={lines}", f"docs={tmp_path}"]) == 0
    assert "| planar | weak | 1 | 1,000, 2,000 | 10.0, 12.8 | 3.20, 5.00 |" in page.read_text()
    assert (tmp_path / devices_page.FIGURE).exists()


def test_the_newest_line_of_a_comparison_counts() -> None:
    other = LINE | {"processes": 2}
    found = devices_page.newest([LINE, other, LINE | {"sums": 13}, SUM])
    assert [line["sums"] for line in found] == [13, 21]


def test_lines_without_sums_are_refused(tmp_path: Path) -> None:
    lines = tmp_path / "lines.jsonl"
    lines.write_text(f"{json.dumps(LINE)}\n")
    said = refusal(devices_page.main, [f"lines={lines}", f"docs={tmp_path}"])
    assert said.startswith("lines must have results of devices_speed and of all_reduce with 65536 ")
