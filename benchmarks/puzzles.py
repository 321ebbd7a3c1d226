"""The 16 puzzles of POGEMA's benchmark as arenas: `python -m benchmarks.puzzles out=FILE.npz`.

Writes a suite of three cells, `r2`, `r3` and `r4` by the number of robots, with ten draws of starts
and targets for each puzzle, and prints a JSON line for each cell: how many of its levels can be
solved on the grid. `python -m swarmjax.evaluate suite=FILE.npz task.arrival=hold policy=...` and
`python -m benchmarks.baselines suite=FILE.npz task.arrival=hold` take the file.

Layouts, numbers of robots and of draws are POGEMA's; the draws are not.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks import key_value
from swarmjax import command, provenance
from swarmjax.config import ConfigError, Section, about, build, files, reading, show
from swarmjax.evaluate import cells
from swarmjax.evaluate.cells import Cell, Suite
from swarmjax.evaluate.suite_config import SUITE_SEED
from swarmjax.task import level, maps
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig, complete

LAYOUTS = Path(__file__).parent / "maps" / "puzzles.yaml"
ROBOTS, DRAWS = (2, 3, 4), 10  # of their file 05-puzzles.yaml
# m, of a cell: less than the 0.148 m of two hulls side by side. In a bend, one in the outer corner,
# two do get past each other with 6 mm to spare; cells below 0.1155 m would not let them.
EDGE = 0.12
# Theirs are 128 steps of the grid. At 0.1256 m/s these are 122.3 s, or 3,822 control steps of
# 0.032 s. Turning comes on top, but the fastest solution of any level here takes 24 steps of the
# 128: a robot has five times as long as full speed would take.
STEPS = 4000
SEED = SUITE_SEED + 400
_SHIFTS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))

Place = tuple[int, int]  # row and column of a layout, from 0


class Draw(NamedTuple):
    """A puzzle with starts and targets.

    Attributes:
      number: of the level in its cell.
      rows: of the layout, `#` blocked and `.` free.
      start: [R] places of the robots, no two alike.
      target: [R] of their targets, no two alike.
    """

    number: int
    rows: tuple[str, ...]
    start: tuple[Place, ...]
    target: tuple[Place, ...]


@dataclass(frozen=True, kw_only=True)
class PuzzlesConfig(Section):
    """Where the puzzles go."""

    out: str = field(metadata=about("file .npz for the levels"))
    cell: float = field(default=EDGE, metadata=about("edge of a cell of a puzzle, m", 0.08, 0.3))
    robots: tuple[int, ...] = field(
        default=ROBOTS, metadata=about("numbers of robots, a cell of the suite each", 1, 4)
    )
    draws: int = field(
        default=DRAWS, metadata=about("of starts and targets, for each puzzle", 1, 1000)
    )

    def _check(self) -> None:
        if Path(self.out).suffix != ".npz":
            raise ConfigError(f"out is {reading.called(self.out)}: give a file .npz.")
        if not self.robots or len(set(self.robots)) < len(self.robots):
            raise ConfigError(f"robots is {show(self.robots)}: give some of 1 to 4, each once.")


def layouts() -> dict[str, tuple[str, ...]]:
    """Reads the puzzles: rows by name."""
    return {name: tuple(text.split()) for name, text in files.read_yaml(LAYOUTS).items()}


# --- the grid


def near(rows: Sequence[str]) -> tuple[list[Place], np.ndarray]:
    """Lists where a robot can be, and where it can be a step later.

    Args:
      rows: of a layout.

    Returns:
      The N free places, row by row; [N, 5] the numbers of the same place and of its neighbours
      below, above, right and left, -1 where there is none.
    """
    place = [(r, c) for r, row in enumerate(rows) for c, x in enumerate(row) if x != maps.WALL]
    number = {each: i for i, each in enumerate(place)}
    beside = [[number.get((r + down, c + right), -1) for down, right in _SHIFTS] for r, c in place]
    return place, np.array(beside)


def fewest_steps(draw: Draw) -> int | None:
    """Solves a puzzle on the grid by breadth-first search over the places of all robots together.

    The rules are those of multi-agent path finding (Stern et al. 2019, section 2.2): in each step a
    robot stays or moves to a neighbour; no two are in one place, and no two change places. A robot
    may move to a place that another leaves. All must be at their targets at once.

    Args:
      draw: the puzzle.

    Returns:
      Steps of the fastest solution; None if there is none.
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
    """Numbers [K] of the states that may follow states [F, R]; robots move one after the other."""
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
    """Draws starts and targets: each target can be reached from its start, and is another place.

    Args:
      number: of the level.
      rows: of the layout.
      robots: how many.

    Returns:
      The puzzle, of all that are so each as likely.
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
    """Numbers the parts of a layout that are connected: for each place the least place of its."""
    part = np.arange(len(beside))
    for _ in beside:
        part = np.where(beside >= 0, part[beside], len(beside)).min(axis=-1)
    return part


# --- arenas


def to_level(draw: Draw, edge: float, boxes: int) -> Level:
    """Makes a puzzle's arena: a map of the task, robots in the middle of cells, any way round.

    Args:
      draw: the puzzle.
      edge: of a cell, m.
      boxes: of the level; those that the walls do not need are absent.

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
    """Reads a layout as a map of one robot, as a place may be a start and another's target."""
    letters = [list(row) for row in rows]
    for (r, c), letter in ((start, "a"), (target, "A")):
        letters[r][c] = letter
    return maps.read(["".join(row) for row in letters], edge)


