"""Tests arenas given as text: what a map means, which maps are refused, and drawn levels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sentences import refusal

from swarmjax.config import build
from swarmjax.task import level, maps, room, stage_config
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level, Spacing
from swarmjax.task.stage_config import StageConfig

ROOMS = """
    ############
    #SSS..#....#
    #SSS......T#
    #SSS......T#
    #SSS..#..TT#
    ############
"""
LETTERS = """
    ######
    #a..A#
    #.##.#
    #B..b#
    ######
"""
HULL, REACH = 0.037, 0.05
SPACING = Spacing(robots=5, obstacles=12, hull_radius=HULL, target_radius=REACH)
ROUNDING = 2 / 4096  # m: points are rounded to units of 1/4096 m


def _stage(text: str, robots: int, cell: float = 0.12) -> StageConfig:
    given = {"name": "drawn", "robots": robots, "map": text, "cell": cell}
    return build(StageConfig, stage_config.complete(given))


def _draw(stage: StageConfig, count: int) -> list[Level]:
    arrays = task_stage.single(stage)
    return [level.sample(each, arrays, SPACING, np) for each in _uniforms(count)]


def _uniforms(count: int) -> np.ndarray:
    random = np.random.default_rng(0)
    return random.random((count, level.uniform_count(SPACING)), dtype=np.float32)


# What a map says


def test_a_map_by_hand() -> None:
    # Four columns and two rows of 0.2 m make an arena 0.8 m wide, with 0.2 m of wall above and
    # below.
    found = maps.read(["#S.#", "#.T#"], 0.2)
    assert found.side == 0.8
    walls = sorted(found.wall.round(6).tolist())
    assert walls == [
        [-0.3, 0.0, 0.0, 0.1, 0.2],
        [0.0, -0.3, 0.0, 0.4, 0.1],
        [0.0, 0.3, 0.0, 0.4, 0.1],
        [0.3, 0.0, 0.0, 0.1, 0.2],
    ]
    # S is in the second column of the upper row: x from -0.2 to 0, y from 0 to 0.2.
    np.testing.assert_allclose(found.start.mean(axis=0), [-0.1, 0.1], atol=1e-12)
    np.testing.assert_allclose(found.target.mean(axis=0), [0.1, -0.1], atol=1e-12)
    assert len(found.start) == 36  # points 0.033 m apart


def test_letters_are_pairs() -> None:
    found = maps.read(["aB", "bA"], 0.2)
    np.testing.assert_allclose(found.pair, [[[-0.1, 0.1], [0.1, -0.1]], [[-0.1, -0.1], [0.1, 0.1]]])


@given(st.lists(st.lists(st.booleans(), min_size=6, max_size=6), min_size=1, max_size=6))
def test_rectangles_cover_the_wall_once(cells: list[list[bool]]) -> None:
    rows = ["".join("#" if wall else "." for wall in row) for row in cells]
    covered = np.zeros((len(rows), 6), int)
    for left, top, right, bottom in maps._rectangles(rows):
        covered[top:bottom, left:right] += 1
    np.testing.assert_array_equal(covered, np.array(cells, int))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("### #S", "map has 3 characters in row 1 and 2 in row 2: give rows of the same length."),
        ("#S?T#", "map has '?' in row 1, column 3: give # (wall), . (floor), S (start area), "),
        ("#s.T#", "map has 's' in row 1, column 2: give # (wall), . (floor), S (start area), "),
        ("#S#T#", "map has a target in row 1, column 4 that cannot be reached from the start in "),
        ("#S..#", "map has 1 cells with S and 0 with T: give both, or a letter for each robot."),
        ("#a..#", "map has 'A' 0 times: give the start (a) and the target (A) of a robot once"),
        (
            "#" * 49,
            (
                "map has 1 rows of 49 characters: give at most 48 rows of 48 characters, and "
                "larger "
                "cells."
            ),
        ),
    ],
)
def test_refuses_a_text(text: str, said: str) -> None:
    assert refusal(maps.read, text.split(), 0.12).startswith(said)


def test_refuses_too_many_walls() -> None:
    rows = ["." * 16 if r % 2 else ".#" * 8 for r in range(32)]
    rows[0] = "S." * 7 + ".T"
    said = refusal(_stage, " ".join(rows), 1)
    assert said.startswith("stage drawn: map has walls of ")
    assert "give walls of at most 112" in said


@pytest.mark.parametrize(
    ("text", "robots", "said"),
    [
        (LETTERS, 1, "robots is 1, but map has letters for 2 robots and no areas S and T: give 2."),
        (LETTERS, 3, "robots is 3, but map has letters for 2 robots and no areas S and T: give 2."),
        ("aAST", 0, "robots is 0: give 1 to 1024"),
    ],
)
def test_refuses_robots(text: str, robots: int, said: str) -> None:
    assert refusal(_stage, text, robots).startswith(said)


@pytest.mark.parametrize("given", [{"level": "random"}, {"map": []}])
def test_a_map_goes_with_its_level(given: dict) -> None:
    whole = stage_config.complete({"name": "drawn", "robots": 2, "map": ROOMS})
    assert "give both level=map and a map, or neither" in refusal(
        build, StageConfig, {**whole, **given}
    )


# Whether there is room


@pytest.mark.parametrize(
    ("text", "robots", "where"),
    [
        ("SSST SSS. SSS.", 4, "has its target"),
        ("S..TTT S..TTT ...TTT", 6, "starts"),
    ],
)
def test_refuses_areas_without_room(text: str, robots: int, where: str) -> None:
    said = refusal(room.check, [_stage(text, robots)], SPACING)
    assert said.startswith(f"stage drawn: level=map has no room for {robots} robots, because ")
    assert said.endswith(
        f" overlaps another robot where it {where}: give fewer robots, or more space."
    )


def test_areas_with_room_are_taken() -> None:
    room.check([_stage(ROOMS, 3), _stage(LETTERS, 2)], SPACING)


# The levels


def test_numpy_and_jax_draw_the_same() -> None:
    arrays = jax.tree.map(jnp.asarray, task_stage.single(_stage(ROOMS, 3)))
    drawn = jax.jit(jax.vmap(lambda each: level.sample(each, arrays, SPACING, jnp)))
    for mine, theirs in zip(
        Level(*map(np.stack, zip(*_draw(_stage(ROOMS, 3), 500), strict=True))),
        drawn(_uniforms(500)),
        strict=True,
    ):
        np.testing.assert_array_equal(mine, theirs)


def _cells(text: str, letter: str, cell: float = 0.12) -> np.ndarray:
    """Returns the centres of the cells of a letter, worked out from the text alone."""
    rows = text.split()
    return np.array(
        [
            ((c - (len(row) - 1) / 2) * cell, ((len(rows) - 1) / 2 - r) * cell)
            for r, row in enumerate(rows)
            for c, found in enumerate(row)
            if found == letter
        ]
    )


@pytest.mark.parametrize(("letter", "field"), [("S", "start"), ("T", "target")])
@pytest.mark.slow
def test_robots_stay_in_their_areas(letter: str, field: str) -> None:
    centres = _cells(ROOMS, letter)
    for drawn in _draw(_stage(ROOMS, 3), 1000):
        place = getattr(drawn, field)[:3, :2]
        off = np.abs(place[:, None] - centres[None]).max(axis=-1).min(axis=-1)
        assert off.max() <= 0.06 + ROUNDING


@pytest.mark.slow
def test_nothing_touches_at_the_start() -> None:
    wall = _cells(ROOMS, "#")
    for drawn in _draw(_stage(ROOMS, 3), 1000):
        for place, least in ((drawn.start[:3, :2], HULL), (drawn.target[:3], HULL)):
            beyond = np.maximum(np.abs(place[:, None] - wall[None]) - 0.06, 0.0)
            assert np.linalg.norm(beyond, axis=-1).min() >= least
            apart = np.linalg.norm(place[:, None] - place[None], axis=-1)
            assert apart[np.triu_indices(3, 1)].min() >= 2 * HULL
        arrived = np.linalg.norm(drawn.start[:3, :2] - drawn.target[:3], axis=-1)
        assert arrived.min() > REACH


@pytest.mark.slow
def test_every_open_point_is_used() -> None:
    arrays = task_stage.single(_stage("S..T", 1, cell=0.2)).map
    assert arrays is not None
    drawn = {tuple(each.start[0, :2]) for each in _draw(_stage("S..T", 1, cell=0.2), 2000)}
    # The cell has 6 x 6 points, 0.033 m apart. Along each of three walls, two rows of points are
    # too close to the wall, which leaves 4 x 2 points.
    assert len(drawn) == 8


def test_letters_stand_where_they_are() -> None:
    for drawn in _draw(_stage(LETTERS, 2), 20):
        for robot, letter in enumerate("ab"):
            for field, name in (("start", letter), ("target", letter.upper())):
                place = getattr(drawn, field)[robot, :2]
                np.testing.assert_allclose(place, _cells(LETTERS, name)[0], atol=ROUNDING)


def test_walls_are_those_of_the_map() -> None:
    stage = _stage(ROOMS, 3)
    drawn = _draw(stage, 1)[0]
    expected = maps.read(ROOMS.split(), 0.12).wall
    np.testing.assert_allclose(drawn.obstacle[: len(expected)], expected, atol=1e-6)
    assert drawn.obstacle_present.sum() == len(expected) == stage.obstacles


def test_other_stages_draw_as_without_a_map() -> None:
    plain = StageConfig(name="s3", robots=3, side=0.7, obstacles=1)
    alone, beside = task_stage.stack([plain]), task_stage.stack([plain, _stage(ROOMS, 3)])
    for each in _uniforms(50):
        one = level.sample(each, task_stage.select(alone, np.intp(0)), SPACING, np)
        other = level.sample(each, task_stage.select(beside, np.intp(0)), SPACING, np)
        for mine, theirs in zip(one, other, strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_the_longest_wall_is_compiled_in() -> None:
    assert task_stage.largest_half([_stage(ROOMS, 3)]) == pytest.approx(0.72)
