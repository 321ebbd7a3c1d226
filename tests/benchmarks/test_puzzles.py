"""Tests POGEMA's puzzles as arenas, and the search for puzzles that are solvable on the grid."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from benchmarks import puzzles
from benchmarks.puzzles import Draw, Place
from swarmjax import epuck
from swarmjax.config import ConfigError
from swarmjax.evaluate import cells
from swarmjax.task.level import Level

RADIUS = epuck.HULL_RADIUS
LAYOUTS = puzzles.layouts()


def _solve(rows: str, start: Sequence[Place], target: Sequence[Place]) -> int | None:
    return puzzles.fewest_steps(Draw(0, tuple(rows.split()), tuple(start), tuple(target)))


def _room(point: np.ndarray, level: Level) -> np.ndarray:
    """Returns distances [P] of points [P, 2] from a level's nearest wall, m; 0 inside a wall."""
    box = level.obstacle[level.obstacle_present].astype(np.float64)
    outside = np.maximum(np.abs(point[:, None] - box[:, :2]) - box[:, 3:], 0.0)
    return np.minimum(
        np.linalg.norm(outside, axis=-1).min(axis=-1),
        (0.5 * level.side - np.abs(point)).min(axis=-1),
    )


def test_there_are_16_layouts_of_5_by_5() -> None:
    assert list(LAYOUTS) == [f"puzzle-{i:02}" for i in range(16)]
    for rows in LAYOUTS.values():
        assert [len(row) for row in rows] == [5] * 5
        assert set("".join(rows)) == {"#", "."}


# --- the search


def test_two_change_ends_of_a_corridor_by_its_bay() -> None:
    """Each robot has 4 cells to go; one robot takes 2 more steps, into the bay and out of it."""
    assert _solve(".....\n##.##", [(0, 0), (0, 4)], [(0, 4), (0, 0)]) == 6


def test_without_a_bay_they_cannot() -> None:
    assert _solve(".....\n#####", [(0, 0), (0, 4)], [(0, 4), (0, 0)]) is None


def test_neighbours_do_not_change_places() -> None:
    assert _solve("..", [(0, 0), (0, 1)], [(0, 1), (0, 0)]) is None


def test_a_robot_follows_another_at_once() -> None:
    assert _solve("...", [(0, 0), (0, 1)], [(0, 1), (0, 2)]) == 1


def test_four_turn_round_without_a_free_cell() -> None:
    ring = [(0, 0), (0, 1), (1, 1), (1, 0)]
    assert _solve("..\n..", ring, [*ring[1:], ring[0]]) == 1


def test_a_cell_holds_one_robot() -> None:
    assert _solve("...", [(0, 0), (0, 1)], [(0, 2), (0, 1)]) is None


def test_a_robot_leaves_its_target_to_let_another_pass() -> None:
    """The robot steps into the bay as the other takes its cell, and back as the other goes on."""
    assert _solve("...\n#.#", [(0, 0), (0, 1)], [(0, 2), (0, 1)]) == 2


# --- draws


@pytest.mark.parametrize("robots", [2, 3, 4])
def test_draws_are_of_distinct_free_cells_and_no_target_is_its_start(robots: int) -> None:
    for draw in puzzles.draw_puzzles(robots, 10):
        for ends in (draw.start, draw.target):
            assert len(set(ends)) == robots
            assert {draw.rows[r][c] for r, c in ends} == {"."}
        assert all(s != t for s, t in zip(draw.start, draw.target, strict=True))


def test_a_target_is_drawn_where_its_start_leads() -> None:
    """A wall divides the grid into two halves, and each target is in the half of its start."""
    rows = ("..#..",) * 5
    for number in range(30):
        draw = puzzles.draw_puzzle(number, rows, 3)
        for start, target in zip(draw.start, draw.target, strict=True):
            assert (start[1] < 2) == (target[1] < 2)


def test_fewer_draws_are_the_first_of_more() -> None:
    some, all_of_them = puzzles.draw_puzzles(2, 3), puzzles.draw_puzzles(2, 10)
    assert some == [each for each in all_of_them if each.number % 10 < 3]


# --- arenas


@pytest.mark.parametrize("robots", [2, 4])
def test_robots_and_targets_stand_in_the_middle_of_cells_off_the_walls(robots: int) -> None:
    drawn = puzzles.draw_puzzles(robots, 2)
    for draw, level in zip(
        drawn, cells.split(puzzles.make_cell(drawn, puzzles.EDGE).levels), strict=True
    ):
        for ends, places in ((draw.start, level.start[:, :2]), (draw.target, level.target)):
            middle = [(0.12 * (c - 2), 0.12 * (2 - r)) for r, c in ends]
            assert places == pytest.approx(np.array(middle), abs=1e-6)
            assert _room(places, level).min() == pytest.approx(0.06, abs=1e-6)  # half a cell
        assert level.side == pytest.approx(0.6)


def test_walls_fill_the_blocked_cells() -> None:
    drawn = puzzles.draw_puzzles(2, 1)
    for draw, level in zip(
        drawn, cells.split(puzzles.make_cell(drawn, puzzles.EDGE).levels), strict=True
    ):
        middle = np.array([[0.12 * (c - 2), 0.12 * (2 - r)] for r in range(5) for c in range(5)])
        assert ((_room(middle, level) == 0.0) == [x == "#" for x in "".join(draw.rows)]).all()
        half = level.obstacle[level.obstacle_present, 3:]
        assert (4 * half.prod(axis=-1)).sum() == pytest.approx(
            0.12**2 * "".join(draw.rows).count("#"), rel=1e-5
        )


def test_two_robots_do_not_fit_side_by_side_in_a_cell() -> None:
    assert puzzles.EDGE < 4 * RADIUS


@pytest.mark.parametrize(("edge", "passes"), [(puzzles.EDGE, True), (0.115, False)])
def test_in_a_bend_two_get_past_each_other_unless_cells_are_smaller(
    edge: float, passes: bool
) -> None:
    """One robot waits in the outer corner of the bend; the other robot hugs the inner corner."""
    waiting = np.array([-1.0, 1.0]) * (edge / 2 - RADIUS)
    corner = np.array([1.0, -1.0]) * edge / 2
    angle = np.linspace(np.pi / 2, np.pi, 1001)  # from the right arm into the lower arm
    way = corner + RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    apart = np.linalg.norm(way - waiting, axis=-1).min()
    assert apart == pytest.approx(math.sqrt(2) * (edge - RADIUS) - RADIUS)
    assert (apart > 2 * RADIUS) == passes


# --- the command


def test_the_file_is_a_suite_and_its_lines_say_what_can_be_solved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "puzzles.npz"
    assert puzzles.main([f"out={out}", "draws=1", "robots=2,3"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    suite = cells.read(out)
    assert [(c.name, c.stage.robots, len(c.episodes)) for c in suite.cells] == [
        ("r2", 2, 16),
        ("r3", 3, 16),
    ]
    assert [line["digest"] for line in lines] == [cell.digest for cell in suite.cells]
    for line in lines:
        assert line["solvable"] + len(line["unsolvable"]) == line["episodes"] == 16


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["out=a.txt"], "out is a.txt: give a file .npz"),
        (["out=a.npz", "robots=2,2"], "each once"),
        (["out=a.npz", "robots=5"], "robots"),
        (["out=a.npz", "cell=0.05"], "cell"),
    ],
)
def test_what_makes_no_sense_is_refused_in_a_sentence(words: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        puzzles.main(words)
