"""Checks starts at a given way from their targets, by hand and with geometry of the tests' own."""

import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmjax.config import ConfigError, build
from swarmjax.sim import gaps
from swarmjax.task import geodesic, level, room, stage_files, ways
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level, Spacing
from swarmjax.task.placement import UNITS
from swarmjax.task.stage_config import StageConfig, complete

HULL, REACH = 0.037, 0.05  # m
MAP = ["#########", "#SS.#.TT#", "#SS.#.TT#", "#...#...#", "#.......#", "#########"]
STAGES = [
    {"name": "open", "robots": 5, "side": 1.2, "distance": 0.08},
    {"name": "boxes", "robots": 5, "side": 1.2, "obstacles": 3, "distance": [0.2, 0.6]},
    {"name": "trap", "robots": 1, "side": 1.2, "level": "trap", "width": 0.3, "depth": 0.3},
    {"name": "maze", "robots": 3, "side": 1.2, "level": "maze", "cells": 3},
    {"name": "map", "robots": 3, "map": MAP, "cell": 0.15},
    {"name": "free", "robots": 5, "side": 1.2},
]
DISTANCES = {"trap": 0.5, "maze": 0.6, "map": 0.9}
LEVELS = 100  # of each stage


def _stage(plain: dict) -> StageConfig:
    distance = DISTANCES.get(plain["name"])
    return build(StageConfig, complete(plain | ({"distance": distance} if distance else {})))


CONFIGS = {each["name"]: _stage(each) for each in STAGES}
SPACING = Spacing(5, max(s.obstacles for s in CONFIGS.values()), HULL, REACH)
STACKED = task_stage.stack(list(CONFIGS.values()))
UNIFORMS = np.random.default_rng(5).random((LEVELS, level.uniform_count(SPACING)), np.float32)


@pytest.fixture(scope="module")
def levels() -> dict[str, Level]:
    """Levels [N] of each stage, drawn with JAX."""
    names = list(CONFIGS)
    one = {name: task_stage.select(STACKED, np.intp(names.index(name))) for name in names}

    @jax.jit
    @chex.assert_max_traces(n=1)  # for all stages
    def draw(uniforms: np.ndarray, stage: task_stage.Stage) -> Level:
        return jax.vmap(lambda each: level.sample(each, stage, SPACING, jnp))(uniforms)

    return {name: jax.tree.map(np.asarray, draw(UNIFORMS, one[name])) for name in names}


def _each(drawn: Level, count: int = LEVELS) -> list[Level]:
    return [Level(*(field[i] for field in drawn)) for i in range(count)]


@pytest.mark.parametrize("name", CONFIGS)
def test_numpy_and_jax_choose_the_same_starts(name: str, levels: dict[str, Level]) -> None:
    stage = task_stage.select(STACKED, np.intp(list(CONFIGS).index(name)))
    for uniforms, drawn in zip(UNIFORMS[:20], _each(levels[name]), strict=False):
        mine = level.sample(uniforms, stage, SPACING, np)
        assert all(np.array_equal(a, b) for a, b in zip(mine, drawn, strict=True))


@pytest.mark.parametrize("name", ["open", "boxes", "trap", "maze", "map"])
def test_ways_have_the_length_that_the_stage_gives(name: str, levels: dict[str, Level]) -> None:
    drawn, stage = levels[name], CONFIGS[name]
    length = jax.vmap(lambda each: geodesic.begin(each, HULL).distance)(drawn)
    length = np.asarray(length)[drawn.present]
    low, high = np.broadcast_to(np.array(stage.distance), 2)
    # The rounding of each leg to 1/4096 m, and the path's own corners: 1 %.
    assert (length >= 0.99 * low).all()
    assert (length <= 1.01 * high).all()
    if low < high:
        assert length.min() < low + 0.1 * (high - low)
        assert length.max() > high - 0.1 * (high - low)


@pytest.mark.parametrize("name", CONFIGS)
def test_robots_touch_nothing_where_they_start(name: str, levels: dict[str, Level]) -> None:
    for drawn in _each(levels[name]):
        gap = gaps.gaps(drawn.start, drawn.side, drawn.obstacle, HULL, np)[drawn.present]
        assert np.nanmin(gap, initial=1.0) > 0.0
        away = np.linalg.norm(drawn.start[:, None, :2] - drawn.target[None], axis=-1)
        assert away[drawn.present][:, drawn.present].min() > REACH


def test_a_stage_without_a_distance_keeps_its_starts(levels: dict[str, Level]) -> None:
    plain = StageConfig(name="free", robots=5, side=1.2)
    one = task_stage.single(plain)
    for uniforms, drawn in zip(UNIFORMS[:20], _each(levels["free"]), strict=False):
        mine = level.sample(uniforms, one, SPACING, np)
        assert np.array_equal(mine.start, drawn.start)


def _walled(seed: int) -> Level:
    """A wall of 1 m by 2 cm in the middle of 2 m, and a target 0.3 m behind it."""
    return Level(
        side=np.float32(2.0),
        present=np.ones(1, bool),
        start=np.array([[-0.3, 0.0, 0.0]], np.float32),
        target=np.array([[0.3, 0.0]], np.float32),
        obstacle_present=np.ones(1, bool),
        obstacle=np.array([[0.0, 0.0, 0.0, 0.01, 0.5]], np.float32),
        seed=np.uint32(seed),
    )


