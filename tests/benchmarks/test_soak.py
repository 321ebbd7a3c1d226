"""Checks the medians and slopes that `soak` computes from samples with a known trend."""

import json
import os
from pathlib import Path

import pytest

from benchmarks import soak


def _rows(memory_slope: float) -> list[dict[str, float]]:
    """Returns an hour of samples, one per minute.

    A second has 500 arena steps and takes two processor seconds.
    """
    return [
        {
            "leg": 1,
            "seconds": 60.0 * i,
            "memory_mb": 1000.0 + memory_slope * i / 60.0,
            "descriptors": 9,
            "threads": 20,
            "cpu_s": 120.0 * i,
            "arena_steps": 30_000 * i,
        }
        for i in range(61)
    ]


def test_a_leak_is_a_slope_in_percent_an_hour() -> None:
    found = soak.sum_up(_rows(memory_slope=100.0))["memory_mb"]
    # The first six samples are left out, so the median is the sample of minute 33.
    assert found["median"] == pytest.approx(1055.0)
    assert found["slope"] == pytest.approx(100.0 * 100.0 / 1055.0)


def test_speeds_are_counted_by_the_second_and_by_the_processor_second() -> None:
    found = soak.sum_up(_rows(memory_slope=0.0))
    assert found["arena_steps_per_s"]["median"] == pytest.approx(500.0)
    assert found["arena_steps_per_cpu_s"]["median"] == pytest.approx(250.0)


def test_a_leg_that_stood_still_has_no_speed() -> None:
    rows = [row | {"arena_steps": 5} for row in _rows(memory_slope=0.0)]
    found = soak.sum_up(rows)
    assert "memory_mb" in found
    assert "arena_steps_per_s" not in found


def test_a_sample_reads_the_last_whole_line_of_the_metrics(tmp_path: Path) -> None:
    rows = [json.dumps({"arena_steps": steps}) for steps in (10, 20)]
    (tmp_path / "metrics.jsonl").write_text("\n".join(rows) + '\n{"arena_st')
    found = soak.sample(os.getpid(), tmp_path)
    assert found["arena_steps"] == 20
    assert found["memory_mb"] > 1.0
    assert found["threads"] >= 1
