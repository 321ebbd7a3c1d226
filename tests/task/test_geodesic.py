"""Tests shortest paths around walls and boxes by hand, against the judge and as a reward."""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.evaluate.shortest_path import shortest
from swarmjax.run.load_settings import load_train
from swarmjax.sim import physics
from swarmjax.sim.config import SimConfig
from swarmjax.task import env, extended, geodesic, level
from swarmjax.task import stage as task_stage
from swarmjax.task import world as task_world
from swarmjax.task.config import RewardConfig, TaskConfig
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig
from swarmjax.task.world import World
from swarmjax.training import program as programs

HULL = 0.037  # m
CORNER = 0.9 * HULL  # m, in x and in y, from an obstacle to a turn of a path
TARGET = 0.05  # m
# m; covers float32 sums of a few lengths of about 1 m.
ROUND = 1e-6
# A wall of 0.4 m from south to north, between a robot in the west and a target in the east.
WALL = [0.0, 0.0, 0.0, 0.01, 0.2]


def _level(start: list[float], target: list[float], boxes: list[list[float]]) -> Level:
    return Level(
        side=np.float32(1.0),
        present=np.ones(1, bool),
        start=np.float32([[*start, 0.0]]),
        target=np.float32([target]),
        obstacle_present=np.ones(len(boxes), bool),
        obstacle=np.asarray(boxes, np.float32).reshape(-1, 5),
        seed=np.uint32(0),
    )


def _distance(drawn: Level) -> float:
    return float(jax.jit(partial(geodesic.begin, hull_radius=HULL))(drawn).distance[0])


def test_the_path_is_straight_where_nothing_is_in_the_way() -> None:
    assert _distance(_level([-0.3, 0.0], [0.1, 0.3], [])) == pytest.approx(0.5, abs=ROUND)


def test_a_box_beside_the_line_changes_nothing() -> None:
    beside = [0.0, 0.1, 0.0, 0.05, 0.05]  # its near edge is 0.05 m off the line
    assert _distance(_level([-0.3, 0.0], [0.3, 0.0], [beside])) == pytest.approx(0.6, abs=ROUND)


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_the_path_turns_at_the_near_end_of_a_wall(quarters: int) -> None:
    turn = 0.5 * np.pi * quarters
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    start, target = (list(rotation @ place) for place in ([-0.3, 0.1], [0.3, 0.1]))
    wall = [0.0, 0.0, turn, *WALL[3:]]
    # The path turns on both sides of the wall's end: at x = +-(0.01 + CORNER), y = 0.2 + CORNER.
    across, up = 0.01 + CORNER, 0.2 + CORNER - 0.1
    expected = 2.0 * np.hypot(0.3 - across, up) + 2.0 * across
    assert _distance(_level(start, target, [wall])) == pytest.approx(expected, abs=ROUND)


def test_a_gap_too_narrow_for_a_robot_is_no_way() -> None:
    # The two boxes are in line and leave a gap of 5 cm.
    north, south = [0.0, 0.475, 0.0, 0.01, 0.025], [0.0, -0.05, 0.0, 0.01, 0.45]
    drawn = _level([-0.3, 0.3], [0.3, 0.3], [north, south])
    found = jax.jit(partial(geodesic.survey, hull_radius=HULL))(drawn)
    barred = jax.jit(geodesic.measure, static_argnums=3)(found, drawn.start[:, :2], drawn, HULL)
    assert barred[0] == np.inf


def test_an_absent_obstacle_bars_no_path() -> None:
    drawn = _level([-0.3, 0.0], [0.3, 0.0], [WALL])
    absent = drawn._replace(obstacle_present=np.zeros(1, bool))
    assert _distance(absent) == pytest.approx(0.6, abs=ROUND)


def test_a_robot_without_a_path_keeps_its_distance() -> None:
    walls = [[0.0, 0.0, 0.0, 0.01, 0.6]]  # from wall to wall
    drawn = _level([-0.3, 0.0], [0.3, 0.0], walls)
    path = jax.jit(partial(geodesic.begin, hull_radius=HULL))(drawn)
    assert float(path.distance[0]) == pytest.approx(0.6, abs=ROUND)
    drawn = jax.tree.map(jnp.asarray, drawn)
    go_on = jax.jit(partial(geodesic.go_on, hull_radius=HULL))
    later = go_on(path, jnp.array([[-0.1, 0.2]]), drawn)
    assert float(later.distance[0]) == pytest.approx(0.6, abs=ROUND)


