"""Shared parts of layouts: arenas, walls, and areas for robots."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from swarmjax.task.placement import MARGIN, Gaps, place, round_up, score_things

Array = Any
THICKNESS = round_up(0.02)  # thickness of walls within an arena, units
LATTICE = 24  # points along each edge of an area


class Numbers(NamedTuple):
    """Lengths of a layout, each [] int32 in units; a layout reads only some of them.

    Attributes:
      gap: free width of a door or a corridor.
      width: free width of a trap, or of a corridor at its bay, or edge of a box on a plot.
      depth: depth of a trap.
      length: length of a fence, or of a bay along its corridor.
      radius: radius of the circle on which robots start.
      apart: distance between targets, or from targets to a door.
    """

    gap: Array
    width: Array
    depth: Array
    length: Array
    radius: Array
    apart: Array


NUMBERS = Numbers._fields  # names of a stage's settings, m


class Site(NamedTuple):
    """The arena that a layout is drawn in. Lengths are units, int32.

    Attributes:
      half: [2] half of the arena's extent along x and y.
      numbers: lengths of this level.
      cells: number of cells along a side of a maze, or of boxes on plots; 0 for other layouts.
      present: [R] whether the robot is present.
      hull: radius of the robots.
      clear: least distance between a robot's centre and a wall at the start.
      reach: radius of the arrival zone.
      gaps: least distances between starts and targets.
    """

    half: Array
    numbers: Numbers
    cells: int
    present: Array
    hull: int
    clear: int
    reach: int
    gaps: Gaps


class Drawn(NamedTuple):
    """A layout, before it is turned.

    Attributes:
      wall: [W, 4] x, y and half edges of rectangles, units.
      there: [W] whether the wall is present.
      start: [R, 2] units.
      target: [R, 2] units.
    """

    wall: Array
    there: Array
    start: Array
    target: Array


class ArenaLayout(NamedTuple):
    """Definition of a layout.

    Attributes:
      draw: draws the layout from uniform numbers [K] in [0, 1), a site and the array module.
      uniforms: takes the numbers of robots and cells, and returns how many uniform numbers `draw`
        needs.
      walls: takes the number of cells of a site, and returns the largest number of walls.
      reads: names of the `NUMBERS` that the layout uses, or `cells`.
      most_robots: largest number of robots, however large the arena.
      square: whether the arena must be square.
    """

    draw: Callable[[Array, Site, Any], Drawn]
    uniforms: Callable[[int, int], int]
    walls: Callable[[int], int]
    reads: tuple[str, ...]
    most_robots: int = 100
    square: bool = False


def pick(uniform: Array, low: Array, high: Array, xp: Any) -> Array:
    """Picks an integer uniformly from low..high; returns `low` if the range is empty."""
    count = xp.maximum(high - low + 1, 1)
    above = xp.floor(uniform * count.astype(xp.float32)).astype(xp.int32)
    return low + xp.minimum(above, count - 1)


def rows(table: Sequence[Sequence[Array]], xp: Any) -> Array:
    """Makes an array [W, 4] of rectangles: x, y and half edges, units."""
    return xp.stack([xp.stack([xp.asarray(x, xp.int32) for x in row]) for row in table])


def between(low: Array, high: Array) -> tuple[Array, Array]:
    """Returns the middle of an interval, and half its length rounded up to cover the interval."""
    return (low + high) // 2, (high - low + 1) // 2


def points(
    low: Sequence[Array], high: Sequence[Array], shift: Array, xp: Any, count: int = LATTICE
) -> Array:
    """Spreads points evenly over a rectangle, shifted by a part of their spacing.

    Args:
      low: corner of the rectangle with the smallest x and y, units.
      high: corner of the rectangle with the largest x and y, units.
      shift: [2] shift in [0, 1), as a share of the spacing.
      xp: `numpy` or `jax.numpy`.
      count: points along each edge.

    Returns:
      [count**2, 2] int32, units.
    """
    steps = np.arange(count, dtype=np.int32)
    axes = []
    for axis in range(2):
        extent = xp.maximum(xp.asarray(high[axis] - low[axis], xp.int32), 0)
        offset = xp.floor(shift[axis] * extent.astype(xp.float32)).astype(xp.int32)
        axes.append(low[axis] + (steps * extent + offset) // count)
    x = xp.broadcast_to(axes[0][:, None], (count, count))
    y = xp.broadcast_to(axes[1][None, :], (count, count))
    return xp.stack([x.reshape(-1), y.reshape(-1)], axis=-1)


def place_starts(
    site: Site, area: Array, target: Array, picks: Array, there: Array, xp: Any
) -> Array:
    """Places some robots in an area, clear of all targets; returns [R, 2] units."""
    score = score_things(area, target, site.present, site.gaps.from_target, xp)
    return place(area, score, picks, there, site.gaps.start, xp)[0]


MARGIN_UNITS = round_up(MARGIN)
