"""Tests the guarantees of each layout, bit-equal draws in NumPy and JAX, and refused numbers."""

import functools
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import plans
import pytest

from swarmjax.config import build, to_dict
from swarmjax.task import level, room, stage_files
from swarmjax.task import stage as task_stage
from swarmjax.task.layouts import LAYOUTS, maze
from swarmjax.task.level import Level, Spacing
from swarmjax.task.stage_config import PASSAGE, StageConfig
from tests.sentences import refusal

HULL, REACH = 0.037, 0.05  # m; radii of an e-puck and its zone of arrival
ROUNDING = 1.0 / 1024  # m; corners are rounded to units of 1/4096 m
# Settings of each layout beyond those on which its stage file trains.
FAR: dict[str, dict[str, Any]] = {
    "trap": {"depth": 0.4, "width": 0.3},
    "fence": {"length": 0.7},
    "bay": {"side": 1.8},
    "row": {"robots": 6},
    "door": {"gap": 0.11},
    "maze": {"cells": 5, "side": 2.0},
    "blocks": {"cells": 6, "side": 0.9, "robots": 5},
    "circle": {"robots": 20},
    "crowd": {"robots": 44, "side": 1.3},
    "plots": {"robots": 1024, "side": 17.2, "obstacles": 256},
}


# Crowds and circles need robots that move at once; blocks may leave no way to pass each other.
UNPLANNED = {"crowd", "circle", "blocks", "plots"}


def _stage(name: str, **changed: Any) -> StageConfig:
    choice = f"world_{name}"
    return build(StageConfig, {**stage_files.read_stage(choice), **changed})


def _spacing(stage: StageConfig) -> Spacing:
    return Spacing(stage.robots, stage.obstacles, HULL, REACH)


def _uniforms(spacing: Spacing, count: int) -> np.ndarray:
    random = np.random.default_rng(5)
    return random.random((count, level.uniform_count(spacing)), dtype=np.float32)


@functools.cache
def _levels(name: str, count: int = 40, *, far: bool = False) -> list[Level]:
    stage = _stage(name, **(FAR[name] if far else {}))
    arrays, spacing = task_stage.single(stage), _spacing(stage)
    return [level.sample(each, arrays, spacing, np) for each in _uniforms(spacing, count)]


def _from_boxes(drawn: Level, places: np.ndarray) -> np.ndarray:
    """Returns the distance [...] from points [..., 2] to the nearest wall inside the arena, m."""
    boxes = drawn.obstacle[drawn.obstacle_present]
    if not len(boxes):
        return np.full(places.shape[:-1], np.inf)
    # No layout has a turned wall.
    away = np.abs(places[..., None, :] - boxes[:, :2]) - boxes[:, 3:]
    return np.linalg.norm(np.maximum(away, 0.0), axis=-1).min(axis=-1)


def _least(places: np.ndarray) -> float:
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    return float(apart[~np.eye(len(places), dtype=bool)].min(initial=np.inf))


@pytest.mark.parametrize("name", LAYOUTS)
def test_robots_start_clear_of_walls_and_each_other(name: str) -> None:
    for drawn in _levels(name):
        start, half = drawn.start[:, :2], 0.5 * drawn.side
        assert np.abs(start).max() <= half - HULL
        assert _from_boxes(drawn, start).min() >= HULL
        assert _least(start) >= 2.0 * HULL


@pytest.mark.parametrize("name", LAYOUTS)
def test_targets_have_room_for_a_robot_each(name: str) -> None:
    for drawn in _levels(name):
        assert np.abs(drawn.target).max() <= 0.5 * drawn.side - HULL
        assert _from_boxes(drawn, drawn.target).min() >= HULL
        assert _least(drawn.target) >= 2.0 * HULL


@pytest.mark.parametrize("name", LAYOUTS)
def test_no_robot_starts_where_it_has_arrived(name: str) -> None:
    for drawn in _levels(name):
        assert np.linalg.norm(drawn.start[:, :2] - drawn.target, axis=-1).min() > REACH


@pytest.mark.parametrize("far", [False, True])
def test_plots_keep_passages_between_boxes_and_targets_apart(*, far: bool) -> None:
    for drawn in _levels("plots", 5, far=far):
        boxes = drawn.obstacle[:, :2]
        assert _least(boxes) >= drawn.obstacle[0, 3] * 2 + PASSAGE
        assert _least(drawn.target) >= 0.25 - ROUNDING
        assert _from_boxes(drawn, drawn.target).min() >= 0.15


def test_plots_use_the_whole_arena() -> None:
    start = np.concatenate([drawn.start[:, :2] / drawn.side for drawn in _levels("plots")])
    counts = np.histogram2d(*start.T, bins=4, range=[(-0.5, 0.5)] * 2)[0]
    # 500 expected in each square; the standard deviation of such a count is 22.
    np.testing.assert_allclose(counts, 500, atol=100)


