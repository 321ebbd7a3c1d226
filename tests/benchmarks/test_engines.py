"""Tests the comparison of two engines on the same levels, worked out by hand."""

from typing import Any

import numpy as np
import pytest

from benchmarks import engines
from swarmjax.config import ConfigError
from swarmjax.evaluate.cells import Cell
from swarmjax.evaluate.trials import Trial
from swarmjax.task.stage_config import StageConfig


def _trial(**found: list[float]) -> Trial:
    levels: Any = None
    stage = StageConfig(name="s", robots=1, side=1.0)
    cell = Cell("x", stage, "box", None, 1, np.array([3, 4, 5, 6]), levels)
    tables = {name: np.array([values]) for name, values in found.items()}
    return Trial(cell, np.zeros((4, 1)), tables, np.zeros((1, 4, 1)))


def test_engines_are_compared_level_by_level() -> None:
    c = _trial(
        targets_reached=[1.0, 1.0, 0.5, 1.0],
        contacts_per_robot=[0.0, 0.0, 1.0, 2.0],
        episode_time_s=[3.2, 6.4, 48.0, 9.6],
        impulse_ns_per_robot=[0.0, 0.0, 1.0, 1.0],
    )
    mjx = _trial(
        targets_reached=[1.0, 1.0, 1.0, 1.0],
        contacts_per_robot=[0.0, 0.5, 1.0, 2.0],
        episode_time_s=[3.232, 6.5, 8.0, 9.6],
    )
    found = engines.compare(c, mjx)
    assert found["same_targets"] == 0.75
    assert found["same_contacts"] == 0.75
    assert found["same_time"] == 0.5  # times one control step apart count as equal
    assert (found["levels_without_contact"], found["same_time_without_contact"]) == (0.5, 0.5)
    assert found["levels_that_differ"] == [5]
    assert found["largest_differences"] == pytest.approx(
        {"targets_reached": 0.5, "contacts_per_robot": 0.5, "episode_time_s": 40.0}
    )
    assert found["measures"]["targets_reached"]["difference"] == pytest.approx(0.125)


def test_a_comparison_of_policies_is_not_one_of_engines() -> None:
    with pytest.raises(ConfigError, match="only the engines are compared"):
        engines.main(["compare=a.npz,b.npz"])
