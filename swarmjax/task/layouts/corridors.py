"""Corridors for one robot at a time.

One has a bay, where one robot lets the other pass. The other is a dead end, with targets one behind
the other.
"""

from typing import Any

import numpy as np

from swarmjax.task.layouts.site import (
    MARGIN_UNITS,
    THICKNESS,
    ArenaLayout,
    Demand,
    Drawn,
    Site,
    between,
    pick,
    place_starts,
    points,
    rows,
)
from swarmjax.task.placement import round_up, split

Array = Any
_ENDS = 0.10  # m, length of the target area at either end of the corridor
_AHEAD = 0.20  # m, between one robot's target area and the other robot's start
_BEFORE = 0.08  # m, from the first target to the mouth of the corridor
_HALL = 0.30  # m, depth of the hall before the corridor, where robots start


def draw_bay(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Draws a corridor along x with a bay on its left.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena; the layout reads `gap` (of the corridor), `width` (at the bay) and `length`
        (of the bay).
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout. The first robot starts at the left end and the second at the right end. Each has
      its target at the opposite end, behind the start of the other robot.
    """
    count = site.present.shape[0]
    place, starts, targets, aside = split(uniforms, [2, count, count, 2 * count])
    half_x, half_y = site.half[0], site.half[1]
    gap, recess = site.numbers.gap, site.numbers.width - site.numbers.gap
    most = xp.maximum(half_y - gap // 2 - recess - THICKNESS, 0)
    middle = pick(place[0], -most, most, xp)
    bay = pick(place[1], -(half_x // 4), half_x // 4, xp)
    # The first robot goes right, the second left; there is no third.
    way = xp.where(np.arange(count) % 2 == 0, 1, -1)
    end = half_x - site.clear
    last = round_up(_ENDS)
    target_x = way * pick(targets, end - last, end, xp)
    ahead = last + round_up(_AHEAD)
    start_x = -way * pick(starts, end - ahead - last, end - ahead, xp)
    most = xp.maximum(gap // 2 - site.hull - MARGIN_UNITS // 4, 0)
    off = middle + pick(aside, -most, most, xp)
    return Drawn(
        wall=_walls_of_bay(site, bay, middle, recess, xp),
        there=np.ones(4, bool),
        start=xp.stack([start_x, off[:count]], axis=-1),
        target=xp.stack([target_x, off[count:]], axis=-1),
    )


def _walls_of_bay(site: Site, bay: Array, middle: Array, recess: Array, xp: Any) -> Array:
    """Returns the walls [4, 4] (units): the right wall, then the left walls around the bay."""
    half_x, thin, aside = site.half[0], THICKNESS // 2, site.numbers.gap // 2
    along = site.numbers.length // 2
    left = between(-half_x, bay - along)
    right = between(bay + along, half_x)
    deep = (recess + 2 * thin + 1) // 2
    upper = middle + aside
    return rows(
        (
            (0 * bay, middle - aside - thin, half_x, thin),
            (left[0], upper + deep, left[1], deep),
            (right[0], upper + deep, right[1], deep),
            (bay, upper + recess + thin, along, thin),
        ),
        xp,
    )


def _least_bay(demand: Demand) -> tuple[float, float]:
    # The bay's centre lies in the middle quarter of the corridor. On either side, the robots start
    # beyond the bay.
    side = 4 / 3 * (demand["length"] + 2 * (2 * _ENDS + _AHEAD) + 0.12)
    return min(side, 1.2), demand["width"] + 2 * THICKNESS / 4096


BAY = ArenaLayout(
    draw=draw_bay,
    uniforms=lambda robots, _: 2 + 4 * robots,
    walls=lambda _: 4,
    reads=("gap", "width", "length"),
    least=_least_bay,
    most_robots=2,
)


def draw_row(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Draws a corridor that ends at the arena's wall.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena; the layout reads `gap` (of the corridor) and `apart` (of the targets).
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout. The first robot gets the deepest target. Robots start anywhere in the hall before
      the corridor.
    """
    count = site.present.shape[0]
    place, shift, starts = split(uniforms, [1, 2, count])
    half_x, half_y = site.half[0], site.half[1]
    gap, apart = site.numbers.gap, site.numbers.apart
    robots = xp.sum(site.present.astype(xp.int32), dtype=xp.int32)
    deepest = half_x - site.clear
    mouth = deepest - (robots - 1) * apart - int(_BEFORE * 4096)
    most = xp.maximum(half_y - gap // 2 - THICKNESS - 2 * site.hull - 2 * MARGIN_UNITS, 0)
    middle = pick(place[0], -most, most, xp)
    x = deepest - np.arange(count, dtype=np.int32) * apart
    target = xp.stack([x, 0 * x + middle], axis=-1)
    hall = points(
        (site.clear - half_x, site.clear - half_y),
        (mouth - site.clear, half_y - site.clear),
        shift,
        xp,
    )
    start = place_starts(site, hall, target, starts, site.present, xp)
    along, half = between(mouth, half_x)
    aside, thin = gap // 2 + THICKNESS // 2, THICKNESS // 2
    wall = rows(((along, middle + aside, half, thin), (along, middle - aside, half, thin)), xp)
    return Drawn(wall, np.ones(2, bool), start, target)


def _least_row(demand: Demand) -> tuple[float, float]:
    side = (demand["robots"] - 1) * demand["apart"] + 0.065 + _BEFORE + _HALL
    return side, demand["gap"] + 2 * THICKNESS / 4096


ROW = ArenaLayout(
    draw=draw_row,
    uniforms=lambda robots, _: 3 + robots,
    walls=lambda _: 2,
    reads=("gap", "apart"),
    least=_least_row,
)
