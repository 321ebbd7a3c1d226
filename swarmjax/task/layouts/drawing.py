"""Draws levels of layouts: draws numbers, lays out an arena, turns it, converts it to metres."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from swarmjax.task.layouts import LAYOUTS
from swarmjax.task.layouts.site import NUMBERS, Drawn, Numbers, Site, between, pick, rows
from swarmjax.task.placement import clearance, gaps_of, metres, poses, round_up, split

Array = Any
_TURNS = 8  # quarter turns, and their mirror images
LENGTHS = 2 + len(NUMBERS)  # lengths of a level: extents along x and y, and `NUMBERS`
_BARS = 2  # walls that make an arena narrower than it is long


class LayoutArrays(NamedTuple):
    """Numbers of one layout in all stages, [S, ...], or in one stage, [...].

    Attributes:
      chosen: whether the stage has this layout, bool.
      side: smallest and largest extent along x, [2] units, int32.
      breadth: smallest and largest extent along y, [2] units, int32; 0 for a square.
      low: [6] smallest `NUMBERS`, units, int32.
      high: [6] largest `NUMBERS`, units, int32.
    """

    chosen: Array
    side: Array
    breadth: Array
    low: Array
    high: Array


class Kind(NamedTuple):
    """The part of a layout that is fixed in the compiled program.

    Attributes:
      name: name in `LAYOUTS`.
      cells: number of cells along a side of a maze, or of boxes on plots; 0 for other layouts.
      narrow: whether an arena may be narrower than it is long, with bars of wall beside it.
    """

    name: str
    cells: int = 0
    narrow: bool = False

    @property
    def walls(self) -> int:
        """Largest number of walls in a level of this kind."""
        return LAYOUTS[self.name].walls(self.cells) + _BARS * self.narrow


Entry = tuple[Kind, Mapping[str, Any]]


def stack(entries: Sequence[Entry | None]) -> dict[Kind, LayoutArrays]:
    """Stacks the layouts of stages into NumPy arrays [S, ...], by kind.

    Args:
      entries: for each stage, the kind and the fields of `LayoutArrays` except `chosen`; None for
        a stage without a layout.
    """
    kinds = sorted({each[0] for each in entries if each is not None})
    return {kind: _stack(kind, entries) for kind in kinds}


def _stack(kind: Kind, entries: Sequence[Entry | None]) -> LayoutArrays:
    mine = [each[1] if each is not None and each[0] == kind else None for each in entries]
    none = {"side": [1, 1], "breadth": [0, 0], "low": [0] * 6, "high": [0] * 6}
    found = [none if each is None else each for each in mine]
    table = {key: np.array([each[key] for each in found], np.int32) for key in none}
    return LayoutArrays(chosen=np.array([each is not None for each in mine]), **table)


def uniform_count(kind: Kind, robots: int) -> int:
    """Returns how many uniform numbers an arena for `robots` robots takes."""
    return LENGTHS + 1 + robots + LAYOUTS[kind.name].uniforms(robots, kind.cells)


def draw(
    kind: Kind,
    of: LayoutArrays,
    uniforms: Array,
    present: Array,
    hull: float,
    reach: float,
    xp: Any,
) -> tuple[Array, Drawn]:
    """Draws an arena with this layout.

    Args:
      kind: the fixed part.
      of: numbers of the layout in one stage, in fields [...].
      uniforms: [uniform_count(kind, R)] float32 in [0, 1), or more; the only source of randomness.
      present: [R] whether the robot is present.
      hull: radius of the robots, m.
      reach: distance at which a robot has arrived, m.
      xp: `numpy` or `jax.numpy`; both draw the same arena.

    Returns:
      The side of the arena, m, and its layout: walls [W, 5] x (m), y (m), yaw (0 rad) and half
      edges (m), starts [R, 3] x (m), y (m), yaw (rad), and targets [R, 2] (m). The arena is a
      square, in which bars of wall enclose a narrower arena.
    """
    layout, count = LAYOUTS[kind.name], present.shape[0]
    own = layout.uniforms(count, kind.cells)
    lengths, turn, heading, rest = split(uniforms, [LENGTHS, 1, count, own])
    side, breadth, numbers = _numbers(of, lengths, xp)
    half = xp.stack([side, breadth]) // 2
    site = Site(
        half=half,
        numbers=Numbers(*(numbers[i] for i in range(len(NUMBERS)))),
        cells=kind.cells,
        present=present,
        hull=round_up(hull),
        clear=clearance(hull),
        reach=round_up(reach),
        gaps=gaps_of(hull, reach),
    )
    drawn = layout.draw(rest, site, xp)
    drawn = _with_bars(drawn, half, xp) if kind.narrow else drawn
    drawn = _turned(drawn, pick(turn[0], xp.int32(0), xp.int32(_TURNS - 1), xp), xp)
    wall = metres(drawn.wall, xp)
    level = xp.zeros_like(wall[:, :1])
    return metres(xp.maximum(side, breadth), xp), drawn._replace(
        wall=xp.concatenate([wall[:, :2], level, wall[:, 2:]], axis=-1),
        start=poses(drawn.start, heading, xp),
        target=metres(drawn.target, xp),
    )


def _numbers(of: LayoutArrays, uniforms: Array, xp: Any) -> tuple[Array, Array, Array]:
    """Draws the extents along x and y, and the `NUMBERS` [6], units."""
    side = pick(uniforms[0], of.side[0], of.side[1], xp)
    breadth = pick(uniforms[1], of.breadth[0], of.breadth[1], xp)
    return side, xp.where(breadth > 0, breadth, side), pick(uniforms[2:], of.low, of.high, xp)


def _with_bars(drawn: Drawn, half: Array, xp: Any) -> Drawn:
    """Fills the rest of the square around a narrower arena with walls."""
    middle, deep = between(half[1], half[0])
    there = half[1] < half[0]
    deep = xp.maximum(deep, 1)  # an absent wall needs non-zero edges too
    bars = rows(((0, middle, half[0], deep), (0, -middle, half[0], deep)), xp)
    return drawn._replace(
        wall=xp.concatenate([drawn.wall, bars]),
        there=xp.concatenate([xp.asarray(drawn.there), xp.stack([there, there])]),
    )


def _turned(drawn: Drawn, turn: Array, xp: Any) -> Drawn:
    """Turns a layout by quarter turns, and mirrors it for turns from 4 on."""
    across, flip_x, flip_y = turn % 2 == 1, turn // 2 % 2 == 1, turn // 4 == 1

    def place(point: Array) -> Array:
        x, y = point[..., 0], point[..., 1]
        x, y = xp.where(across, y, x), xp.where(across, x, y)
        return xp.stack([xp.where(flip_x, -x, x), xp.where(flip_y, -y, y)], axis=-1)

    half = drawn.wall[:, 2:]
    half = xp.where(across, half[:, ::-1], half)
    wall = xp.concatenate([place(drawn.wall[:, :2]), half], axis=-1)
    return drawn._replace(wall=wall, start=place(drawn.start), target=place(drawn.target))
