"""Finds the robots that may be near each robot in grid cells, without comparing all pairs."""

import math
from typing import Any, NamedTuple

import numpy as np

from swarmjax.sim import dispatch

Array = Any
# A grid of cells covers the plane. The reach is the largest distance between the centres of two
# robots that are near each other. A row of cells is as high as the reach, so a robot looks at three
# rows. Cells are narrow along a row, so that the cells that a robot looks at extend only a little
# beyond its reach.
ROWS = 3
_CELLS = 16  # cells per reach along a row
_ROW = 2**18  # cells in a row; 1,024 robots parked far away take up 72,000 cells of a row
_SLACK = 1.01  # cells are larger than the reach, because numbers are rounded before `floor`
# Assumed largest overlap of two hulls, as a share of their diameter. Contacts are soft, so hulls
# overlap: in a jam of 100 robots that drove into each other, the largest overlap was 0.13.
_OVERLAP = 0.15


class Near(NamedTuple):
    """The robots of an arena that may be near each robot.

    Attributes:
      index: [R, N] indices of the robots that may be near each robot, including its own index. An
        index may occur more than once in a row.
      full: [] bool, whether some robots are left out because more than N may be near.
    """

    index: Array
    full: Array


def room(hull_radius: float, limit: float) -> int:
    """Returns how many robots fit into the cells that one robot looks at in one row of cells.

    At most 2 A / (sqrt(3) d^2) + P / (2 d) + 1 points with distances of at least d fit into a
    convex region with the area A and the perimeter P (Oler 1961, "An inequality in the geometry
    of numbers").

    Args:
      hull_radius: m.
      limit: largest gap between hulls that are near each other, m.
    """
    height = _SLACK * (2.0 * hull_radius + limit)
    width = (2.0 + 1.0 / _CELLS) * height
    apart = (1.0 - _OVERLAP) * 2.0 * hull_radius
    dense = 2.0 * width * height / (math.sqrt(3.0) * apart**2)
    return math.floor(dense + (width + height) / apart + 1.0)


def look(pose: Array, hull_radius: float, limit: float, xp: Any) -> Near | None:
    """Calls `find`; returns None for a swarm so small that comparing all pairs is better."""
    if not dispatch.has_cells(len(pose), ROWS * room(hull_radius, limit)):
        return None
    return find(pose, hull_radius, limit, xp)


def find(pose: Array, hull_radius: float, limit: float, xp: Any) -> Near:
    """Lists for each robot all robots with hulls within `limit` of its own, and perhaps others.

    Args:
      pose: [R, 3] x (m), y (m), yaw (rad); absent robots are parked far away from each other.
      hull_radius: m.
      limit: largest gap between hulls that are near each other, m.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The robots that may be near each robot; N is `ROWS` times `room(hull_radius, limit)`.
    """
    count, most = len(pose), room(hull_radius, limit)
    height = np.float32(_SLACK * (2.0 * hull_radius + limit))
    row = xp.floor(pose[:, 1] / height).astype(xp.int32)
    cell = xp.floor(pose[:, 0] * (_CELLS / height)).astype(xp.int32)
    key = row * _ROW + cell
    order = xp.argsort(key)
    ordered = key[order]
    middle = key[:, None] + np.array([-_ROW, 0, _ROW], np.int32)
    first = xp.searchsorted(ordered, middle - _CELLS)
    beyond = first + most
    is_left = ordered[xp.minimum(beyond, count - 1)] <= middle + _CELLS
    slot = xp.minimum(first[..., None] + np.arange(most), count - 1)
    return Near(order[slot].reshape(count, -1), ((beyond < count) & is_left).any())


def others(pose: Array, near: Near | None, xp: Any) -> tuple[Array, Array, Array]:
    """Returns the positions of the robots with which each robot is compared.

    Args:
      pose: [..., R, 3] x (m), y (m), yaw (rad); [R, 3] with `near`.
      near: the robots with which each robot is compared; None for all robots.
      xp: `numpy` or `jax.numpy`.

    Returns:
      x and y (m) of the other robots, [..., 1, R] or [R, N], and whether the "other" robot is the
      robot itself, [R, R] or [R, N].
    """
    x, y, count = pose[..., 0], pose[..., 1], pose.shape[-2]
    if near is None:
        return x[..., None, :], y[..., None, :], np.eye(count, dtype=bool)
    return x[near.index], y[near.index], near.index == xp.arange(count)[:, None]
