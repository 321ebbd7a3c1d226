"""Shortest paths of a robot's disc past obstacles, the reference for path efficiency.

If the straight line is free and ends inside the walls, it is the path. Otherwise the path follows
the outlines of obstacles, widened by the disc's radius. `CORNER` points outside each round corner
replace the arc. They lengthen a path by at most 0.8 mm for each right angle that the path turns
(tan(x) / x - 1 = 1.3 % of a quarter circle of 0.037 m, x = 11.25 degrees). NumPy only.
"""

import math
from typing import NamedTuple

import numpy as np

CORNER = 4  # points for each round corner
GOAL = 24  # points on the circle around a target, used if the line to its centre is blocked
_DETOUR = 0.2  # m; length by which a path is first allowed to exceed the straight line
_SLACK = 1e-6  # m; touching does not block
_SIGNS = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])


class _Boxes(NamedTuple):
    """The boxes of an arena, and the least distance that the disc's centre keeps from them.

    Attributes:
      box: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      half: [2, M] the half edges, m.
      radius: Radius of the disc minus `_SLACK`, m.
    """

    box: np.ndarray
    half: np.ndarray
    radius: float


class _Points(NamedTuple):
    """Points of an arena, with their places relative to its boxes.

    Attributes:
      place: [V, 2] m.
      local: [2, V, M] x and y in the frames of the boxes, m.
      beyond: [V, M] the sides of each widened box that a point lies beyond, one bit for each
        side. No line meets a box if both of its ends lie beyond the same side.
    """

    place: np.ndarray
    local: np.ndarray
    beyond: np.ndarray


class _Arena(NamedTuple):
    """The part of an arena in which a path is sought.

    Attributes:
      inside: Half edge of the square within which the disc's centre stays, m.
      boxes: The boxes that are not far away.
      outline: [V, 2] points around the boxes, clear of all boxes and walls, m.
    """

    inside: float
    boxes: _Boxes
    outline: np.ndarray


def shortest(
    side: np.ndarray,
    start: np.ndarray,
    target: np.ndarray,
    obstacle: np.ndarray,
    hull_radius: float,
    target_radius: float,
) -> np.ndarray:
    """Finds the lengths of the shortest paths of robots, each alone in its arena.

    Args:
      side: [A] sides of the square arenas, m.
      start: [A, R, 2] m.
      target: [A, R, 2] m.
      obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m); absent ones stand far away.
      hull_radius: Radius of the disc, m.
      target_radius: Required distance of the disc's centre from the target, m.

    Returns:
      [A, R] m; inf where there is no path.
    """
    start, target, obstacle = (np.asarray(x, np.float64) for x in (start, target, obstacle))
    offset = target - start
    apart = np.linalg.norm(offset, axis=-1)
    length = np.maximum(apart - target_radius, 0.0)
    share = np.divide(length, apart, out=np.zeros_like(apart), where=apart > 0.0)
    ends = start + share[..., None] * offset
    barred = _barred(start[:, :, None], ends[:, :, None], obstacle[:, None], hull_radius)
    inside = 0.5 * np.asarray(side, np.float64) - hull_radius
    walled = (length > 0.0) & ~_within(ends, inside[:, None])
    bent = barred.any(axis=-1) | walled
    for each in np.flatnonzero(bent.any(axis=-1)):
        for robot in np.flatnonzero(bent[each]):
            ends = start[each, robot], target[each, robot], target_radius
            length[each, robot] = _near_way(float(inside[each]), obstacle[each], hull_radius, *ends)
    return length