def draw_puzzles(robots: int, draws: int) -> list[Draw]:
    """Draws the puzzles of a cell, those of one layout after the other.

    Args:
      robots: how many.
      draws: for each layout; fewer are the first of more, up to `DRAWS`.

    Returns:
      The puzzles.
    """
    return [
        draw_puzzle(max(draws, DRAWS) * i + k, rows, robots)
        for i, rows in enumerate(layouts().values())
        for k in range(draws)
    ]


def make_cell(puzzles: Sequence[Draw], edge: float) -> Cell:
    """Makes a cell of puzzles with equally many robots.

    Args:
      puzzles: of the cell.
      edge: of a cell of the grid, m.

    Returns:
      The cell; its stage is the layout of the most walls, each level has its own.
    """
    robots = len(puzzles[0].start)
    stage = max((_stage(each.rows, robots, edge) for each in puzzles), key=lambda x: x.obstacles)
    drawn = [to_level(each, edge, stage.obstacles) for each in puzzles]
    levels = Level(*(np.stack(fields) for fields in zip(*drawn, strict=True)))
    episodes = np.array([each.number for each in puzzles])
    return Cell(stage.name, stage, "box", None, SEED, episodes, levels, STEPS)


def _stage(rows: Sequence[str], robots: int, edge: float) -> StageConfig:
    """Makes the stage of a layout: starts in the upper half of its free places, targets below."""
    place, _ = near(rows)
    letters = [list(row) for row in rows]
    for i, (r, c) in enumerate(place):
        letters[r][c] = maps.START if i < len(place) // 2 else maps.TARGET
    text = ["".join(row) for row in letters]
    said = {"name": f"r{robots}", "robots": robots, "cell": edge, "map": text}
    return build(StageConfig, complete(said))


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = key_value.load(PuzzlesConfig, arguments)
    puzzles = {robots: draw_puzzles(robots, settings.draws) for robots in settings.robots}
    made = {robots: make_cell(drawn, settings.cell) for robots, drawn in puzzles.items()}
    cells.write(Path(settings.out), Suite("puzzles", tuple(made.values())))
    for robots, drawn in puzzles.items():
        sys.stdout.write(json.dumps(_line(made[robots], drawn)) + "\n")
        sys.stdout.flush()
    return 0


def _line(cell: Cell, puzzles: Sequence[Draw]) -> dict[str, object]:
    """Says how many levels of a cell can be solved on the grid, and in how many steps."""
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
