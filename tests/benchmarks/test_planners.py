"""Tests paths on the grid worked out by hand, and that navground's planners keep robots apart."""

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import baselines, planners, way_points
from swarmjax.config import ConfigError

HULL = 0.037  # m
MAPS = Path(baselines.__file__).parent / "maps"
# A plate of 0.6 by 0.04 m across the middle of an arena of 1.2 m.
PLATE = np.array([[0.0, 0.0, 0.0, 0.02, 0.3]])


def test_clearance_is_the_distance_to_the_nearest_edge() -> None:
    """The points are near a wall at 0.6 m, the plate's face, its corner, and inside the plate."""
    points = np.array([[0.5, 0.0], [0.12, 0.1], [0.05, 0.34], [0.01, 0.0]])
    found = way_points.clearance(points, 1.2, PLATE)
    assert found == pytest.approx([0.1, 0.1, 0.05, 0.0])


def test_clearance_of_a_box_that_is_turned() -> None:
    """After a turn by 90 degrees the plate lies along x and reaches 0.3 m to each side."""
    turned = np.array([[0.0, 0.0, np.pi / 2, 0.02, 0.3]])
    assert way_points.clearance(np.array([[0.2, 0.1]]), 1.2, turned) == pytest.approx([0.08])


def test_a_target_in_sight_is_its_own_way_point() -> None:
    target = np.array([[0.3, 0.41]])
    plan = way_points.plan(1.2, target, PLATE, HULL)
    assert way_points.way_points(plan, np.array([[0.2, 0.4]]), target) == pytest.approx(target)


def test_the_way_leads_round_the_plate_and_never_through_it() -> None:
    """The path from (-0.2, 0) to (0.2, 0) leads round an end of the plate at y = 0.3.

    Two legs of sqrt(0.2^2 + 0.3^2) = 0.361 m make at least 0.72 m. With a detour for the hull the
    path is shorter than 0.85 m.
    """
    target, place = np.array([[0.2, 0.0]]), np.array([[-0.2, 0.0]])
    plan = way_points.plan(1.2, target, PLATE, HULL)
    way, least = 0.0, np.inf
    while np.linalg.norm(target - place) > 0.02 and way < 2.0:
        off = way_points.way_points(plan, place, target) - place
        place = place + off * min(0.01 / np.linalg.norm(off), 1.0)
        least = min(least, way_points.clearance(place, 1.2, PLATE)[0])
        way += 0.01
    assert 0.72 < way < 0.85
    assert least > HULL - way_points.CELL  # lines are tested one cell at a time


def test_robots_without_a_way_have_a_way_point() -> None:
    """A plate from wall to wall leaves no path, so the robot heads for the target itself."""
    wall = np.array([[0.0, 0.0, 0.0, 0.02, 0.7]])
    target = np.array([[0.3, 0.0]])
    plan = way_points.plan(1.2, target, wall, HULL)
    found = way_points.way_points(plan, np.array([[-0.3, 0.0]]), target)
    assert np.isfinite(found).all()


def _reached(who: str, stage: str, episodes: int) -> dict[str, float]:
    """Returns the mean of each measure."""
    words = [f"stage={stage}", f"episodes={episodes}", "workers=1", "seed=11"]
    (line,) = baselines.results([who], words)
    return {name: found["mean"] for name, found in line["measures"].items()}


@pytest.mark.parametrize("who", planners.SETTINGS)
def test_two_that_meet_head_on_both_arrive(who: str) -> None:
    pytest.importorskip("navground.core", reason="needs the extra navground")
    found = _reached(who, str(MAPS / "facing.yaml"), 2)
    assert found["all_reached"] == 1.0


def test_orca_keeps_two_apart_that_meet_head_on() -> None:
    pytest.importorskip("navground.core", reason="needs the extra navground")
    assert _reached("orca", str(MAPS / "facing.yaml"), 2)["contacts_per_robot"] == 0.0
    assert _reached("straight", str(MAPS / "facing.yaml"), 2)["contacts_per_robot"] > 0.0


def test_the_way_out_of_a_dead_end_is_known() -> None:
    pytest.importorskip("navground.core", reason="needs the extra navground")
    assert _reached("hl", str(MAPS / "u_trap.yaml"), 2)["all_reached"] == 1.0


def test_a_missing_package_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "navground.core", None)
    with pytest.raises(
        ConfigError, match=r"^navground is missing .*: install the extra navground\.$"
    ):
        next(baselines.results(["orca"], ["stage=s1"]))
