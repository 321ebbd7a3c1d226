"""Computes way-points for robots that have a map, from shortest paths on a grid of the arena.

A cell is free if a hull fits around the middle of the cell. Each free cell is connected to the free
cells among its eight neighbours. Dijkstra's algorithm from each target gives a path from every
cell, so a robot that is pushed off its path still has a path. Steps close to an obstacle cost more,
since paths would otherwise touch every corner.
"""

import importlib
from typing import Any, NamedTuple

import numpy as np

from swarmjax.config import ConfigError

CELL = 0.01  # m; 0.02 m cells could miss the 0.016 m for centres in a 0.09 m passage on s6
COARSE_CELL, LARGE = 0.02, 2.0  # m; COARSE_CELL is for arenas with a side above LARGE
MARGIN, DEARER = 0.015, 3.0  # steps cost DEARER times as much with under MARGIN m around the hull
REACH = 24  # maximum distance of a way-point, in cells along the path
_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))  # steps to half of the neighbours; others by symmetry


class Plan(NamedTuple):
    """The paths in one arena of G by G cells.

    Attributes:
      cell: edge of a cell, m.
      free: [G, G] whether a hull fits around the middle of a cell; rows are y.
      nearest: [G * G] each cell's nearest free cell.
      following: [R, G * G] the next cell on the path to each robot's target; the cell itself at
        the end, and if there is no path.
    """

    cell: float
    free: np.ndarray
    nearest: np.ndarray
    following: np.ndarray


def plan(side: float, target: np.ndarray, obstacle: np.ndarray, hull_radius: float) -> Plan:
    """Finds the paths to all targets of an arena.

    Args:
      side: side of the arena, m.
      target: [R, 2] targets, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      hull_radius: radius of the hull, m.

    Returns:
      The plan.
    """
    sparse, ndimage = scipy()
    cell = COARSE_CELL if side > LARGE else CELL
    count = max(round(side / cell), 1)
    middle = (np.arange(count) + 0.5) * cell - 0.5 * count * cell
    point = np.stack(np.meshgrid(middle, middle), axis=-1)
    room = clearance(point, side, obstacle) - hull_radius
    free = room > 0.0
    number = np.arange(count * count).reshape(count, count)
    _, index = ndimage.distance_transform_edt(~free, return_indices=True)
    nearest = number[tuple(index)].ravel() if free.any() else number.ravel()
    graph = _graph(sparse, free, room, cell)
    goal = nearest[_cell_of(target, cell, count)]
    before = sparse.csgraph.dijkstra(graph, indices=goal, return_predecessors=True)[1]
    following = np.where(before < 0, number.ravel(), before).astype(np.int32)
    return Plan(cell, free, nearest, following)


def scipy() -> tuple[Any, Any]:
    """Imports `scipy.sparse` with its graphs, and `scipy.ndimage`.

    Raises:
      ConfigError: if scipy is not installed.
    """
    try:
        importlib.import_module("scipy.sparse.csgraph")
        return importlib.import_module("scipy.sparse"), importlib.import_module("scipy.ndimage")
    except ImportError as error:
        raise ConfigError(f"scipy is missing ({error}): install the extra navground.") from None


def clearance(point: np.ndarray, side: float, obstacle: np.ndarray) -> np.ndarray:
    """Computes the distances [...] of points [..., 2] to the nearest wall or box, m; 0 in a box."""
    found = 0.5 * side - np.abs(point).max(axis=-1)
    for x, y, yaw, *half in obstacle:
        cos, sin = np.cos(yaw), np.sin(yaw)
        off = point - (x, y)
        along = np.stack(
            [cos * off[..., 0] + sin * off[..., 1], cos * off[..., 1] - sin * off[..., 0]]
        )
        beyond = np.maximum(np.abs(along) - np.reshape(half, (2,) + (1,) * (along.ndim - 1)), 0.0)
        found = np.minimum(found, np.hypot(*beyond))
    return found


def _graph(sparse: Any, free: np.ndarray, room: np.ndarray, cell: float) -> Any:
    """Connects neighbouring free cells; returns a symmetric matrix of step costs in m."""
    count = len(free)
    number = np.arange(free.size).reshape(free.shape)
    price = np.where(room < MARGIN, DEARER, 1.0)
    rows, columns, lengths = [], [], []
    for up, right in _STEPS:
        here = (slice(0, count - up), slice(max(-right, 0), count - max(right, 0)))
        there = (slice(up, count), slice(max(right, 0), count - max(-right, 0)))
        joined = free[here] & free[there]
        rows.append(number[here][joined])
        columns.append(number[there][joined])
        lengths.append(cell * np.hypot(up, right) * np.maximum(price[here], price[there])[joined])
    edges = [np.concatenate(each) for each in (rows, columns, lengths)]
    one_way = sparse.coo_array((edges[2], (edges[0], edges[1])), (free.size, free.size))
    return (one_way + one_way.T).tocsr()


def _cell_of(place: np.ndarray, cell: float, count: int) -> np.ndarray:
    """Returns the numbers [...] of the cells that contain places [..., 2]."""
    index = np.clip(np.floor(place / cell + 0.5 * count).astype(int), 0, count - 1)
    return index[..., 1] * count + index[..., 0]


def way_points(plan: Plan, place: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Finds each robot's way-point: the furthest path point that a free straight line reaches.

    Args:
      plan: plan of the arena.
      place: [R, 2] positions of the robots, m.
      target: [R, 2] targets, m.

    Returns:
      [R, 2] way-points, m; the target itself if it is in sight.
    """
    count, robot = len(plan.free), np.arange(len(place))
    path = [plan.nearest[_cell_of(place, plan.cell, count)]]
    for _ in range(REACH):
        path.append(plan.following[robot, path[-1]])
    cells = np.stack(path, axis=-1)
    index = np.stack([cells % count, cells // count], axis=-1)
    point = (index + 0.5 - 0.5 * count) * plan.cell  # [R, REACH + 1, 2]
    at_end = cells == plan.following[robot[:, None], cells]
    point = np.where(at_end[..., None], target[:, None], point)
    share = np.linspace(0.0, 1.0, REACH + 1)[:, None, None, None]
    line = place[:, None] + share * (point - place[:, None])
    open_ = plan.free.ravel()[_cell_of(line, plan.cell, count)]
    # Both ends of a line may be in occupied cells: robots are pushed and targets are drawn there.
    seen = open_[1:-1].all(axis=0)
    furthest = np.where(seen, np.arange(REACH + 1), 1).max(axis=-1)
    return point[robot, furthest]
