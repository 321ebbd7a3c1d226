"""Arenas of hundreds of robots: each box, start and target has a plot of its own.

Other levels place objects one after the other, clear of all earlier ones. Their time grows with
the square of the number of robots, and their points are too few for a thousand. Here the arena is
divided into a square grid of plots, which are dealt out at random. An object lies at random in its
plot, but half of the least distance between objects away from the edges.
"""

import math
from typing import Any

import numpy as np

from swarmjax.task.layouts.site import ArenaLayout, Drawn, Site
from swarmjax.task.placement import split

Array = Any
_PASSAGES = 4  # hulls that fit side by side between two boxes, where the arena has room


def along(robots: int, boxes: int) -> int:
    """Returns how many plots lie along a side: enough for boxes, starts and targets."""
    return math.isqrt(2 * robots + boxes - 1) + 1


def draw(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Deals out the plots.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena, a square; the layout reads `width`, the edge of a box, and `cells`, the
        number of boxes.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout; boxes are parallel to the walls.
    """
    robots, boxes = site.present.shape[0], site.cells
    count, objects = along(robots, boxes), 2 * robots + boxes
    deal, shift = split(uniforms, [count**2, 2 * objects])
    plot = xp.argsort(deal, stable=True)[:objects].astype(xp.int32)
    edge = 2 * site.half[0] // count
    apart = xp.maximum(site.gaps.target.soft, site.numbers.width + 2 * _PASSAGES * site.hull)
    room = xp.maximum(edge - (apart if boxes else site.gaps.target.soft), 0)
    shift = (shift.reshape(-1, 2) - np.float32(0.5)) * room.astype(xp.float32)
    middle = xp.stack([plot % count, plot // count], axis=-1) * edge + edge // 2 - site.half[0]
    place = middle + xp.floor(shift).astype(xp.int32)
    half = xp.broadcast_to((site.numbers.width + 1) // 2, (boxes, 2)).astype(xp.int32)
    return Drawn(
        wall=xp.concatenate([place[:boxes], half], axis=-1),
        there=np.ones(boxes, bool),
        start=place[boxes : boxes + robots],
        target=place[boxes + robots :],
    )


def _uniforms(robots: int, boxes: int) -> int:
    return along(robots, boxes) ** 2 + 2 * (2 * robots + boxes)


PLOTS = ArenaLayout(
    draw=draw,
    uniforms=_uniforms,
    walls=lambda boxes: boxes,
    reads=(),
    most_robots=1024,
    square=True,
)