@pytest.fixture(
    scope="module",
    params=[
        "trap",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("fence", "maze", "clutter")),
    ],
)
def drawn(request: pytest.FixtureRequest) -> Level:
    """Returns thirty levels of one family of stages."""
    settings = load_train([f"stage=world_{request.param}", "arenas=8"])
    program, schedule = programs.load(settings)
    spacing = program.world.spacing
    numbers = np.random.default_rng(5).random((30, level.uniform_count(spacing)), np.float32)
    stage = task_stage.select(jax.tree.map(jnp.asarray, schedule.stages), jnp.int32(0))
    draw = partial(extended.draw, stage=stage, spacing=spacing, drawings=())
    return jax.jit(jax.vmap(draw))(numbers)


def test_paths_are_as_long_as_those_of_the_judge(drawn: Level) -> None:
    found = jax.jit(jax.vmap(partial(geodesic.begin, hull_radius=HULL)))(drawn).distance
    places = np.asarray(drawn.start)[..., :2]
    exact = shortest(drawn.side, places, drawn.target, drawn.obstacle, HULL, TARGET)
    there = np.asarray(drawn.present) & np.isfinite(exact)
    longer = (np.asarray(found) - TARGET - exact)[there]
    # Obstacles are widened by 0.8 of the hull's radius, which is 7 mm too little, and have square
    # corners. A turn by a right angle is therefore up to 2 - pi / 2 of 0.9 radii longer, 14 mm.
    # Paths have few turns.
    assert longer.min() > -2e-3
    assert longer.max() < 0.04


@pytest.mark.parametrize("height", [0.1, -0.1])
def test_the_waypoint_is_the_corner_at_the_near_end_of_a_wall(height: float) -> None:
    found = _waypoint(_level([-0.3, height], [0.3, height], [WALL]))
    corner = [-0.01 - CORNER, np.sign(height) * (0.2 + CORNER)]
    np.testing.assert_allclose(found, corner, atol=ROUND)


def test_the_waypoint_is_the_target_where_nothing_is_in_the_way() -> None:
    beside = [0.0, 0.1, 0.0, 0.05, 0.05]
    found = _waypoint(_level([-0.3, 0.0], [0.3, 0.0], [beside]))
    np.testing.assert_array_equal(found, np.float32([0.3, 0.0]))


def test_without_a_path_the_waypoint_is_the_target() -> None:
    walls = [[0.0, 0.0, 0.0, 0.01, 0.6]]  # from wall to wall
    drawn = _level([-0.3, 0.0], [0.3, 0.0], walls)
    path = geodesic.begin(drawn, HULL)
    # The robot keeps the distance of its start, which no path has from its new place.
    found = geodesic.waypoint(path, jnp.array([[-0.1, 0.2]]), jax.tree.map(jnp.asarray, drawn))
    np.testing.assert_array_equal(found[0], np.float32([0.3, 0.0]))


def test_the_waypoint_is_no_corner_of_an_absent_obstacle() -> None:
    drawn = _level([-0.3, 0.0], [0.3, 0.0], [WALL])
    found = _waypoint(drawn._replace(obstacle_present=np.zeros(1, bool)))
    np.testing.assert_array_equal(found, np.float32([0.3, 0.0]))


def _waypoint(drawn: Level) -> np.ndarray:
    drawn = jax.tree.map(jnp.asarray, drawn)

    def find(drawn: Level) -> jax.Array:
        return geodesic.waypoint(geodesic.begin(drawn, HULL), drawn.start[:, :2], drawn)

    return np.asarray(jax.jit(find)(drawn))[0]


@pytest.mark.slow
def test_a_step_towards_the_waypoint_shortens_the_path_by_at_least_as_much(drawn: Level) -> None:
    drawn = jax.tree.map(jnp.asarray, drawn)
    path = jax.jit(jax.vmap(partial(geodesic.begin, hull_radius=HULL)))(drawn)
    place, step = drawn.start[..., :2], 1e-3  # m
    away = jax.vmap(geodesic.waypoint)(path, place, drawn) - place
    length = jnp.linalg.norm(away, axis=-1, keepdims=True)
    go_on = jax.jit(jax.vmap(partial(geodesic.go_on, hull_radius=HULL)))
    shorter = path.distance - go_on(path, place + step * away / length, drawn).distance
    there = np.asarray(drawn.present & (length[..., 0] > step))
    # Lengths are below 5 m and have float32 errors of a few 1e-7 m. A step can bring a nearer
    # corner into view, and then shortens the path by more.
    assert np.asarray(shorter)[there].min() > step - 3e-6


class Driven(NamedTuple):
    """The first and last state of an episode, and its rewards, which are path progress alone."""

    world: World
    began: env.EnvState
    ended: env.EnvState
    rewards: np.ndarray


