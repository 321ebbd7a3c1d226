"""A crowd without obstacles: robots start anywhere outside the arrival zones.

Targets keep the distance `apart` while there is room. A target that finds no such place takes the
point farthest from the earlier targets, so all targets are placed.
"""

import math
from typing import Any

import numpy as np

from swarmjax.task.layouts.site import MARGIN_UNITS, ArenaLayout, Demand, Drawn, Site, points
from swarmjax.task.placement import Gap, place, score_things, split

Array = Any
_LATTICE = 40  # points along a side; they are 3 cm apart in an arena of 1.2 m
_FILLING = 0.5  # largest share of the area for discs as wide as `apart`; random discs jam at 0.547


def draw(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Places targets, then starts.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena; the layout reads `apart`.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout, without walls.
    """
    count = site.present.shape[0]
    shifts, targets, starts = split(uniforms, [4, count, count])
    low, high = site.clear - site.half, site.half - site.clear
    area = points(low, high, shifts[:2], xp, _LATTICE)
    touching = 2 * site.hull + MARGIN_UNITS // 2
    apart = Gap(touching, site.numbers.apart)
    target, _ = place(area, 0 * area[:, 0], targets, site.present, apart, xp)
    area = points(low, high, shifts[2:], xp, _LATTICE)
    outside = site.reach + MARGIN_UNITS // 4
    score = score_things(area, target, site.present, Gap(outside, outside), xp)
    start, _ = place(area, score, starts, site.present, Gap(touching, touching), xp)
    return Drawn(xp.zeros((0, 4), xp.int32), np.zeros(0, bool), start, target)


def _least(demand: Demand) -> tuple[float, float]:
    disc = math.pi * (0.5 * demand.numbers["apart"][1]) ** 2
    area = demand.robots * disc / _FILLING
    side = math.sqrt(area) + 2 * 0.065 - demand.numbers["apart"][1]
    return max(side, 0.4), area / demand.side


CROWD = ArenaLayout(
    draw=draw,
    uniforms=lambda robots, _: 4 + 2 * robots,
    walls=lambda _: 0,
    reads=("apart",),
    least=_least,
)
