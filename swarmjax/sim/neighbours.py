"""Which robots may be near each robot, found in cells instead of by comparing all pairs."""

import math
from typing import Any, NamedTuple

import numpy as np

from swarmjax.sim import dispatch

Array = Any
# A robot looks at three rows of cells. A row is as high as the reach. Cells along a row are narrow,
# so that those that a robot looks at extend little beyond its reach.
ROWS = 3
_CELLS = 16  # cells per reach along a row
_ROW = 2**18  # cells of a row; 1,024 parked robots take 72,000
_SLACK = 1.01  # cells are larger than the reach, because numbers are rounded before `floor`
# Share of a hull's diameter by which all hulls may overlap. Contacts are soft: in a jam of 100
# robots that drove into each other, the worst of all pairs overlapped by 0.13.
_OVERLAP = 0.15


class Near(NamedTuple):
    """The robots of an arena that may be near each robot.

    Attributes:
      index: [R, N] robots, each robot itself among them; an index may occur more than once.
      full: [] whether robots are left out, because more than N are near; bool.
    """

    index: Array
    full: Array


def room(hull_radius: float, limit: float) -> int:
    """Returns how many robots fit into the cells of a row that one robot looks at.

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
    """Lists the robots near each robot as `find` does; None for a swarm that compares all pairs."""
    if not dispatch.has_cells(len(pose), ROWS * room(hull_radius, limit)):
        return None
    return find(pose, hull_radius, limit, xp)


def find(pose: Array, hull_radius: float, limit: float, xp: Any) -> Near:
    """Lists for each robot at least those whose hulls are within `limit` of its own.

    Args:
      pose: [R, 3] x (m), y (m), yaw (rad); absent robots are parked far away from each other.
      hull_radius: m.
      limit: largest gap between hulls that are near each other, m.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The robots near each robot; N is `ROWS` times `room`.
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
    """Returns where the robots are that each robot is compared with.

    Args:
      pose: [..., R, 3] x (m), y (m), yaw (rad); [R, 3] with `near`.
      near: the robots near each robot; None: all.
      xp: `numpy` or `jax.numpy`.

    Returns:
      x and y (m), [..., 1, R] or [R, N], and whether it is the robot itself, [R, R] or [R, N].
    """
    x, y, count = pose[..., 0], pose[..., 1], pose.shape[-2]
    if near is None:
        return x[..., None, :], y[..., None, :], np.eye(count, dtype=bool)
    return x[near.index], y[near.index], near.index == xp.arange(count)[:, None]
