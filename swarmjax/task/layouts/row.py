"""Targets one behind the other in a dead-end corridor."""

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
from swarmjax.task.placement import split

Array = Any
_BEFORE = 0.08  # m, from the first target to the mouth of the corridor
_HALL = 0.30  # m, depth of the hall before the corridor, where robots start


def draw(uniforms: Array, site: Site, xp: Any) -> Drawn:
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


def _least(demand: Demand) -> tuple[float, float]:
    side = (demand.robots - 1) * demand.numbers["apart"][1] + 0.065 + _BEFORE + _HALL
    return side, demand.numbers["gap"][1] + 2 * THICKNESS / 4096


ROW = ArenaLayout(
    draw=draw,
    uniforms=lambda robots, _: 3 + robots,
    walls=lambda _: 2,
    reads=("gap", "apart"),
    least=_least,
)
