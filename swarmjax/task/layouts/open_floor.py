"""Arenas without inner walls: a circle, with each target on the opposite side, and a crowd.

The robots of a crowd start anywhere outside the arrival zones. Its targets keep the distance
`apart` while there is room. A target that finds no such place takes the point farthest from the
earlier targets, so all targets are placed.
"""

import math
from typing import Any

import numpy as np

from swarmjax.task.layouts.site import MARGIN_UNITS, ArenaLayout, Drawn, Site, pick, points
from swarmjax.task.placement import Gap, place, score_things, split

Array = Any
_TURN = 5040  # directions around the circle; divisible by 2 to 10, by 12, 14, 15, 16, 18 and 20
_ONE = 2**14  # scale of the sine table; times a radius of 2 m (2**13 units), it fits an int32
_ANGLE = np.arange(_TURN) * (2.0 * math.pi / _TURN)
_TABLE = np.round(_ONE * np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=-1)).astype(np.int32)
_LATTICE = 40  # points along a side; they are 3 cm apart in an arena of 1.2 m


def draw_circle(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Places robots evenly on a circle with a random first direction.

    Args:
      uniforms: [1] uniform numbers in [0, 1).
      site: the arena; the layout reads `radius`.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout, without walls.
    """
    robots = xp.sum(site.present.astype(xp.int32), dtype=xp.int32)
    number = np.arange(site.present.shape[0], dtype=np.int32)
    first = pick(uniforms[0], xp.int32(0), xp.int32(_TURN - 1), xp)
    where = (first + number * _TURN // xp.maximum(robots, 1)) % _TURN
    start, target = (
        _on_circle((where + half) % _TURN, site.numbers.radius, xp) for half in (0, _TURN // 2)
    )
    return Drawn(xp.zeros((0, 4), xp.int32), np.zeros(0, bool), start, target)


def _on_circle(direction: Array, radius: Array, xp: Any) -> Array:
    """Returns points [R, 2] on a circle around the middle, units."""
    return (xp.asarray(_TABLE)[direction] * radius + _ONE // 2) // _ONE


CIRCLE = ArenaLayout(
    draw=draw_circle,
    uniforms=lambda _, __: 1,
    walls=lambda _: 0,
    reads=("radius",),
    square=True,
)


def draw_crowd(uniforms: Array, site: Site, xp: Any) -> Drawn:
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


CROWD = ArenaLayout(
    draw=draw_crowd,
    uniforms=lambda robots, _: 4 + 2 * robots,
    walls=lambda _: 0,
    reads=("apart",),
)