@pytest.mark.parametrize("name", LAYOUTS)
def test_numpy_and_jax_draw_the_same_bits(name: str) -> None:
    _assert_same_bits(name, 20)


@pytest.mark.slow
@pytest.mark.parametrize("name", LAYOUTS)
def test_numpy_and_jax_draw_the_same_bits_of_ten_thousand_levels(name: str) -> None:
    _assert_same_bits(name, 10_000)


def _assert_same_bits(name: str, count: int) -> None:
    stage = _stage(name)
    spacing, arrays = _spacing(stage), task_stage.single(stage)
    uniforms = _uniforms(spacing, count)
    ours = jax.tree.map(jnp.asarray, arrays)
    draw = jax.jit(lambda us: jax.lax.map(lambda u: level.sample(u, ours, spacing, jnp), us))
    drawn = [np.asarray(field) for field in draw(uniforms)]
    for number, each in enumerate(_levels(name, count)):
        for mine, theirs in zip(drawn, each, strict=True):
            np.testing.assert_array_equal(mine[number], theirs)


@pytest.mark.parametrize(
    "far", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["near", "far"]
)
@pytest.mark.parametrize("name", sorted(LAYOUTS.keys() - UNPLANNED))
def test_a_plan_shows_that_every_level_can_be_solved(name: str, *, far: bool) -> None:
    for drawn in _levels(name, far=far)[:5]:
        moves = plans.find(drawn, HULL, REACH)
        assert moves is not None
        assert plans.check(drawn, moves, HULL, REACH) is None


@pytest.mark.slow
def test_a_plan_exchanges_a_circle() -> None:
    (drawn,) = _levels("circle", 1)
    moves = plans.find(drawn, HULL, REACH)
    assert moves is not None
    assert plans.check(drawn, moves, HULL, REACH) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(LAYOUTS.keys() - UNPLANNED))
def test_a_thousand_levels_can_be_solved(name: str) -> None:
    for drawn in _levels(name, 1000):
        moves = plans.find(drawn, HULL, REACH)
        assert moves is not None
        assert plans.check(drawn, moves, HULL, REACH) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", LAYOUTS)
def test_ten_thousand_levels_are_sound(name: str) -> None:
    for drawn in _levels(name, 10_000):
        for places in (drawn.start[:, :2], drawn.target):
            assert np.abs(places).max() <= 0.5 * drawn.side - HULL
            assert _from_boxes(drawn, places).min() >= HULL
            assert _least(places) >= 2.0 * HULL
        assert np.linalg.norm(drawn.start[:, :2] - drawn.target, axis=-1).min() > REACH


# What each layout is


def test_the_straight_line_leads_into_a_trap() -> None:
    for drawn in _levels("trap"):
        share = np.linspace(0.0, 1.0, 400)[:, None]
        line = drawn.start[0, :2] + share * (drawn.target[0] - drawn.start[0, :2])
        back = drawn._replace(obstacle=drawn.obstacle[:1], obstacle_present=np.ones(1, bool))
        sides = drawn._replace(obstacle=drawn.obstacle[1:], obstacle_present=np.ones(2, bool))
        assert _from_boxes(back, line).min() == 0.0
        assert _from_boxes(sides, line).min() >= HULL


def test_a_trap_is_as_deep_and_wide_as_its_stage_says() -> None:
    stage = _stage("trap")
    depths, widths = [], []
    for drawn in _levels("trap"):
        back, *sides = drawn.obstacle
        along = int(np.argmin(back[3:]))  # the axis along which the trap is deep
        depths.append(2.0 * sides[0][3 + along])
        widths.append(abs(sides[0][1 - along] - sides[1][1 - along]) - 2.0 * sides[0][4 - along])
    for found, said in ((depths, stage.depth), (widths, stage.width)):
        assert isinstance(said, tuple)
        assert min(found) >= said[0] - 2 * ROUNDING
        assert max(found) <= said[1] + 2 * ROUNDING
        assert max(found) - min(found) > 0.5 * (said[1] - said[0])


def test_a_door_lets_one_robot_through() -> None:
    stage = _stage("door", gap=0.13)
    arrays, spacing = task_stage.single(stage), _spacing(stage)
    for uniforms in _uniforms(spacing, 20):
        drawn = level.sample(uniforms, arrays, spacing, np)
        first, second = drawn.obstacle[:2]
        across = int(np.argmax(first[3:]))
        ends = sorted((first, second), key=lambda box: box[across])
        gap = ends[1][across] - ends[1][3 + across] - ends[0][across] - ends[0][3 + across]
        assert gap == pytest.approx(0.13, abs=2 * ROUNDING)