@pytest.fixture(scope="module")
def driven() -> Driven:
    """Drives a robot by random actions for 40 steps in front of a wall."""
    weights = RewardConfig(progress=0.0, path_progress=2.0, contact=0.0, step_penalty=0.0)
    stage = StageConfig(name="wall", robots=1, side=1.0, obstacles=1)
    sim = SimConfig(impl="jax", max_robots=1, max_obstacles=1)
    world = task_world.load([stage], task=TaskConfig(reward=weights), sim=sim)
    state = env.reset(world, _level([-0.3, 0.1], [0.3, 0.1], [WALL]))
    began = dataclasses.replace(state, sim=physics.unpack(world.physics, state.sim))
    actions = np.random.default_rng(2).uniform(-1.0, 1.0, (40, 1, 2)).astype(np.float32)

    def step(state: env.EnvState, action: jax.Array) -> tuple[env.EnvState, jax.Array]:
        state, came = env.step(world, state, action)
        return state, came.reward

    ended, rewards = jax.jit(lambda *given: jax.lax.scan(step, *given))(began, actions)
    return Driven(world, began, ended, np.asarray(rewards)[:, 0])


def test_rewards_add_up_to_how_much_shorter_the_path_is(driven: Driven) -> None:
    assert driven.began.path is not None
    assert driven.ended.path is not None
    shorter = float(driven.began.path.distance[0] - driven.ended.path.distance[0])
    assert abs(shorter) > 1e-3  # it moved
    # 1e-5 covers 40 float32 differences of numbers below 1.
    assert driven.rewards.sum() == pytest.approx(2.0 * shorter, abs=1e-5)


def test_an_arena_keeps_the_path_from_where_its_robot_is(driven: Driven) -> None:
    assert driven.ended.path is not None
    now = np.asarray(driven.ended.sim.qpos)[:2]
    drawn = _level(list(now), [0.3, 0.1], [WALL])
    assert float(driven.ended.path.distance[0]) == pytest.approx(_distance(drawn), abs=1e-5)


@pytest.mark.slow
def _look(world: World, state: env.EnvState) -> np.ndarray:
    return np.asarray(jax.jit(partial(env.look_around, world))(state))


def test_a_critic_of_the_state_sees_how_long_the_path_is(driven: Driven) -> None:
    assert driven.ended.path is not None
    seen = _look(driven.world, driven.ended)
    straight, path = driven.ended.distance[0], driven.ended.path.distance[0]
    assert path > straight + 0.05  # m; the wall is in the way
    assert seen[0, 3] == path


def test_a_critic_of_the_state_sees_where_the_path_leads(driven: Driven) -> None:
    seen = _look(driven.world, driven.ended)
    pose = physics.poses(driven.world.physics, driven.ended.sim)[0]
    corner = np.array([-0.01 - CORNER, 0.2 + CORNER])  # at the near end of the wall
    bearing = np.arctan2(*(corner - pose[:2])[::-1]) - pose[2]
    # 1e-4 covers float32 places within 0.1 m of the corner.
    np.testing.assert_allclose(seen[0, 4:6], [np.cos(bearing), np.sin(bearing)], atol=1e-4)


def test_without_paths_it_sees_the_straight_distance(driven: Driven) -> None:
    seen = _look(driven.world, dataclasses.replace(driven.ended, path=None))
    assert seen[0, 3] == driven.ended.distance[0]


def test_without_paths_it_sees_the_direction_of_the_target(driven: Driven) -> None:
    seen = _look(driven.world, dataclasses.replace(driven.ended, path=None))[0]
    np.testing.assert_allclose(seen[4:6], seen[:2] / np.hypot(*seen[:2]), atol=ROUND)


def test_without_its_weight_no_path_is_kept(tiny_world: World) -> None:
    drawn = jax.eval_shape(
        lambda: env.reset(
            tiny_world,
            level.sample(
                jnp.zeros(level.uniform_count(tiny_world.spacing)),
                task_stage.single(StageConfig(name="pair", robots=2, side=0.5)),
                tiny_world.spacing,
                jnp,
            ),
        )
    )
    assert drawn.path is None


def test_warp_finds_the_same_paths(drawn: Level) -> None:
    paths_warp = pytest.importorskip("swarmjax.sim.fast.paths_warp")
    plain = jax.jit(jax.vmap(partial(geodesic.begin, hull_radius=HULL)))(drawn)
    begin = partial(geodesic.begin, hull_radius=HULL, fast=paths_warp)
    fast = jax.jit(jax.vmap(begin))(drawn)
    there = np.asarray(drawn.present)
    # 1e-5 covers float32 sums of a few lengths below 5 m.
    np.testing.assert_allclose(fast.distance[there], plain.distance[there], atol=1e-5)
    both = np.isfinite(plain.roadmap.to_go) & there[..., None]
    np.testing.assert_allclose(fast.roadmap.to_go[both], plain.roadmap.to_go[both], atol=1e-5)
    assert (np.isfinite(fast.roadmap.to_go) == np.isfinite(plain.roadmap.to_go))[there].all()
