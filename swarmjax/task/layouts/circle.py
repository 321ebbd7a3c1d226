"""Robots on a circle, each with its target on the opposite side."""

import math
from typing import Any

import numpy as np

from swarmjax.task.layouts.site import ArenaLayout, Demand, Drawn, Site, pick

Array = Any
_TURN = 5040  # directions around the circle; divisible by 2 to 10, by 12, 14, 15, 16, 18 and 20
_ONE = 2**14  # scale of the sine table; times a radius of 2 m (2**13 units), it fits an int32
_ANGLE = np.arange(_TURN) * (2.0 * math.pi / _TURN)
_TABLE = np.round(_ONE * np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=-1)).astype(np.int32)
_WALL = 0.07  # m, from the circle to the walls: a hull's radius of 0.045 m and some spare space


def draw(uniforms: Array, site: Site, xp: Any) -> Drawn:
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


def _least(demand: Demand) -> tuple[float, float]:
    side = 2 * (demand.numbers["radius"][1] + _WALL)
    return side, side


CIRCLE = ArenaLayout(
    draw=draw,
    uniforms=lambda _, __: 1,
    walls=lambda _: 0,
    reads=("radius",),
    least=_least,
    square=True,
)
