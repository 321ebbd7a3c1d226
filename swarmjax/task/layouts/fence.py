"""A wall that starts at one side of the arena and leaves a way around its end."""

from typing import Any

import numpy as np

from swarmjax.task.layouts.site import (
    THICKNESS,
    ArenaLayout,
    Demand,
    Drawn,
    Site,
    between,
    pick,
    place_starts,
    place_targets,
    points,
    rows,
)
from swarmjax.task.placement import score_rectangles, split

Array = Any
_ASIDE = 0.1  # largest offset of the fence from the middle, as a share of half the arena
_LEAST_WAY = 0.10  # m, around the end: a hull (radius 0.045 m), half a centimetre on either side


def draw(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Draws a fence.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena; the layout reads `length`.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout, with starts on one side and targets on the other. No start or target lies in the
      way around the end.
    """
    count = site.present.shape[0]
    place, shifts, targets, starts = split(uniforms, [1, 4, count, count])
    half_x, half_y = site.half[0], site.half[1]
    most = xp.floor(np.float32(_ASIDE) * half_x.astype(xp.float32)).astype(xp.int32)
    where, thin = pick(place[0], -most, most, xp), THICKNESS // 2
    end = half_y - site.numbers.length
    wall_y, wall_half = between(end, half_y)
    low, high = site.clear - half_y, half_y - site.clear
    near = where - thin - site.clear
    before = points((site.clear - half_x, low), (near, high), shifts[:2], xp)
    far = where + thin + site.clear
    behind = points((far, low), (half_x - site.clear, high), shifts[2:], xp)
    way_y, way_half = between(-half_y, end)
    way = rows(((where, way_y, thin, way_half),), xp)
    # This leaves room for a robot that parks on this side of its target, and for a robot that
    # passes.
    free = score_rectangles(behind, way, np.ones(1, bool), site.reach + 3 * site.hull, xp)
    target = place_targets(site, behind, free, targets, site.present, xp)
    start = place_starts(site, before, target, starts, site.present, xp)
    wall = rows(((where, wall_y, thin, wall_half),), xp)
    return Drawn(wall, np.ones(1, bool), start, target)


def _least(demand: Demand) -> tuple[float, float]:
    # This is room for a row of starts on one side, a row of targets on the other, and the fence.
    side = 2 * 0.15 * (1 + demand.robots // 5) / (1 - _ASIDE) + THICKNESS / 4096
    return side, demand.numbers["length"][1] + _LEAST_WAY


FENCE = ArenaLayout(
    draw=draw,
    uniforms=lambda robots, _: 5 + 2 * robots,
    walls=lambda _: 1,
    reads=("length",),
    least=_least,
)
