"""Tests the table over numbers of arenas and transitions: its points and its comparisons."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import scaling_law
from benchmarks.scaling_law import Point, ScalingConfig


def _config(directory: Path, **given: object) -> ScalingConfig:
    return ScalingConfig(dir=str(directory), do="table", **given)  # pyright: ignore[reportArgumentType]


def test_a_transition_is_a_step_of_one_of_five_robots(tmp_path: Path) -> None:
    settings = scaling_law.training(_config(tmp_path), Point(128, 1e6), ["stage=s1"])
    assert settings is not None
    assert (settings.arenas, settings.budget) == (128, 200_000)


def test_a_point_of_less_than_one_update_is_not_trained(tmp_path: Path) -> None:
    # An update takes 32 control steps of 128 arenas of five robots.
    words = ["stage=s1"]
    assert scaling_law.training(_config(tmp_path), Point(128, 32 * 128 * 5 - 1), words) is None
    assert scaling_law.training(_config(tmp_path), Point(128, 32 * 128 * 5), words) is not None


def _judged(config: ScalingConfig, point: Point, reached: list[list[float]]) -> None:
    """Stores `reached` [seeds, levels] as the result of every measure."""
    for action in scaling_law.ACTIONS:
        place = scaling_law.judged_file(config, point, "s6", action)
        place.parent.mkdir(exist_ok=True)
        np.savez(place, **dict.fromkeys(scaling_law.MEASURES, np.array(reached)))  # pyright: ignore[reportArgumentType]


def test_a_point_is_compared_with_the_next_smaller_ones_level_by_level(tmp_path: Path) -> None:
    config = _config(tmp_path, arenas=(1, 2, 4), transitions=(10.0, 100.0))
    half, all_but_one = [[1.0, 0.0, 1.0, 0.0]] * 3, [[1.0, 1.0, 1.0, 0.0]] * 3
    _judged(config, Point(2, 100.0), half)
    _judged(config, Point(4, 100.0), all_but_one)
    lines = [each for each in scaling_law.table(config) if each["action"] == "mean"]
    (small, large) = sorted(lines, key=lambda line: line["arenas"])
    assert (small["all_reached"], large["all_reached"]) == (0.5, 0.75)
    assert large["all_reached_by_arenas"][0] == 0.25
    assert not [key for key in small if key.endswith(("by_arenas", "by_transitions"))]
    assert "all_reached_by_transitions" not in large  # no point of 10 transitions was judged


@pytest.mark.parametrize("cell", ["s6", "r10", "crowd_dense"])
def test_the_suite_has_the_cells_of_the_goals(cell: str) -> None:
    text = Path("configs/suites/scaling.yaml").read_text()
    assert f"name: {cell}\n" in text
