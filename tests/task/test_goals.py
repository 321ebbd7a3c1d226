"""Tests the goals against numbers worked out by hand, and in JAX against NumPy."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.config import ConfigError
from swarmjax.sim.config import RobotConfig
from swarmjax.task.config import RewardConfig, TaskConfig
from swarmjax.task.goals import load as goals
from swarmjax.task.goals.cover import CELLS
from swarmjax.task.goals.goal import Goal, Turn
from swarmjax.task.level import Level
from swarmjax.task.observation import View, to_target

HULL, REACH = 0.037, 0.077  # m; as far as a robot sees from its centre
BUILT_IN = (
    TaskConfig(),
    TaskConfig(arrival="hold"),
    TaskConfig(target_speed=0.1),
    TaskConfig(goal="lifelong"),
    TaskConfig(goal="gather"),
    TaskConfig(goal="cover"),
)


def _goal(**task: Any) -> Goal:
    return goals.load(TaskConfig(**task), RobotConfig())


def _level(start: list, target: list, side: float = 1.2, boxes: list | None = None) -> Level:
    """Returns a level in which a robot without a start is absent."""
    boxes = [[9.0, 9.0, 0.0, 0.05, 0.05]] if boxes is None else boxes
    return Level(
        side=np.float32(side),
        present=np.array([place is not None for place in start]),
        start=np.array([[*(place or (8.0, 8.0)), 0.0] for place in start], np.float32),
        target=np.array(target, np.float32),
        obstacle_present=np.array([box[0] < 9.0 for box in boxes]),
        obstacle=np.array(boxes, np.float32),
        seed=np.uint32(7),
    )


def _view(level: Level, place: list, arrived: list | None = None, clock: int = 1) -> View:
    """Returns the view of robots at these places that look along x."""
    pose = np.array([[*each, 0.0] for each in place], np.float32)
    distance, bearing = to_target(pose, level.target, np)
    before = np.zeros(len(pose), bool) if arrived is None else np.array(arrived)
    return View(
        pose=pose,
        target=level.target,
        distance=distance,
        bearing=bearing,
        infrared=np.full((len(pose), 8), 0.04, np.float32),
        present=level.present,
        arrived=before,
        side=level.side,
        obstacle=level.obstacle,
        obstacle_present=level.obstacle_present,
        clock=np.int32(clock),
    )


def _turns(goal: Goal, level: Level, places: list) -> list[Turn]:
    """Returns the turns of robots that are at these places in one step after the other."""
    state, target = goal.begin(level)
    level, found = level._replace(target=target), []
    arrived = np.zeros(len(level.present), bool)
    for clock, place in enumerate(places, 1):
        turn = goal.turn(state, level, _view(level, place, arrived.tolist(), clock))
        state, arrived, level = turn.state, turn.arrived, level._replace(target=turn.target)
        found.append(turn)
    return found


PAIR = _level([[-0.4, 0.0], [0.4, 0.0]], [[0.0, 0.3], [0.0, -0.3]])


def test_a_moving_target_keeps_its_speed_and_bounces_off_the_walls() -> None:
    goal, level = _goal(target_speed=0.1), PAIR
    # 300 steps of 0.1 m/s 0.032 s are 0.96 m, farther than the longest way to a wall and back.
    found = np.stack([turn.target for turn in _turns(goal, level, [[[-0.4, 0], [0.4, 0]]] * 300)])
    most = 0.6 - HULL
    assert np.abs(found).max() <= most + 1e-6
    stride = np.linalg.norm(np.diff(found, axis=0), axis=-1)
    at_wall = (np.abs(found[1:]) > most - 1e-6).any(axis=-1)
    # float32 rounds places of up to 0.6 m by 3e-8 m.
    np.testing.assert_allclose(stride[~at_wall], 0.0032, atol=2e-7)
    assert at_wall.any()
    assert not at_wall.all(axis=0).any()


def test_who_reaches_a_target_is_sent_to_a_place_that_nobody_has() -> None:
    level = _level([[-0.4, 0.0], [0.4, 0.0], None], [[0.0, 0.3], [0.0, -0.3], [8.0, 8.0]])
    away, both = [[-0.4, 0.0], [0.4, 0.0], [8, 8]], [[0.0, 0.3], [0.0, -0.3], [8, 8]]
    first, second = _turns(_goal(goal="lifelong"), level, [away, both])
    np.testing.assert_array_equal(first.target, level.target)
    assert first.earns.tolist() == first.arrived.tolist() == [False] * 3
    # Both targets were taken, so the two robots are sent to the two starts, in either order.
    assert sorted(second.target[:2].tolist()) == level.start[:2, :2].tolist()
    assert second.earns.tolist() == second.arrived.tolist() == [True, True, False]
    # One target for each of two robots within two steps of 32 ms.
    assert second.measured["targets_per_minute"] == pytest.approx(60.0 / 0.064, rel=1e-6)


def test_no_two_robots_are_ever_sent_to_one_place() -> None:
    draw = np.random.default_rng(3)
    start, target = draw.uniform(-0.5, 0.5, (2, 6, 2)).tolist()
    goal, level = _goal(goal="lifelong"), _level(start, target)
    state, _ = goal.begin(level)
    for clock in range(1, 100):
        reached = draw.random(6) < 0.5
        place = np.where(reached[:, None], level.target, level.target + 1.0)
        turn = goal.advance(state, level, _view(level, place.tolist(), clock=clock))
        assert turn.earns.tolist() == reached.tolist()
        assert (turn.target != level.target).any(axis=-1).tolist() == reached.tolist()
        assert len(np.unique(turn.target, axis=0)) == 6
        state, level = turn.state, level._replace(target=turn.target)


def test_a_lifelong_episode_ends_with_the_time_alone() -> None:
    goal, all_there = _goal(goal="lifelong"), np.ones((1, 2), bool)
    assert not goal.is_over(all_there, all_there).any()
    assert not goal.terminates(all_there, all_there, all_there).any()
    assert goal.drives(all_there).all()
    assert goal.is_under_way(all_there).all()


def test_gathering_is_done_within_a_disc_of_four_times_the_hulls() -> None:
    # Two robots: the disc's radius is 2 x 0.037 x sqrt(2) = 0.1047 m around their middle.
    level = _level([[-0.4, 0.0], [0.4, 0.0], None], [[0.0, 0.3], [0.0, -0.3], [8.0, 8.0]])
    goal = _goal(goal="gather")
    apart, near = [[-0.105, 0], [0.105, 0], [8, 8]], [[-0.1, 0.2], [0.1, 0.2], [8, 8]]
    first, second = _turns(goal, level, [apart, near])
    assert first.arrived.tolist() == [False, False, False]
    assert second.arrived.tolist() == [True, True, False]
    # The target of a robot is the middle of the others, here the other robot.
    np.testing.assert_allclose(second.target[:2], [[0.1, 0.2], [-0.1, 0.2]], atol=1e-7)
    assert goal.is_over(second.arrived, level.present)


def test_a_cluster_is_a_chain_of_hulls_that_are_near() -> None:
    # Centres up to 4 x 0.037 = 0.148 m apart are linked: the first three in a row, and two others.
    places = [[-0.4, 0.0], [-0.26, 0.0], [-0.12, 0.0], [0.3, 0.0], [0.3, 0.14], [0.0, 0.5]]
    (turn,) = _turns(_goal(goal="gather"), _level(places, places), [places])
    assert turn.measured["largest_cluster"] == pytest.approx(3 / 6)


def test_the_floor_is_where_a_robot_can_stand_and_seen_within_infrared_range() -> None:
    level = _level([[0.2, 0.0]], [[0.5, 0.5]], boxes=[[-0.3, 0.2, 0.5, 0.1, 0.05]])
    goal = _goal(goal="cover")
    state, first = goal.begin(level)
    middle = 1.2 * ((np.arange(CELLS) + 0.5) / CELLS - 0.5)
    cell = np.array([[x, y] for y in middle for x in middle])
    # The distance to the box by its corners and edges, in its own frame.
    away = (cell - [-0.3, 0.2]) @ np.array(
        [[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]]
    )
    box = np.linalg.norm(np.maximum(np.abs(away) - [0.1, 0.05], 0.0), axis=-1)
    stands = (box >= HULL) & (0.6 - np.abs(cell).max(axis=-1) >= HULL)
    assert state.size == stands.sum() < CELLS**2
    far = np.linalg.norm(cell - [0.2, 0.0], axis=-1)
    np.testing.assert_allclose(first[0], cell[np.where(stands, far, 9).argmin()], atol=1e-6)
    (turn,) = _turns(goal, level, [[[0.2, 0.0]]])
    sees = stands & (far <= REACH)
    assert turn.measured["floor_seen"] == pytest.approx(sees.sum() / stands.sum())
    left = np.where(stands & ~sees, far, 9)
    assert np.linalg.norm(turn.target[0] - [0.2, 0.0]) == pytest.approx(left.min(), abs=1e-6)
    assert turn.earns.tolist() == [True]
    assert turn.arrived.tolist() == [False]


def test_the_floor_is_covered_when_nearly_all_of_it_has_been_seen() -> None:
    level = _level([[0.0, 0.0]], [[0.5, 0.5]], side=0.4)
    places = [[[x, y]] for x in (-0.1, 0.0, 0.1) for y in (-0.1, 0.0, 0.1)]
    found = _turns(_goal(goal="cover"), level, places)
    shares = [float(turn.measured["floor_seen"]) for turn in found]
    assert shares == sorted(shares)
    assert [bool(turn.arrived[0]) for turn in found] == [share >= 0.95 for share in shares]
    assert found[-1].arrived[0]


@pytest.mark.parametrize("task", BUILT_IN, ids=lambda task: f"{task.goal}-{task.arrival}")
def test_jax_and_numpy_agree_for_one_arena_and_for_many(task: TaskConfig) -> None:
    draw, goal = np.random.default_rng(5), goals.load(task, RobotConfig())
    places = draw.uniform(-0.5, 0.5, (2, 4, 2)).tolist()
    levels = [_level([*place[:-1], None], place[::-1]) for place in places]
    many = jax.tree.map(lambda *fields: np.stack(fields), *levels)
    state, target = goal.begin(many)
    for clock in range(1, 5):
        near = target + draw.uniform(-0.08, 0.08, target.shape)
        views = [
            _view(level._replace(target=target[i]), near[i].tolist(), clock=clock)
            for i, level in enumerate(levels)
        ]
        view = jax.tree.map(lambda *fields: np.stack(fields), *views)
        turn = goal.advance(state, many._replace(target=target), view)
        for i, level in enumerate(levels):
            mine = jax.tree.map(lambda x: jnp.asarray(x[i]), state)  # noqa: B023
            parts = (level._replace(target=target[i]), views[i])
            one = jax.jit(goal.advance)(mine, *jax.tree.map(jnp.asarray, parts))
            # float32 rounds places of up to 0.6 m, and rates of up to 10^3 a minute by 1e-7.
            jax.tree.map(
                lambda a, b: np.testing.assert_allclose(a, b[i], rtol=1e-6, atol=1e-6),  # noqa: B023
                one,
                turn,
            )
        state, target = turn.state, np.asarray(turn.target)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (
            {"goal": "gather", "arrival": "hold"},
            "arrival is hold, but goal is gather and does not use arrival: leave arrival at latch, "
            "or give goal=navigate.",
        ),
        (
            {"target_speed": 0.1, "reward": RewardConfig(path_progress=1.0)},
            "reward.path_progress is 1, but targets move: give 0, or goal=navigate with "
            "target_speed=0.",
        ),
    ],
)
def test_what_a_goal_does_not_read_is_refused(given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ConfigError) as caught:
        TaskConfig(**given)
    assert str(caught.value) == sentence


def test_an_unknown_goal_is_refused() -> None:
    with pytest.raises(ConfigError) as caught:
        _goal(goal="gathr")
    assert str(caught.value) == (
        "task.goal is 'gathr': give one of navigate, lifelong, gather, cover, or add "
        "extensions=FILE, the Python file that defines this goal."
    )
