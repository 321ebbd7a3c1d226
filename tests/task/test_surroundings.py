"""Tests what a critic sees of the state, against places worked out by hand and in NumPy."""

import jax
import numpy as np
import pytest

from swarmjax.sim import model
from swarmjax.task import surroundings
from swarmjax.task.level import Level

ROUND = 1e-6  # float32, numbers of about 1
TO_GO = 0.7  # m
OWN = surroundings._OWN


def _level(robots: int, boxes: np.ndarray, side: float = 1.0, target: float = 0.0) -> Level:
    return Level(
        present=np.ones(robots, bool),
        start=np.zeros((robots, 3), np.float32),
        target=np.full((robots, 2), target, np.float32),
        side=np.float32(side),
        obstacle=boxes.astype(np.float32),
        obstacle_present=np.ones(len(boxes), bool),
        seed=np.uint32(0),
    )


def _look(pose: np.ndarray, level: Level, arrived: np.ndarray | None = None) -> np.ndarray:
    there = np.zeros(len(pose), bool) if arrived is None else arrived
    to_go = np.full(len(pose), TO_GO, np.float32)
    given = pose.astype(np.float32), level, there, to_go, level.target
    found = jax.jit(surroundings.look)(*given)
    assert found.shape == (len(pose), surroundings.SIZE)
    return np.asarray(found)


def _robots(row: np.ndarray) -> np.ndarray:
    return row[OWN : OWN + 8 * surroundings.NEAREST_ROBOTS].reshape(-1, 8)


def _rectangles(row: np.ndarray) -> np.ndarray:
    return row[OWN + 8 * surroundings.NEAREST_ROBOTS :].reshape(-1, 8)


def test_a_target_is_seen_in_the_robots_frame() -> None:
    level = _level(1, np.zeros((0, 5)))._replace(target=np.float32([[0.3, 0.2]]))
    # The robot is at (0.1, 0.1) and faces north: its target is 0.1 m ahead and 0.2 m to the right.
    row = _look(np.array([[0.1, 0.1, np.pi / 2]]), level, np.array([True]))[0]
    np.testing.assert_allclose(row[:3], [0.1, -0.2, 1.0], atol=ROUND)


@pytest.mark.parametrize(("to_go", "shown"), [(0.0, 0.0), (3.9, 3.9), (4.1, 4.0)])
def test_the_distance_to_go_is_shown_up_to_4_metres(to_go: float, shown: float) -> None:
    level, pose = _level(1, np.zeros((0, 5))), np.zeros((1, 3), np.float32)
    given = pose, level, np.zeros(1, bool), np.float32([to_go]), level.target
    found = jax.jit(surroundings.look)(*given)
    np.testing.assert_allclose(found[0, 3], shown, atol=ROUND)


# Distances in m. The direction fades within `surroundings._NEAR`, 1 mm.
@pytest.mark.parametrize(("away", "shown"), [(0.5, 1.0), (0.002, 1.0), (0.0005, 0.5), (0.0, 0.0)])
def test_the_direction_to_the_waypoint_is_a_unit_vector_unless_it_is_within_1_mm(
    away: float, shown: float
) -> None:
    level, pose = _level(1, np.zeros((0, 5))), np.float32([[0.0, 0.0, np.pi / 2]])
    given = pose, level, np.zeros(1, bool), np.float32([TO_GO]), np.float32([[away, 0.0]])
    # The robot faces north and the waypoint is in the east: to the right.
    found = jax.jit(surroundings.look)(*given)
    np.testing.assert_allclose(found[0, 4:6], [0.0, -shown], atol=ROUND)


def test_another_robot_is_seen_with_its_heading_and_its_target() -> None:
    level = _level(2, np.zeros((0, 5)))._replace(target=np.float32([[0, 0], [0.4, 0.4]]))
    pose = np.array([[0.1, 0.1, np.pi / 2], [0.1, 0.3, np.pi]])
    row = _robots(_look(pose, level, np.array([False, True]))[0])[0]
    # The other robot is 0.2 m ahead and faces left. Its target is 0.3 m ahead and 0.3 m right.
    np.testing.assert_allclose(row, [1.0, 0.2, 0.0, 0.0, 1.0, 0.3, -0.3, 1.0], atol=ROUND)


def test_the_nearest_robots_come_first_and_the_rest_is_left_out() -> None:
    count = surroundings.NEAREST_ROBOTS + 3
    away = np.random.default_rng(0).permutation(count - 1) + 1
    pose = np.zeros((count, 3))
    pose[1:, 0] = 0.05 * away
    found = _robots(_look(pose, _level(count, np.zeros((0, 5)), 2.0))[0])
    np.testing.assert_allclose(found[:, 1], 0.05 * np.arange(1, 9), atol=ROUND)


