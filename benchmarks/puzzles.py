"""Makes arenas from POGEMA's 16 puzzles: `python -m benchmarks.puzzles out=FILE.npz`.

It writes a suite of three cells, `r2`, `r3` and `r4`, named after their numbers of robots. A cell
has ten draws of starts and targets for each puzzle. For each cell it prints a JSON line with the
number of levels that can be solved on the grid. `python -m swarmjax.evaluate suite=FILE.npz
task.arrival=hold policy=...` reads the file.

The layouts, the numbers of robots and the number of draws come from POGEMA. The starts and targets
are drawn by this file.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import lines
from swarmjax import command, provenance
from swarmjax.config import ConfigError, Section, about, build, reading, show
from swarmjax.evaluate import cells
from swarmjax.evaluate.cells import Cell, Suite
from swarmjax.evaluate.suite_config import SUITE_SEED
from swarmjax.task import level, maps
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig, complete

LAYOUTS = Path(__file__).parent / "puzzles.yaml"
ROBOTS, DRAWS = (2, 3, 4), 10  # from POGEMA's file 05-puzzles.yaml
# Edge of a cell, m. The edge is less than the 0.148 m that two hulls need side by side. In a bend,
# two robots can still pass with 6 mm to spare if one robot is in the outer corner. With an edge
# below 0.1155 m, robots could not pass in a bend either.
EDGE = 0.12
# POGEMA allows 128 steps on the grid. At 0.1256 m/s, 128 cells take 122.3 s, or 3,822 control steps
# of 0.032 s. Turning takes extra time, but no level here needs more than 24 of the 128 steps. A
# robot therefore has five times as long as it needs to drive these steps at full speed.
STEPS = 4000
SEED = SUITE_SEED + 400
_SHIFTS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))

Place = tuple[int, int]  # row and column in a layout, both counted from 0


class Draw(NamedTuple):
    """A puzzle with the starts and targets of its robots.

    Attributes:
      number: number of the level in its cell.
      rows: rows of the layout; `#` marks a blocked place, `.` a free place.
      start: [R] places of the robots, all different.
      target: [R] places of their targets, all different.
    """

    number: int
    rows: tuple[str, ...]
    start: tuple[Place, ...]
    target: tuple[Place, ...]


@dataclass(frozen=True, kw_only=True)
class PuzzlesConfig(Section):
    """Settings: which puzzles to make, and where to write them."""

    out: str = field(metadata=about("file .npz for the levels"))
    cell: float = field(default=EDGE, metadata=about("edge of a cell of a puzzle, m", 0.08, 0.3))
    robots: tuple[int, ...] = field(
        default=ROBOTS, metadata=about("numbers of robots, one cell of the suite for each", 1, 4)
    )
    draws: int = field(
        default=DRAWS, metadata=about("draws of starts and targets for each puzzle", 1, 1000)
    )

    def _check(self) -> None:
        if Path(self.out).suffix != ".npz":
            raise ConfigError(f"out is {reading.called(self.out)}: give a file .npz.")
        if not self.robots or len(set(self.robots)) < len(self.robots):
            raise ConfigError(f"robots is {show(self.robots)}: give some of 1 to 4, each once.")


def layouts() -> dict[str, tuple[str, ...]]:
    """Returns the rows of each puzzle's layout, by the name of the puzzle."""
    return {name: tuple(text.split()) for name, text in reading.read_yaml(LAYOUTS).items()}


# --- the grid


def near(rows: Sequence[str]) -> tuple[list[Place], np.ndarray]:
    """Lists the free places of a layout, and the neighbours of each place.

    Args:
      rows: rows of a layout.

    Returns:
      The N free places, row by row, and an array [N, 5] of place numbers. A row of the array has
      the place's own number and the numbers of its neighbours below, above, right and left, with
      -1 for a missing neighbour.
    """
    place = [(r, c) for r, row in enumerate(rows) for c, x in enumerate(row) if x != maps.WALL]
    number = {each: i for i, each in enumerate(place)}
    beside = [[number.get((r + down, c + right), -1) for down, right in _SHIFTS] for r, c in place]
    return place, np.array(beside)