def test_the_way_leads_round_the_end_of_a_wall() -> None:
    edge, end = 0.01 + 0.9 * HULL, 0.5 + 0.9 * HULL  # corners are 0.9 of a hull away
    last = 2 * edge + math.hypot(0.3 - edge, end)
    behind = 0
    for seed in range(60):
        place, has_way, _ = ways.starts(_walled(seed), np.array([4096, 4096]), HULL, REACH, np)
        x, y = place[0] / UNITS
        assert has_way[0]
        if x < -edge and abs(y) < end:  # the wall hides the target
            behind += 1
            way = last + min(math.hypot(x + edge, y - sign * end) for sign in (1, -1))
            assert way == pytest.approx(1.0, rel=0.01)  # rounding, as above
        elif x > 0.0:
            assert math.hypot(x - 0.3, y) == pytest.approx(1.0, rel=0.01)
    assert behind > 5


def test_a_level_without_room_at_the_way_keeps_its_starts() -> None:
    plain = _walled(3)
    closed = [(0.2, 0.0, 0.0, 0.01, 0.1), (0.4, 0.0, 0.0, 0.01, 0.1)]
    closed += [(0.3, 0.1, 0.0, 0.1, 0.01), (0.3, -0.1, 0.0, 0.1, 0.01)]
    shut = plain._replace(obstacle=np.array(closed, np.float32), obstacle_present=np.ones(4, bool))
    one = Spacing(1, 4, HULL, REACH)
    for drawn, moves in ((plain, True), (shut, False)):
        moved = level._at_distance(drawn, np.array([4096, 4096]), one, np)
        assert np.array_equal(moved.start, drawn.start) == (not moves)


@given(st.integers(0, 2**30))
def test_roots_are_whole_and_exact(square: int) -> None:
    assert ways._root(np.array([square], np.int32), np)[0] == math.isqrt(square)


@pytest.mark.parametrize(
    ("distance", "message"),
    [
        (0.06, "a robot arrives within 0.05 m of its target: give at least 0.07"),
        (
            3.0,
            "in 16 sampled levels no robot has a path of this length to its target: give a smaller",
        ),
    ],
)
def test_a_distance_that_no_level_has_is_refused(distance: float, message: str) -> None:
    stage = StageConfig(name="x", robots=5, side=1.2, distance=distance)
    with pytest.raises(ConfigError, match=message):
        room.check([stage], SPACING)


def test_an_arena_without_any_obstacle_has_ways() -> None:
    stage = task_stage.single(StageConfig(name="x", robots=2, side=0.7, distance=0.2))
    spacing = Spacing(2, 0, HULL, REACH)
    uniforms = UNIFORMS[0, : level.uniform_count(spacing)]
    for xp in (np, jnp):
        drawn = level.sample(uniforms, stage, spacing, xp)
        away = np.linalg.norm(np.asarray(drawn.start[:, :2] - drawn.target), axis=-1)
        np.testing.assert_allclose(away, 0.2, rtol=0.01)  # rounding, as above


def test_a_fixed_level_takes_no_distance() -> None:
    with pytest.raises(
        ConfigError, match="level is fixed, which sets the starts itself: leave distance"
    ):
        StageConfig(name="x", robots=2, side=1.2, level="fixed", distance=0.3)


LAYOUTS = {
    "world_trap": 0.4,
    "world_fence": 0.3,
    "world_bay": 0.3,
    "world_row": 0.3,
    "world_door": 0.3,
    "world_maze": 0.5,
    "world_circle10": 0.3,
    "world_crowd10": 0.15,
    "world_dense": 0.3,
    "world_blocks": 0.3,
    "map": 0.9,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LAYOUTS)
def test_ten_thousand_levels_of_each_layout(name: str) -> None:
    plain = STAGES[4] if name == "map" else stage_files.read_stage(name)
    stage = build(StageConfig, complete(plain | {"distance": LAYOUTS[name]}))
    spacing = Spacing(stage.robots, stage.obstacles, HULL, REACH)
    arrays = jax.tree.map(jnp.asarray, task_stage.single(stage))
    ends = np.array(stage.distance_units)

    def measured(uniforms: jax.Array) -> tuple[jax.Array, ...]:
        drawn = level.sample(uniforms, arrays, spacing, jnp)
        _, has_way, has_room = ways.starts(drawn, ends, HULL, REACH, jnp)
        gap = jnp.min(gaps.gaps(drawn.start, drawn.side, drawn.obstacle, HULL, jnp), axis=-1)
        return geodesic.begin(drawn, HULL).distance, gap, has_way & has_room, drawn.present

    measure = jax.jit(jax.vmap(measured))
    random, right = np.random.default_rng(6), []
    for _ in range(10):
        uniforms = random.random((1000, level.uniform_count(spacing)), np.float32)
        length, gap, has_way, present = (np.asarray(each) for each in measure(uniforms))
        assert (gap[present] > 0.0).all()
        right.append(np.abs(length / stage.distance - 1)[present & has_way] < 0.01)
        assert has_way[present].mean() > 0.9  # the others have no room at this way
    # A line of sight that grazes a wall by less than 1/4096 m is decided otherwise in float32.
    assert np.concatenate(right).mean() > 0.9999
