"""A U-shaped wall that opens towards the robots, with the targets behind it."""

from typing import Any

import numpy as np

from swarmjax.task.layouts.site import (
    THICKNESS,
    ArenaLayout,
    Demand,
    Drawn,
    Site,
    pick,
    place_starts,
    place_targets,
    points,
    rows,
)
from swarmjax.task.placement import round_up, split

Array = Any
_ROOM = 0.20  # m, before the mouth and behind the trap: one start or target, and spare space
_WAY = 0.14  # m, beside the trap: a hull (radius 0.045 m), 2 cm on either side, and 1 cm more


def draw(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Draws a trap.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena; the layout reads `width` and `depth`.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout. Starts and targets lie within the trap's width, so the straight line from a start
      to a target leads into the trap.
    """
    count = site.present.shape[0]
    place, shifts, targets, starts = split(uniforms, [2, 4, count, count])
    width, depth = site.numbers.width, site.numbers.depth
    half_x, half_y = site.half[0], site.half[1]
    room, way = round_up(_ROOM), round_up(_WAY)
    back = pick(place[0], room + depth - half_x, half_x - room - THICKNESS, xp)
    most = xp.maximum(half_y - way - THICKNESS - width // 2, 0)
    middle = pick(place[1], -most, most, xp)
    aside = xp.maximum(width // 2 - site.clear, 0)
    low, high = middle - aside, middle + aside
    before = points((site.clear - half_x, low), (back - depth - site.clear, high), shifts[:2], xp)
    behind = points(
        (back + THICKNESS + site.clear, low), (half_x - site.clear, high), shifts[2:], xp
    )
    open_ = xp.zeros(len(behind), xp.int32)
    target = place_targets(site, behind, open_, targets, site.present, xp)
    start = place_starts(site, before, target, starts, site.present, xp)
    return Drawn(_walls(back, middle, width, depth, xp), np.ones(3, bool), start, target)


def _walls(back: Array, middle: Array, width: Array, depth: Array, xp: Any) -> Array:
    """Returns the back wall and the two side walls, [3, 4] units."""
    thin, half = THICKNESS // 2, width // 2
    arm, length = half + thin, depth // 2
    return rows(
        (
            (back + thin, middle, thin, half + 2 * thin),
            (back - length, middle + arm, length, thin),
            (back - length, middle - arm, length, thin),
        ),
        xp,
    )


def _least(demand: Demand) -> tuple[float, float]:
    thick = THICKNESS / 4096
    side = demand.numbers["depth"][1] + thick + 2 * _ROOM
    return side, demand.numbers["width"][1] + 2 * (thick + _WAY)


TRAP = ArenaLayout(
    draw=draw,
    uniforms=lambda robots, _: 6 + 2 * robots,
    walls=lambda _: 3,
    reads=("width", "depth"),
    least=_least,
    most_robots=4,
)
