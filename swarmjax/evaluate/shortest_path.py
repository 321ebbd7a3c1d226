"""Shortest paths of a robot's disc past obstacles, the reference for path efficiency.

If the straight line is free and ends inside the walls, it is the path. Otherwise the path follows
the outlines of obstacles, widened by the disc's radius. `CORNER` points outside each round corner
replace the arc. They lengthen a path by at most 0.8 mm for each right angle that the path turns
(tan(x) / x - 1 = 1.3 % of a quarter circle of 0.037 m, x = 11.25 degrees). NumPy only.

The robots of an arena share these points. Each line between two points is tested at most once, and
only if it could be part of a shortest path.
"""

import math
from typing import NamedTuple

import numpy as np

CORNER = 4  # points for each round corner
GOAL = 24  # points on the circle around a target, used if the straight way to its centre is blocked
_SLACK = 1e-6  # m; touching does not block
_SIGNS = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
# These three numbers change the computing time, never the result.
_DETOUR = 1.1  # times the straight line's length; most paths are shorter, and these are tried first
_NEAREST = 8  # each line is tested first against this many nearest boxes, which block most lines
# With more pairs of a line and a box than this, testing the nearest boxes first is faster.
_MANY = 1000


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


class _Lines(NamedTuple):
    """L straight lines, from rows [L] of the first points to rows [L] of the second points."""

    first: _Points
    begin: np.ndarray
    second: _Points
    end: np.ndarray


class _Arena(NamedTuple):
    """The data that the robots of an arena share.

    Attributes:
      inside: Half edge of the square within which the disc's centre stays, m.
      boxes: The boxes that are not far away.
      outline: V points around the boxes, clear of all boxes and walls.
      legs: [V, V] lengths of the straight lines between these points, m; inf if blocked, NaN if
        not yet tested. `_are_free` fills it in.
    """

    inside: float
    boxes: _Boxes
    outline: _Points
    legs: np.ndarray


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
        arena = _arena(float(inside[each]), obstacle[each], hull_radius)
        for robot in np.flatnonzero(bent[each]):
            length[each, robot] = _way(
                arena, start[each, robot], target[each, robot], target_radius
            )
    return length


def _arena(inside: float, obstacle: np.ndarray, hull: float) -> _Arena:
    """Finds the points around obstacles [M, 5] that paths may lead through."""
    nearest = np.abs(obstacle[:, :2]).max(axis=-1) - np.hypot(*obstacle[:, 3:].T)
    box = obstacle[nearest <= inside + hull]
    boxes = _Boxes(box, box[:, 3:].T, hull - _SLACK)
    outline = _free(_see(_outlines(box, hull).reshape(-1, 2), boxes), boxes, inside)
    count = len(outline.place)
    return _Arena(inside, boxes, outline, np.full((count, count), np.nan))


def _way(arena: _Arena, start: np.ndarray, target: np.ndarray, reach: float) -> float:
    """Computes the length of the shortest path of one robot, m.

    A path of a given length stays within an ellipse. The ellipse holds the points whose distances
    to start and target add up to at most that length. So the points in a small ellipse suffice if
    they give a path that is no longer.
    """
    boxes, place = arena.boxes, arena.outline.place
    begin = _see(start[None], boxes)
    circle = _free(_see(_circle(target, reach, arena.inside), boxes), boxes, arena.inside)
    around = np.linalg.norm(place - start, axis=-1)
    around += np.maximum(np.linalg.norm(target - place, axis=-1) - reach, 0.0)
    most, length = _DETOUR * max(math.dist(start, target), reach), math.inf
    for each in (most, math.inf):
        rows = np.flatnonzero(around <= min(each, length + _SLACK))
        length = _way_through(arena, rows, begin, circle, target, reach)
        if length <= most:
            break
    return length


def _way_through(
    arena: _Arena,
    rows: np.ndarray,
    begin: _Points,
    circle: _Points,
    target: np.ndarray,
    reach: float,
) -> float:
    """Computes the length of the shortest path through the rows [W] of an arena's points, m."""
    boxes, some = arena.boxes, _take(arena.outline, rows)
    points = _join(begin, some)
    rest = np.maximum(np.linalg.norm(target - some.place, axis=-1) - reach, 0.0)
    last = _straight(arena, points, target, reach)
    first = _legs(boxes, _fan(begin, some))
    length = np.concatenate([[0.0], _search(arena, rows, first, rest, last)])
    best = (length + last).min()
    # If the straight line is blocked, a path to another point of the circle may be the shortest.
    far = np.linalg.norm(points.place[:, None] - circle.place, axis=-1) + length[:, None]
    row, column = np.nonzero((far < best) & np.isinf(last)[:, None])
    around = length[row] + _legs(boxes, _Lines(points, row, circle, column))
    return float(around.min(initial=best))


def _straight(arena: _Arena, points: _Points, target: np.ndarray, reach: float) -> np.ndarray:
    """Computes the lengths [V] of straight lines from points to a target, m; inf if blocked."""
    offset = target - points.place
    apart = np.linalg.norm(offset, axis=-1)
    share = np.maximum(apart - reach, 0.0) / np.maximum(apart, reach)
    end, each = points.place + offset * share[:, None], np.arange(len(offset))
    length = _legs(arena.boxes, _Lines(points, each, _see(end, arena.boxes), each))
    length[~_within(end, arena.inside)] = np.inf
    return length


