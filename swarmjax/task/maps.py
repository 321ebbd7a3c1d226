"""Arenas drawn as text: walls, starts and possible places of targets.

    ########
    #S..#..#
    #S.....#
    #...#.T#
    ########

`#` is a wall, `.` is floor. `S` and `T` mark the areas for starts and targets. Any other lower-case
letter is the start of one robot, and the same letter as a capital is that robot's target. The text
shows the arena from above, with x to the right and y up.
"""

import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from swarmjax.config import ConfigError, show
from swarmjax.task.placement import UNITS

Array = Any
Cell = tuple[int, int]  # row and column of the text, from 0

WALL, FLOOR, START, TARGET = "#.ST"
MOST_CELLS = 48  # largest number of cells in a row, and largest number of rows
# Starts and targets are placed on a set of points. The numbers below are the least distance between
# two points (m), and the largest number of points. An area with more cells gets one point per cell.
_APART, _MOST_POINTS = 0.03, 1024


class Map(NamedTuple):
    """A map, in metres around the middle of the arena.

    Attributes:
      side: side of the square arena that holds the map, m.
      wall: [W, 5] x (m), y (m), yaw (0 rad), half edges (m) of rectangles.
      start: [C, 2] possible starts, m.
      target: [D, 2] possible targets, m.
      pair: [P, 2, 2] start and target of each robot that has a letter, m.
    """

    side: float
    wall: np.ndarray
    start: np.ndarray
    target: np.ndarray
    pair: np.ndarray


class MapArrays(NamedTuple):
    """The maps of stages as arrays, [S, ...] or [...]; points that only pad are not `open`.

    Attributes:
      mapped: whether the stage has a map, bool.
      wall: [W, 5] walls, as in `Map`, float32.
      start: [C, 2] starts, 1/4096 m, int32.
      start_open: [C] whether the start is a point of this stage, bool.
      target: [D, 2] targets, 1/4096 m, int32.
      target_open: [D] whether the target is a point of this stage, bool.
      pair: [P, 2, 2] start and target of each pair, 1/4096 m, int32.
      pairs: number of pairs that the stage has, int32.
    """

    mapped: Array
    wall: Array
    start: Array
    start_open: Array
    target: Array
    target_open: Array
    pair: Array
    pairs: Array


def read(rows: Sequence[str], cell: float) -> Map:
    """Reads a map.

    Args:
      rows: rows of the text, from the top.
      cell: edge of a cell, m.

    Returns:
      The map. If it is not square, walls on two sides make it square.

    Raises:
      ConfigError: the text is invalid; the message says why.
    """
    _check_text(rows)
    areas: dict[str, list[Cell]] = {START: [], TARGET: []}
    for r, row in enumerate(rows):
        for c, letter in enumerate(row):
            areas.setdefault(letter, []).append((r, c))
    pairs = _pairs(areas)
    _check_reach(rows, areas[START], areas[TARGET], pairs)
    middle = np.array([len(rows[0]) - 1, len(rows) - 1]) / 2
    start, target = (_points(areas[kind], middle, cell) for kind in (START, TARGET))
    ends = [[_centre(each, middle, cell) for each in pair] for pair in pairs]
    return Map(
        side=round(max(len(rows), len(rows[0])) * cell, 6),
        wall=_walls(rows, cell),
        start=start,
        target=target,
        pair=np.array(ends, np.float64).reshape(-1, 2, 2),
    )


def _check_text(rows: Sequence[str]) -> None:
    if not rows or not rows[0]:
        raise ConfigError("map is empty: give rows of #, ., S and T.")
    for number, row in enumerate(rows, 1):
        if len(row) != len(rows[0]):
            raise ConfigError(
                f"map has {len(rows[0])} characters in row 1 and {len(row)} in row {number}: give "
                "rows of the same length."
            )
        for column, letter in enumerate(row, 1):
            if not re.fullmatch(r"[#.a-zA-Z]", letter) or letter in "st":
                raise ConfigError(
                    f"map has {show(letter)} in row {number}, column {column}: give # (wall), . "
                    "(floor), S (start area), T (target area), or another letter for one robot."
                )
    if max(len(rows), len(rows[0])) > MOST_CELLS:
        raise ConfigError(
            f"map has {len(rows)} rows of {len(rows[0])} characters: give at most {MOST_CELLS} "
            f"rows of {MOST_CELLS} characters, and larger cells."
        )


def _pairs(areas: dict[str, list[Cell]]) -> list[tuple[Cell, Cell]]:
    """Pairs the start and the target of each letter, in alphabetical order."""
    letters = sorted({letter.lower() for letter in areas} - {"s", "t", WALL, FLOOR})
    for letter in letters:
        for each in (letter, letter.upper()):
            count = len(areas.get(each, []))
            if count != 1:
                raise ConfigError(
                    f"map has {show(each)} {count} times: give the start ({letter}) and the target "
                    f"({letter.upper()}) of a robot once each."
                )
    return [(areas[letter][0], areas[letter.upper()][0]) for letter in letters]