def test_two_flows_meet_at_a_door_and_no_target_is_near_it() -> None:
    for drawn in _levels("door"):
        wall = drawn.obstacle[0]
        along = int(np.argmin(wall[3:]))
        side_of = {
            key: np.sign(places[:, along] - wall[along])
            for key, places in (("start", drawn.start), ("target", drawn.target))
        }
        assert (side_of["start"] == -side_of["target"]).all()
        assert side_of["start"].sum() == 0.0
        ends = np.concatenate(
            [box[:2] + sign * box[3:] for box in drawn.obstacle[:2] for sign in (-1, 1)]
        )
        door = ends.reshape(-1, 2)
        middle = _middle_of_gap(drawn, along)
        assert np.linalg.norm(drawn.target - middle, axis=-1).min() >= 0.25 - ROUNDING
        assert len(door) == 4


def _middle_of_gap(drawn: Level, along: int) -> np.ndarray:
    across = 1 - along
    low, high = sorted(drawn.obstacle[:2], key=lambda box: box[across])
    middle = np.empty(2)
    middle[along] = low[along]
    middle[across] = 0.5 * (low[across] + low[3 + across] + high[across] - high[3 + across])
    return middle


def test_an_arena_may_be_narrower_than_it_is_long() -> None:
    for drawn in _levels("door"):
        bars = drawn.obstacle[2:4]
        across = int(np.argmin(bars[0, 3:]))
        inner = np.abs(bars[:, across]) - bars[:, 3 + across]
        np.testing.assert_allclose(inner, 0.5, atol=ROUNDING)
        assert (np.abs(drawn.start[:, across]) < 0.5).all()


def test_every_cell_of_a_maze_has_two_ways_out() -> None:
    pairs = maze.edges(4)
    for drawn in _levels("maze"):
        open_ = ~drawn.obstacle_present
        ways = np.bincount(pairs[open_].ravel(), minlength=16)
        assert ways.min() >= 2
        assert _joined(pairs[open_], 16) == 1


def _area(free: set[tuple[int, int]], first: tuple[int, int]) -> set[tuple[int, int]]:
    """Returns the free cells that steps between neighbours reach."""
    found, ahead = {first}, [first]
    while ahead:
        x, y = ahead.pop()
        beside = {(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)}
        ahead += (beside & free) - found
        found |= beside & free
    return found


def test_robots_and_targets_among_blocks_lie_in_one_area_that_is_the_largest() -> None:
    blocked = []
    for drawn in _levels("blocks", 200):
        cell = np.floor((drawn.obstacle[:, :2] + 0.3) / 0.12).astype(int)
        walls = {tuple(each) for each in cell[drawn.obstacle_present].tolist()}
        free = {(x, y) for x in range(5) for y in range(5)} - walls
        areas = [_area(free, each) for each in free]
        ends = np.concatenate([drawn.start[:, :2], drawn.target])
        used = {tuple(each) for each in np.floor((ends + 0.3) / 0.12).astype(int).tolist()}
        assert len(used) == 6
        assert used <= max((area for area in areas if used & area), key=len)
        assert max(map(len, areas)) == len(_area(free, next(iter(used))))
        blocked.append(len(walls))
    assert (min(blocked), max(blocked)) == (0, 10)  # at most 0.4 of 25 cells


def test_mazes_keep_walls_and_differ() -> None:
    walls = np.array([drawn.obstacle_present for drawn in _levels("maze")])
    assert walls.sum(axis=1).min() >= 4
    assert len(np.unique(walls, axis=0)) > 35


def _joined(pairs: np.ndarray, count: int) -> int:
    """Returns the number of connected components of a graph."""
    label = np.arange(count)
    for _ in range(count):
        for one, other in pairs:
            label[[one, other]] = label[[one, other]].min()
    return len(np.unique(label))


def test_targets_of_a_row_stand_one_behind_another() -> None:
    for drawn in _levels("row"):
        steps = np.diff(drawn.target, axis=0)
        np.testing.assert_allclose(np.abs(steps).sum(axis=-1), 0.16, atol=ROUNDING)
        assert (np.abs(steps).min(axis=-1) == 0.0).all()


def test_robots_on_a_circle_change_places() -> None:
    for drawn in _levels("circle"):
        np.testing.assert_allclose(drawn.target, -drawn.start[:, :2], atol=ROUNDING)
        np.testing.assert_allclose(np.linalg.norm(drawn.target, axis=-1), 0.8, atol=ROUNDING)
        angles = np.sort(np.arctan2(drawn.target[:, 1], drawn.target[:, 0]))
        np.testing.assert_allclose(np.diff(angles), 2.0 * np.pi / 16, atol=0.003)