def fewest_steps(draw: Draw) -> int | None:
    """Solves a puzzle on the grid with breadth-first search over the joint places of all robots.

    The rules are those of multi-agent path finding (Stern et al. 2019, section 2.2). In each step a
    robot stays or moves to a neighbouring place. No two robots may be in one place or swap places.
    A robot may move to a place that another robot leaves in the same step. All robots must be at
    their targets at the same time.

    Args:
      draw: the puzzle.

    Returns:
      Number of steps of the shortest solution; None if the puzzle has no solution.
    """
    place, beside = near(draw.rows)
    shape = (len(place),) * len(draw.start)
    start, goal = (
        int(np.ravel_multi_index([place.index(each) for each in ends], shape))
        for ends in (draw.start, draw.target)
    )
    seen = np.zeros(len(place) ** len(shape), bool)
    edge, steps = np.array([start]), 0
    while len(edge):
        seen[edge] = True
        if seen[goal]:
            return steps
        reached = np.zeros(seen.shape, bool)
        reached[_successors(np.stack(np.unravel_index(edge, shape), axis=-1), beside)] = True
        edge, steps = np.flatnonzero(reached & ~seen), steps + 1
    return None


def _successors(state: np.ndarray, beside: np.ndarray) -> Any:
    """Builds, robot by robot, the states that can follow states [F, R]; returns their numbers."""
    before, after = state, state[:, :0]
    for robot in range(state.shape[1]):
        row, option = np.nonzero(beside[before[:, robot]] >= 0)
        before, after = before[row], after[row]
        here = before[:, robot, None]
        there = beside[here[:, 0], option][:, None]
        swapped = (before[:, :robot] == there) & (after == here)
        good = ~((after == there) | swapped).any(axis=-1)
        before, after = before[good], np.concatenate([after, there], axis=-1)[good]
    return np.ravel_multi_index(tuple(after.T), (len(beside),) * state.shape[1])


def draw_puzzle(number: int, rows: Sequence[str], robots: int) -> Draw:
    """Draws starts and targets; each target is reachable from its start and differs from it.

    Args:
      number: number of the level in its cell.
      rows: rows of the layout.
      robots: number of robots.

    Returns:
      The puzzle; all valid pairs of starts and targets are equally likely.
    """
    place, beside = near(rows)
    part, random = _parts(beside), _random(robots, number)
    while True:
        start, target = (random.permutation(len(place))[:robots] for _ in range(2))
        if (start != target).all() and (part[start] == part[target]).all():
            ends = (tuple(place[i] for i in each) for each in (start, target))
            return Draw(number, tuple(rows), *ends)


def _random(*key: int) -> np.random.Generator:
    return np.random.default_rng([SEED, *key])


def _parts(beside: np.ndarray) -> np.ndarray:
    """Labels the connected parts of a layout: each place gets the lowest number in its part."""
    part = np.arange(len(beside))
    for _ in beside:
        part = np.where(beside >= 0, part[beside], len(beside)).min(axis=-1)
    return part


# --- arenas


def to_level(draw: Draw, edge: float, boxes: int) -> Level:
    """Makes a puzzle's arena from a map, with robots in the middle of cells at random headings.

    Args:
      draw: the puzzle.
      edge: edge of a cell, m.
      boxes: number of boxes in the level; boxes that the walls do not need are marked absent.

    Returns:
      The level of one arena.
    """
    read = [_read(draw.rows, *ends, edge) for ends in zip(draw.start, draw.target, strict=True)]
    ends, robots, count = np.array([each.pair[0] for each in read]), len(read), len(read[0].wall)
    obstacle = np.full((boxes, 5), 0.5 * edge)
    obstacle[:count] = read[0].wall
    random = _random(robots, draw.number, 1)
    yaw = random.uniform(-np.pi, np.pi, robots)
    found = Level(
        side=np.float32(read[0].side),
        present=np.ones(robots, bool),
        start=np.column_stack([ends[:, 0], yaw]).astype(np.float32),
        target=ends[:, 1].astype(np.float32),
        obstacle_present=np.arange(boxes) < count,
        obstacle=obstacle.astype(np.float32),
        seed=random.integers(2**32, dtype=np.uint32),
    )
    return level.park(found, np)