def test_an_absent_robot_is_all_zero() -> None:
    level = _level(3, np.zeros((0, 5)))._replace(present=np.array([True, False, True]))
    pose = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    found = _robots(_look(pose, level)[0])
    assert found[0, 1] == np.float32(0.2)
    assert (found[1:] == 0.0).all()


def test_a_wall_is_seen_by_its_nearest_point_and_its_ends() -> None:
    # The wall is 0.4 m long and 0.02 m thick. It lies across the way, 0.2 m ahead of a robot that
    # faces south.
    level = _level(1, np.array([[0.0, -0.2, 0.0, 0.2, 0.01]]))
    row = _rectangles(_look(np.array([[0.05, 0.0, -np.pi / 2]]), level)[0])[0]
    # East is to the robot's left. The east end is 0.15 m to the left, the west end 0.25 m to the
    # right.
    expected = [1.0, 0.19, 0.0, 0.2, -0.25, 0.2, 0.15, 0.01]
    np.testing.assert_allclose(row, expected, atol=ROUND)


@pytest.mark.parametrize("seed", range(1))
def test_rectangles_are_those_of_numpy(seed: int) -> None:
    draw = np.random.default_rng(seed)
    places, halves = draw.uniform(-0.4, 0.4, (20, 2)), draw.uniform(0.02, 0.2, (20, 2))
    boxes = np.concatenate([places, draw.uniform(-3, 3, (20, 1)), halves], axis=1)
    pose = draw.uniform(-0.4, 0.4, (2, 3))
    found = _rectangles(_look(pose, _level(2, boxes))[0])
    assert found.shape == (surroundings.NEAREST_RECTANGLES, 8)
    edge = np.linspace(-1.0, 1.0, 801)
    grid = np.stack(np.meshgrid(edge, edge), axis=-1).reshape(-1, 2)
    gaps = []
    for x, y, yaw, half_x, half_y in np.asarray(
        model.fixture_rectangles(np.float32(1.0), boxes, np)
    ):
        half = np.minimum([half_x, half_y], 1.5)  # cuts outer walls to the arena
        cos, sin = np.cos(yaw), np.sin(yaw)
        points = grid * half @ np.array([[cos, sin], [-sin, cos]]) + [x, y]
        gaps.append(np.hypot(*(points - pose[0, :2]).T).min())
    gaps = np.sort(gaps)[: len(found)]
    # The grid in each rectangle has points up to 3 m / 800 apart along a wall.
    np.testing.assert_allclose(np.hypot(found[:, 1], found[:, 2]), gaps, atol=4e-3)
    right, left = found[:, 3:5], found[:, 5:7]
    assert (right[:, 0] * left[:, 1] - right[:, 1] * left[:, 0] >= -ROUND).all()


def test_turning_and_shifting_the_world_changes_nothing_but_the_walls_around() -> None:
    draw = np.random.default_rng(4)
    boxes = draw.uniform(0.02, 0.2, (3, 5))
    pose, target = draw.uniform(-0.3, 0.3, (2, 3)), draw.uniform(-0.3, 0.3, (2, 2))
    turn, shift = 0.7, np.array([0.2, -0.1])
    cos, sin = np.cos(turn), np.sin(turn)
    matrix = np.array([[cos, -sin], [sin, cos]])

    def moved(x: np.ndarray) -> np.ndarray:
        places = x[:, :2] @ matrix.T + shift
        return np.concatenate([places, x[:, 2:3] + turn, x[:, 3:]], axis=1)

    far = 3.9  # the outer walls are the last four of seven
    here = _level(2, boxes, far)._replace(target=target.astype(np.float32))
    there = _level(2, moved(boxes), far)._replace(
        target=(target @ matrix.T + shift).astype(np.float32)
    )
    one, other = _look(pose, here), _look(moved(pose), there)
    alike = surroundings.SIZE - (surroundings.NEAREST_RECTANGLES - 3) * 8
    np.testing.assert_allclose(one[:, :alike], other[:, :alike], atol=1e-5)


def test_what_broke_is_finite_and_what_is_far_is_clipped() -> None:
    level = _level(2, np.zeros((0, 5)))
    found = _look(np.array([[np.nan, 0, 0], [50.0, 0, 0]]), level)
    assert np.isfinite(found).all()
    assert np.abs(found).max() <= surroundings.REACH


def test_a_robot_alone_sees_the_walls_and_no_others() -> None:
    found = _look(np.zeros((1, 3)), _level(1, np.zeros((0, 5))))[0]
    assert (_robots(found) == 0.0).all()
    assert _rectangles(found)[:, 0].tolist() == [1.0] * 4 + [0.0] * 8