def _check_reach(
    rows: Sequence[str],
    starts: Sequence[Cell],
    targets: Sequence[Cell],
    pairs: Sequence[tuple[Cell, Cell]],
) -> None:
    """Refuses a target that cannot be reached by steps between adjacent cells."""
    if bool(starts) != bool(targets) or not (starts or pairs):
        raise ConfigError(
            f"map has {len(starts)} cells with S and {len(targets)} with T: give both, or a letter "
            "for each robot."
        )
    from scipy import ndimage  # slow to import, and few stages have a map

    floor = np.array([[letter != WALL for letter in row] for row in rows])
    region: Any = ndimage.label(floor)  # cells that share edges, and their count
    wanted = [(start, target) for start in starts[:1] for target in targets]
    wanted += [(start, targets[0]) for start in starts[1:]]
    for start, target in [*wanted, *pairs]:
        if region[0][start] != region[0][target]:
            raise ConfigError(
                f"map has a target in row {target[0] + 1}, column {target[1] + 1} that cannot be "
                f"reached from the start in row {start[0] + 1}, column {start[1] + 1}: leave a "
                "path of cells that share edges."
            )


def _centre(cell: Cell, middle: np.ndarray, edge: float) -> np.ndarray:
    """Returns the centre of a cell, [2] m."""
    return np.array([cell[1] - middle[0], middle[1] - cell[0]]) * edge


def _points(cells: Sequence[Cell], middle: np.ndarray, edge: float) -> np.ndarray:
    """Spreads points evenly over cells, [C, 2] m."""
    most = math.isqrt(_MOST_POINTS // max(1, len(cells)))
    count = max(1, min(math.floor(edge / _APART), most))
    aside = ((np.arange(count) + 0.5) / count - 0.5) * edge
    offsets = np.stack(np.meshgrid(aside, aside), axis=-1).reshape(-1, 2)
    centres = [_centre(cell, middle, edge) for cell in cells]
    return np.array([centre + offsets for centre in centres]).reshape(-1, 2)


def _walls(rows: Sequence[str], edge: float) -> np.ndarray:
    """Covers the walls with rectangles that do not overlap, [W, 5]."""
    height, width = len(rows), len(rows[0])
    margin = abs(height - width) / 2  # cells added on either side of a map that is not square
    found: list[tuple[float, float, float, float]] = [*_rectangles(rows)]
    if width > height:
        found += [(0, -margin, width, 0), (0, height, width, height + margin)]
    if height > width:
        found += [(-margin, 0, 0, height), (width, 0, width + margin, height)]
    left, top, right, bottom = np.array(found, np.float64).reshape(-1, 4).T
    x, y = (left + right) / 2 - width / 2, height / 2 - (top + bottom) / 2
    half_x, half_y = (right - left) / 2, (bottom - top) / 2
    return np.stack([x * edge, y * edge, 0 * x, half_x * edge, half_y * edge], axis=-1)


def _rectangles(rows: Sequence[str]) -> Iterator[tuple[int, int, int, int]]:
    """Yields left, top, right and bottom of rectangles that cover the walls, largest first."""
    left = np.array([[letter == WALL for letter in row] for row in rows])
    while left.any():
        yield (best := _largest(left))
        left[best[1] : best[3], best[0] : best[2]] = False


def _largest(wall: np.ndarray) -> tuple[int, int, int, int]:
    """Finds the largest rectangle of wall: left, top, right, bottom."""
    best, most = (0, 0, 0, 0), 0
    runs = np.zeros(wall.shape[1], int)  # wall cells directly above the bottom row, by column
    for bottom, row in enumerate(wall, 1):
        runs = np.where(row, runs + 1, 0)
        for left in range(len(runs)):
            high = len(wall)
            for right in range(left, len(runs)):
                high = min(high, int(runs[right]))
                if high * (right + 1 - left) > most:
                    most = high * (right + 1 - left)
                    best = (left, bottom - high, right + 1, bottom)
    return best


def stack(maps: Sequence[Map | None]) -> MapArrays | None:
    """Stacks the maps of stages into NumPy arrays.

    Args:
      maps: maps of the stages; None for a stage without a map.

    Returns:
      The arrays [S, ...]; None if no stage has a map.
    """
    if not any(maps):
        return None
    none = Map(0.0, *(np.zeros((0, *shape)) for shape in ((5,), (2,), (2,), (2, 2))))
    each = [none if one is None else one for one in maps]
    start, start_open = _pad([one.start for one in each])
    target, target_open = _pad([one.target for one in each])
    pair, pair_there = _pad([one.pair for one in each])
    return MapArrays(
        mapped=np.array([one is not None for one in maps]),
        wall=_pad([one.wall for one in each])[0].astype(np.float32),
        start=_in_units(start),
        start_open=start_open,
        target=_in_units(target),
        target_open=target_open,
        pair=_in_units(pair),
        pairs=pair_there.sum(axis=1).astype(np.int32),
    )


def _pad(arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Pads arrays to one length, at least 1, and stacks them; also returns which rows are real."""
    longest = max(1, *map(len, arrays))
    shape = (len(arrays), longest, *arrays[0].shape[1:])
    padded, there = np.zeros(shape), np.zeros(shape[:2], bool)
    for row, mask, array in zip(padded, there, arrays, strict=True):
        row[: len(array)], mask[: len(array)] = array, True
    return padded, there


def _in_units(metres: np.ndarray) -> np.ndarray:
    return np.round(metres * UNITS).astype(np.int32)