def _read(rows: Sequence[str], start: Place, target: Place, edge: float) -> maps.Map:
    """Reads a layout as a map with one robot, since one robot's target may be another's start."""
    letters = [list(row) for row in rows]
    for (r, c), letter in ((start, "a"), (target, "A")):
        letters[r][c] = letter
    return maps.read(["".join(row) for row in letters], edge)


def draw_puzzles(robots: int, draws: int) -> list[Draw]:
    """Draws the puzzles of one cell of the suite, layout by layout.

    Args:
      robots: number of robots.
      draws: number of draws per layout. Calls with at most `DRAWS` draws share their first draws.

    Returns:
      The puzzles.
    """
    return [
        draw_puzzle(max(draws, DRAWS) * i + k, rows, robots)
        for i, rows in enumerate(layouts().values())
        for k in range(draws)
    ]


def make_cell(puzzles: Sequence[Draw], edge: float) -> Cell:
    """Makes a cell of the suite from puzzles with the same number of robots.

    Args:
      puzzles: puzzles of the cell.
      edge: edge of a cell of the grid, m.

    Returns:
      The cell. The stage of the cell has the layout with the most walls, but each level has its own
      layout.
    """
    robots = len(puzzles[0].start)
    stage = max((_stage(each.rows, robots, edge) for each in puzzles), key=lambda x: x.obstacles)
    drawn = [to_level(each, edge, stage.obstacles) for each in puzzles]
    levels = Level(*(np.stack(fields) for fields in zip(*drawn, strict=True)))
    episodes = np.array([each.number for each in puzzles])
    return Cell(stage.name, stage, None, SEED, episodes, levels, STEPS)


def _stage(rows: Sequence[str], robots: int, edge: float) -> StageConfig:
    """Makes a layout's stage: the upper half of the free places are starts, the rest targets."""
    place, _ = near(rows)
    letters = [list(row) for row in rows]
    for i, (r, c) in enumerate(place):
        letters[r][c] = maps.START if i < len(place) // 2 else maps.TARGET
    text = ["".join(row) for row in letters]
    said = {"name": f"r{robots}", "robots": robots, "cell": edge, "map": text}
    return build(StageConfig, complete(said))


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = lines.load(PuzzlesConfig, arguments)
    puzzles = {robots: draw_puzzles(robots, settings.draws) for robots in settings.robots}
    made = {robots: make_cell(drawn, settings.cell) for robots, drawn in puzzles.items()}
    cells.write(Path(settings.out), Suite("puzzles", tuple(made.values())))
    lines.write(_line(made[robots], drawn) for robots, drawn in puzzles.items())
    return 0


def _line(cell: Cell, puzzles: Sequence[Draw]) -> lines.Line:
    """Makes a cell's JSON line, with its solvable levels and the fewest steps that solve them."""
    steps = [fewest_steps(each) for each in puzzles]
    solved = [each for each in steps if each is not None]
    return {
        "benchmark": "puzzles",
        "cell": cell.name,
        "episodes": len(steps),
        "solvable": len(solved),
        "fewest_steps": {"mean": float(np.mean(solved)), "largest": max(solved)},
        "unsolvable": [p.number for p, each in zip(puzzles, steps, strict=True) if each is None],
        "edge_m": cell.stage.cell,
        "steps": cell.steps,
        "digest": cell.digest,
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }


if __name__ == "__main__":
    sys.exit(command.run("puzzles", main, Section))
