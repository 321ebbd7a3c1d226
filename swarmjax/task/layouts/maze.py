"""Braided mazes: every cell has at least two ways out, so there are loops instead of dead ends.

Kruskal's method (Kruskal 1956, "On the shortest spanning subtree of a graph") builds a spanning
tree from edges in random order. Each dead end then gets a second opening.
"""

from typing import Any

import numpy as np

from swarmjax.task.layouts.site import (
    THICKNESS,
    ArenaLayout,
    Drawn,
    Site,
    pick,
)
from swarmjax.task.placement import repeat, split

Array = Any


def edges(cells: int) -> np.ndarray:
    """Lists the pairs of neighbouring cells of a maze.

    Args:
      cells: number of cells along a side.

    Returns:
      [E, 2] indices of cells, which are numbered row by row from below. Pairs along x come first.
    """
    number = np.arange(cells * cells).reshape(cells, cells)
    along = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=-1)
    across = np.stack([number[:-1].ravel(), number[1:].ravel()], axis=-1)
    return np.concatenate([along, across])


def draw(uniforms: Array, site: Site, xp: Any) -> Drawn:
    """Draws a maze.

    Args:
      uniforms: [K] uniform numbers in [0, 1).
      site: the arena, a square; the layout reads `cells`.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The layout; starts and targets each have their own cell.
    """
    count, cells = site.present.shape[0], site.cells
    pairs = edges(cells)
    order, rooms, aside = split(uniforms, [len(pairs), cells * cells, 4 * count])
    open_ = _braid(pairs, _tree(pairs, order, xp), order, cells, xp)
    edge, corner = 2 * site.half[0] // cells, -site.half[0]
    ranked = xp.argsort(rooms, stable=True)
    start, target = in_cells(ranked, aside, site, THICKNESS // 2, xp)
    return Drawn(_walls(pairs, cells, edge, corner, xp), ~open_, start, target)


def in_cells(ranked: Array, aside: Array, site: Site, wall: int, xp: Any) -> tuple[Array, Array]:
    """Places starts and targets in cells of their own, at random within the cells.

    Args:
      ranked: [C] indices of cells; the first ones are used.
      aside: [4 R] uniform numbers in [0, 1).
      site: the arena.
      wall: how far walls reach into a cell, units.
      xp: `numpy` or `jax.numpy`.

    Returns:
      Starts and targets [R, 2], units.
    """
    count, cells = site.present.shape[0], site.cells
    chosen = ranked[: 2 * count].astype(xp.int32)
    if cells * cells < 2 * count:  # a program may have more robots than fit into the cells
        lacking = xp.zeros(2 * count - cells * cells, xp.int32)
        chosen = xp.concatenate([chosen, lacking])
    edge = 2 * site.half[0] // cells
    centre = xp.stack([chosen % cells, chosen // cells], axis=-1) * edge - site.half[0] + edge // 2
    most = xp.maximum(edge // 2 - wall - site.clear, 0)
    place = centre + pick(aside.reshape(2 * count, 2), -most, most, xp)
    # Starts and targets alternate, so that a robot's cells do not depend on the compiled number of
    # robots.
    return place[0::2], place[1::2]


def _tree(pairs: np.ndarray, order: Array, xp: Any) -> Array:
    """Opens the edges of a random spanning tree, [E]."""
    ranked, table = xp.argsort(order, stable=True), xp.asarray(pairs)
    numbers = np.arange(len(pairs))

    def join(i: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        open_, label = state
        edge = ranked[i]
        one, other = label[table[edge, 0]], label[table[edge, 1]]
        joins = (numbers == edge) & (one != other)
        return open_ | joins, xp.where(label == other, one, label)

    label = xp.arange(pairs.max() + 1, dtype=xp.int32)
    return repeat(len(pairs), join, (xp.zeros(len(pairs), bool), label), xp)[0]


def _braid(pairs: np.ndarray, open_: Array, order: Array, cells: int, xp: Any) -> Array:
    """Opens one more edge [E] of each cell that has only one open edge.

    If possible, it leads to another such cell, so that most walls remain.
    """
    ends = np.arange(cells * cells)[:, None, None] == pairs  # [C, E, 2]
    touches = xp.asarray(ends.any(axis=-1))
    others = xp.asarray(np.where(ends[..., 0], pairs[:, 1], pairs[:, 0]))  # [C, E]

    def open_one(cell: Array, open_: Array) -> Array:
        dead = xp.sum(open_ & touches, axis=-1, dtype=xp.int32) < 2
        rank = order + dead[others[cell]].astype(xp.float32)
        best = xp.argmax(xp.where(touches[cell] & ~open_, rank, np.float32(-1.0)))
        return open_ | (dead[cell] & (np.arange(len(pairs)) == best))

    return repeat(cells * cells, open_one, open_, xp)


def _walls(pairs: np.ndarray, cells: int, edge: Array, corner: Array, xp: Any) -> Array:
    """Returns walls between neighbours, [E, 4] units, long enough to meet at their ends."""
    thin = THICKNESS // 2
    column, row = pairs[:, 0] % cells, pairs[:, 0] // cells
    beside = pairs[:, 1] - pairs[:, 0] == 1
    x = corner + np.where(beside, column + 1, column).astype(np.int32) * edge
    y = corner + np.where(beside, row, row + 1).astype(np.int32) * edge
    half = (edge + 1) // 2
    x, y = xp.where(beside, x, x + half), xp.where(beside, y + half, y)
    long = half + thin
    halves = xp.where(
        beside[:, None], xp.stack([thin + 0 * long, long]), xp.stack([long, thin + 0 * long])
    )
    return xp.concatenate([xp.stack([x, y], axis=-1), halves], axis=-1).astype(xp.int32)


MAZE = ArenaLayout(
    draw=draw,
    uniforms=lambda robots, cells: 2 * cells * (cells - 1) + cells**2 + 4 * robots,
    walls=lambda cells: 2 * cells * (cells - 1),
    reads=("cells",),
    square=True,
)