def _near_way(
    inside: float,
    obstacle: np.ndarray,
    hull: float,
    start: np.ndarray,
    target: np.ndarray,
    reach: float,
) -> float:
    """Computes the length of the shortest path of one robot past obstacles [M, 5], m.

    A path stays within an ellipse around its ends. If the shortest path past the obstacles in an
    ellipse is short enough to stay in it, it meets no other obstacle.
    """
    apart = [np.linalg.norm(obstacle[:, :2] - end, axis=-1) for end in (start, target)]
    least = apart[0] + apart[1] - 2.0 * (np.hypot(*obstacle[:, 3:].T) + hull)
    length, most = float(np.linalg.norm(target - start)) + _DETOUR, 0.0
    while most < length + reach < math.inf:
        most = length + reach
        length = _way(_arena(inside, obstacle[least <= most], hull), start, target, reach)
    return length


def _arena(inside: float, obstacle: np.ndarray, hull: float) -> _Arena:
    """Finds the points around obstacles [M, 5] that paths may lead through."""
    nearest = np.abs(obstacle[:, :2]).max(axis=-1) - np.hypot(*obstacle[:, 3:].T)
    box = obstacle[nearest <= inside + hull]
    boxes = _Boxes(box, box[:, 3:].T, hull - _SLACK)
    return _Arena(inside, boxes, _clear(_outlines(box, hull).reshape(-1, 2), boxes, inside))


def _way(arena: _Arena, start: np.ndarray, target: np.ndarray, reach: float) -> float:
    """Computes the length of the shortest path of one robot, m; inf if there is none.

    This is A* on the visibility graph (Hart, Nilsson & Raphael 1968, "A formal basis for the
    heuristic determination of minimum cost paths"). A line is tested only when the search is at its
    first point, and if it could be part of a shortest path.
    """
    boxes, inside = arena.boxes, arena.inside
    circle = _clear(_circle(target, reach, inside), boxes, inside)
    points = _see(np.concatenate([start[None], arena.outline, circle]), boxes)
    place, goals = points.place, len(points.place) - len(circle)
    away = np.linalg.norm(target - place, axis=-1)
    rest = np.maximum(away - reach, 0.0)
    ends = place + (target - place) * (rest / np.maximum(away, reach))[:, None]
    length, best = np.full(len(place), math.inf), math.inf
    length[0] = 0.0
    least = length + rest
    while least[here := int(np.argmin(least))] < best:
        least[here] = math.inf
        one = _take(points, [here])
        if _within(ends[here], inside) and _are_free(boxes, one, _see(ends[here, None], boxes))[0]:
            best = min(best, length[here] + rest[here])
        by_here = length[here] + np.linalg.norm(place - place[here], axis=-1)
        worth = np.flatnonzero((by_here < length) & (by_here + rest < best))
        worth = worth[_are_free(boxes, one, _take(points, worth))]
        length[worth] = by_here[worth]
        least[worth] = by_here[worth] + rest[worth]
        best = min(best, length[goals:].min(initial=math.inf))
    return best


def _circle(target: np.ndarray, reach: float, inside: float) -> np.ndarray:
    """Returns `GOAL` points around a target, and the points where walls stop the disc, [V, 2]."""
    angle = np.arange(GOAL) * (2.0 * math.pi / GOAL)
    around = [reach * np.stack([np.cos(angle), np.sin(angle)], axis=-1)]
    for axis, wall in ((axis, wall) for axis in (0, 1) for wall in (-inside, inside)):
        across = wall - target[axis]
        if abs(across) <= reach:
            along = math.sqrt(reach**2 - across**2)
            ends = np.array([(across, along), (across, -along)])
            around.append(ends[:, ::-1] if axis else ends)
    return target + np.concatenate(around)


def _are_free(boxes: _Boxes, one: _Points, others: _Points) -> np.ndarray:
    """Tells for each straight line [L] from one point to others whether no box blocks it."""
    line, box = np.nonzero((one.beyond & others.beyond) == 0)
    start = one.local[:, 0, box]
    way = others.local[:, line, box] - start
    free = np.ones(len(others.place), bool)
    free[line[_meets(start, way, boxes.half[:, box], boxes.radius)]] = False
    return free