def _search(
    arena: _Arena, rows: np.ndarray, first: np.ndarray, rest: np.ndarray, last: np.ndarray
) -> np.ndarray:
    """Computes the lengths [W] of the shortest paths from the start to points of an arena, m.

    This is A* on the visibility graph: the algorithm of Dijkstra 1959, "A note on two problems in
    connexion with graphs". The search leaves out points that are too far away even if a straight
    line led from them to the target (Hart, Nilsson & Raphael 1968, "A formal basis for the
    heuristic determination of minimum cost paths").

    Args:
      arena: Arena of the points; it stores the results for the lines between them.
      rows: [W] rows of the points.
      first: [W] lengths of the straight lines from the start, m; inf if blocked.
      rest: [W] lower bounds of the distances to the target.
      last: [1 + W] lengths of the straight lines to the target from the start and from the points,
        m; inf if blocked.

    Returns:
      The lengths. The length for a point may be too large if the shortest path does not lead
      through the point.
    """
    length, least, best = first.copy(), first + rest, last[0]
    place = arena.outline.place[rows]
    while least.size and least[here := int(np.argmin(least))] < best:
        best = min(best, length[here] + last[1 + here])
        least[here] = np.inf
        by_here = length[here] + np.linalg.norm(place - place[here], axis=-1)
        worth = np.flatnonzero((by_here < length) & (by_here + rest < best))
        worth = worth[_are_free(arena, rows[here], rows[worth])]
        length[worth] = by_here[worth]
        least[worth] = by_here[worth] + rest[worth]
    return length


def _are_free(arena: _Arena, point: int, others: np.ndarray) -> np.ndarray:
    """Tells whether the straight lines from one point of an arena to others [L] are free."""
    new = others[np.isnan(arena.legs[point, others])]
    if new.size:
        one, some = _take(arena.outline, [point]), _take(arena.outline, new)
        arena.legs[point, new] = arena.legs[new, point] = _legs(arena.boxes, _fan(one, some))
    return np.isfinite(arena.legs[point, others])


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


def _fan(one: _Points, others: _Points) -> _Lines:
    """Makes lines from a single point [1] to others [L]."""
    each = np.arange(len(others.place))
    return _Lines(one, np.zeros_like(each), others, each)


def _legs(boxes: _Boxes, lines: _Lines) -> np.ndarray:
    """Computes the lengths [L] of straight lines, m; inf if blocked."""
    first, begin, second, end = lines
    length = np.linalg.norm(second.place[end] - first.place[begin], axis=-1)
    near = (first.beyond[begin] & second.beyond[end]) == 0
    if near.shape[1] > _NEAREST and np.count_nonzero(near) > _MANY:
        soon = near & _nearest(boxes, first)[begin]
        barred = _are_barred(boxes, lines, soon)
        length[barred] = np.inf
        near &= ~(soon | barred[:, None])
    length[_are_barred(boxes, lines, near)] = np.inf
    return length


def _nearest(boxes: _Boxes, points: _Points) -> np.ndarray:
    """Returns the nearest boxes of each point, [V, M]."""
    x, y = np.maximum(np.abs(points.local) - boxes.half[:, None], 0.0)
    order = np.argpartition(x * x + y * y, _NEAREST, axis=-1)
    nearest = np.zeros(order.shape, bool)
    np.put_along_axis(nearest, order[:, :_NEAREST], True, axis=-1)
    return nearest


def _are_barred(boxes: _Boxes, lines: _Lines, pairs: np.ndarray) -> np.ndarray:
    """Tells for each line [L] whether any of the boxes paired with it, [L, M], blocks it."""
    line, box = np.nonzero(pairs)
    start = lines.first.local[:, lines.begin[line], box]
    way = lines.second.local[:, lines.end[line], box] - start
    barred = np.zeros(len(pairs), bool)
    barred[line[_meets(start, way, boxes.half[:, box], boxes.radius)]] = True
    return barred


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


def _free(points: _Points, boxes: _Boxes, inside: float) -> _Points:
    """Keeps the points where the disc is clear of boxes and walls."""
    x, y = np.maximum(np.abs(points.local) - boxes.half[:, None], 0.0)
    free = (x * x + y * y >= boxes.radius**2).all(axis=-1) & _within(points.place, inside)
    return _take(points, free)


def _take(points: _Points, rows: np.ndarray | list[int]) -> _Points:
    """Keeps some of the points."""
    return _Points(points.place[rows], points.local[:, rows], points.beyond[rows])


def _join(first: _Points, second: _Points) -> _Points:
    """Concatenates points."""
    return _Points(*(np.concatenate(pair, axis=-2) for pair in zip(first, second, strict=True)))


def _within(points: np.ndarray, inside: float | np.ndarray) -> np.ndarray:
    """Tells whether points [..., 2] lie in the square of half edge `inside`, [...]."""
    return np.abs(points).max(axis=-1) <= inside + _SLACK


def _barred(first: np.ndarray, second: np.ndarray, box: np.ndarray, hull: float) -> np.ndarray:
    """Tells whether boxes [..., 5] block a disc's straight ways between points [..., 2], [...]."""
    start, way = _into(first - box[..., :2], box), _into(second - first, box)
    return _meets(start, way, np.moveaxis(box[..., 3:], -1, 0), hull - _SLACK)


def _meets(start: np.ndarray, way: np.ndarray, half: np.ndarray, radius: float) -> np.ndarray:
    """Tells whether lines from `start` along `way` [2, ...] come within a radius of boxes at 0.

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
