"""Grids of cells, some of which are blocked at random, as in benchmarks of path finding on grids.

Starts and targets lie in free cells that are connected (Skrynnik et al. 2025,
"POGEMA: A Benchmark Platform for Cooperative Multi-Agent Pathfinding", random maps). Robots
may block each other: whether all of them can arrive is not checked.
"""

from typing import Any

import numpy as np

from swarmjax.task.layouts.maze import edges, in_cells
from swarmjax.task.layouts.site import ArenaLayout, Drawn, Site, pick
from swarmjax.task.placement import repeat, split

Array = Any
_MOST = 0.4  # largest share of blocked cells; with half of them blocked, few others connect


def draw(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Draws a grid.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena, a square; the layout reads `cells`.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout; starts and targets each have their own cell. If the largest connected area has
      too few cells for them, no cell is blocked.
    """
    count, cells = site.present.shape[0], site.cells
    total = cells * cells
    order, share, rooms, aside = split(uniforms, [total, 1, total, 4 * count])
    most = xp.asarray(int(_MOST * total), xp.int32)
    blocks = pick(share[0], xp.int32(0), most, xp)
    free = xp.argsort(xp.argsort(order, stable=True), stable=True) >= blocks
    area = _largest_area(free, cells, xp)
    robots = xp.sum(site.present, dtype=xp.int32)
    enough = xp.sum(area, dtype=xp.int32) >= 2 * robots
    free, area = xp.where(enough, free, True), xp.where(enough, area, True)
    ranked = xp.argsort(rooms + xp.where(area, 0.0, 2.0).astype(xp.float32), stable=True)
    start, target = in_cells(ranked, aside, site, 0, xp)
    edge = 2 * site.half[0] // cells
    number = np.arange(total)
    middle = xp.asarray(np.stack([number % cells, number // cells], axis=-1).astype(np.int32))
    centre = middle * edge - site.half[0] + edge // 2
    wall = xp.concatenate([centre, xp.zeros_like(centre) + (edge + 1) // 2], axis=-1)
    return Drawn(wall.astype(xp.int32), ~free, start, target)


def _largest_area(free: Array, cells: int, xp: Any) -> Array:
    """Returns which cells [C] lie in the largest connected area of free cells."""
    pairs, total = edges(cells), cells * cells
    touches = np.zeros((total, total), bool)
    touches[pairs[:, 0], pairs[:, 1]] = touches[pairs[:, 1], pairs[:, 0]] = True
    linked = xp.asarray(touches) & free & free[:, None]

    def spread(_: Array, label: Array) -> Array:
        return xp.minimum(label, xp.min(xp.where(linked, label, total), axis=-1))

    label = xp.where(free, xp.arange(total, dtype=xp.int32), total)
    label = repeat(total, spread, label, xp)
    size = xp.sum((label == label[:, None]) & free, axis=-1, dtype=xp.int32)
    best = xp.argmax(xp.where(free, size, 0))
    return free & (label == label[best])


BLOCKS = ArenaLayout(
    draw=draw,
    uniforms=lambda robots, cells: 2 * cells * cells + 1 + 4 * robots,
    walls=lambda cells: cells * cells,
    reads=("cells",),
    square=True,
)