@pytest.mark.parametrize("count", [40, pytest.param(10_000, marks=pytest.mark.slow)])
def test_robots_on_a_circle_arrive_by_all_driving_around_it(count: int) -> None:
    """Rotates all robots half way round at once, which keeps the distances between them."""
    angles = np.linspace(0.0, np.pi, 65)
    turns = np.stack([np.cos(angles), -np.sin(angles), np.sin(angles), np.cos(angles)], axis=-1)
    for drawn in _levels("circle", count):
        way = np.einsum("tij,rj->tri", turns.reshape(-1, 2, 2), drawn.start[:, :2])
        assert np.abs(way).max() <= 0.5 * drawn.side - HULL
        assert min(_least(places) for places in way) >= 2.0 * HULL
        assert np.linalg.norm(way[-1] - drawn.target, axis=-1).max() < REACH


def test_starts_of_a_crowd_lie_outside_every_zone_of_arrival() -> None:
    for drawn in _levels("crowd"):
        apart = np.linalg.norm(drawn.start[:, None, :2] - drawn.target[None], axis=-1)
        assert apart.min() > REACH


def test_most_targets_of_a_crowd_are_apart_as_asked() -> None:
    for drawn in _levels("crowd"):
        apart = np.linalg.norm(drawn.target[:, None] - drawn.target[None], axis=-1)
        apart[np.eye(40, dtype=bool)] = np.inf
        assert np.mean(apart.min(axis=-1) >= 0.14 - ROUNDING) > 0.7


def test_layouts_are_turned_and_mirrored() -> None:
    ways = np.array([drawn.target[0] - drawn.start[0, :2] for drawn in _levels("trap")])
    heading = np.round(np.arctan2(ways[:, 1], ways[:, 0]) / (np.pi / 2)) % 4
    assert set(heading) == {0.0, 1.0, 2.0, 3.0}


def test_other_stages_of_a_program_are_drawn_as_alone() -> None:
    # The third stage is placed at random. Only a stack of laid-out stages has `laid_out`.
    stages = [
        _stage("trap"),
        _stage("fence"),
        StageConfig(name="s", robots=5, side=1.2, obstacles=3),
    ]
    spacing = Spacing(5, 3, HULL, REACH)
    both = task_stage.stack(stages)
    assert both.laid_out is None
    assert task_stage.stack(stages[:2]).laid_out is not None
    for number, stage in enumerate(stages):
        alone = task_stage.single(stage)
        for uniforms in _uniforms(spacing, 5):
            mine = level.sample(uniforms, task_stage.select(both, np.intp(number)), spacing, np)
            theirs = level.sample(uniforms, alone, spacing, np)
            np.testing.assert_array_equal(mine.target, theirs.target)
            np.testing.assert_array_equal(mine.obstacle, theirs.obstacle)


# Bad numbers


def _change(name: str, **changed: Any) -> None:
    stage = _stage(name, **changed)
    room.check([stage], _spacing(stage))


@pytest.mark.parametrize(
    ("name", "changed", "said"),
    [
        ("trap", {"side": 0.5}, "stage world_trap: level=trap has no room for 1 robots, because "),
        ("door", {"gap": 0.07}, "gap is 0.07: give 0.08 to 1."),
        ("maze", {"cells": None}, "cells is missing: level=maze needs cells."),
        ("row", {"apart": None}, "apart is missing: level=row needs gap and apart."),
        ("circle", {"depth": 0.2}, "depth is 0.2, but level is circle, which has no depth: leave "),
        ("bay", {"robots": 3}, "robots is 3, but level=bay has room for 2: give at most 2."),
        (
            "fence",
            {"side": 0.4},
            "stage world_fence: level=fence has no room for 5 robots, because ",
        ),
        (
            "crowd",
            {"side": 0.6},
            "stage world_crowd: level=crowd has no room for 40 robots, because ",
        ),
        (
            "circle",
            {"radius": 0.15},
            "stage world_circle: level=circle has no room for 16 robots, ",
        ),
        (
            "plots",
            {"side": 3.0},
            "side is 3, too small for robots=200 and obstacles=50 on plots: give at least 4.4.",
        ),
        ("crowd", {"robots": 101}, "robots is 101, but level is crowd: give at most 100, or level"),
        (
            "plots",
            {"robots": 20, "obstacles": 5, "side": 5.0, "distance": 0.5},
            "side is 5, but distance is 0.5: give at most 4, or no distance.",
        ),
        ("maze", {"side": 5.0}, "side is 5, but level is maze: give at most 4, or level=plots."),
    ],
)
def test_refuses_numbers_without_room(name: str, changed: dict[str, Any], said: str) -> None:
    assert refusal(partial(_change, name, **changed)).startswith(said)


def test_a_layout_sets_its_number_of_walls() -> None:
    given = to_dict(_stage("trap")) | {"obstacles": 5}
    assert build(StageConfig, given).obstacles == 3