def _outlines(boxes: np.ndarray, hull: float) -> np.ndarray:
    """Returns points [M, 4 * CORNER, 2] around boxes [M, 5], just outside the widened outlines."""
    half_step = 0.25 * math.pi / CORNER
    angle = (2.0 * np.arange(CORNER) + 1.0) * half_step
    turned = angle + 0.5 * math.pi * np.arange(4)[:, None]
    round_ = np.stack([np.cos(turned), np.sin(turned)], axis=-1) * hull / math.cos(half_step)
    local = (_SIGNS[:, None] * boxes[:, None, None, 3:] + round_).reshape(len(boxes), 4 * CORNER, 2)
    cos, sin = np.cos(boxes[:, None, 2]), np.sin(boxes[:, None, 2])
    x, y = local[..., 0], local[..., 1]
    return boxes[:, None, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _see(place: np.ndarray, boxes: _Boxes) -> _Points:
    """Computes the places of points [V, 2] relative to the boxes."""
    x, y = local = _into(place[:, None] - boxes.box[:, :2], boxes.box)
    length, width = boxes.half + boxes.radius
    sides = np.stack([x >= length, x <= -length, y >= width, y <= -width], axis=-1)
    return _Points(place, local, np.packbits(sides, axis=-1)[..., 0])


def _clear(place: np.ndarray, boxes: _Boxes, inside: float) -> np.ndarray:
    """Keeps the points [V, 2] where the disc is clear of boxes and walls."""
    x, y = np.maximum(np.abs(_see(place, boxes).local) - boxes.half[:, None], 0.0)
    return place[(x * x + y * y >= boxes.radius**2).all(axis=-1) & _within(place, inside)]


def _take(points: _Points, rows: np.ndarray | list[int]) -> _Points:
    """Keeps some of the points."""
    return _Points(points.place[rows], points.local[:, rows], points.beyond[rows])


def _within(points: np.ndarray, inside: float | np.ndarray) -> np.ndarray:
    """Tells whether points [..., 2] lie in the square of half edge `inside`, [...]."""
    return np.abs(points).max(axis=-1) <= inside + _SLACK


def _barred(first: np.ndarray, second: np.ndarray, box: np.ndarray, hull: float) -> np.ndarray:
    """Tells whether boxes [..., 5] block a disc on straight lines between points [..., 2]."""
    start, way = _into(first - box[..., :2], box), _into(second - first, box)
    return _meets(start, way, np.moveaxis(box[..., 3:], -1, 0), hull - _SLACK)


def _meets(start: np.ndarray, way: np.ndarray, half: np.ndarray, radius: float) -> np.ndarray:
    """Tells whether lines from `start` along `way` [2, ...] come within a radius of centred boxes.

    A line does so if it enters the box, with half edges [2, ...], after the box is widened by the
    radius. That shape consists of two boxes, each longer by the radius at both ends of one axis,
    and a circle around each corner.
    """
    wide = half[:, None] + radius * np.eye(2).reshape(2, 2, *[1] * (half.ndim - 1))
    pace = np.where(np.abs(way) < 1e-12, 1e-12, way)[:, None]
    one, other = (-wide - start[:, None]) / pace, (wide - start[:, None]) / pace
    enter = np.maximum(np.minimum(one, other).max(axis=0), 0.0)
    leave = np.minimum(np.maximum(one, other).min(axis=0), 1.0)
    corner = _SIGNS.T.reshape(2, 4, *[1] * (half.ndim - 1)) * half[:, None] - start[:, None]
    square = np.maximum((way * way).sum(axis=0), 1e-30)
    along = np.minimum(np.maximum((corner * way[:, None]).sum(axis=0) / square, 0.0), 1.0)
    beside = corner - along * way[:, None]
    near = (beside * beside).sum(axis=0) < radius * radius
    return (enter < leave).any(axis=0) | near.any(axis=0)


def _into(vector: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Turns vectors [..., 2] into the frames of boxes [..., 5]: [2, ...] x and y."""
    cos, sin = np.cos(box[..., 2]), np.sin(box[..., 2])
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x])
