"""Shortest ways of a robot's disc past obstacles: what path efficiency is measured by.

Where the straight line is free and ends inside the walls, it is the way. Elsewhere the way leads
along the outlines of obstacles, widened by the disc's radius, whose round corners are replaced by
`CORNER` points outside of them: that makes a way longer by 0.8 mm at most for each right angle that
it turns (tan(x) / x - 1 = 1.3 % of a quarter circle of 0.037 m, x = 11.25 degrees). NumPy only.
"""

import math

import numpy as np

CORNER = 4  # points for each round corner
GOAL = 24  # points on the circle about a target, where the way straight to its centre is barred
_SLACK = 1e-6  # m; what touches is not barred
_SIGNS = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])


def shortest(
    side: np.ndarray,
    start: np.ndarray,
    target: np.ndarray,
    obstacle: np.ndarray,
    hull_radius: float,
    target_radius: float,
) -> np.ndarray:
    """Finds the lengths of the shortest ways that robots could drive, each alone in its arena.

    Args:
        side: [A] of the square arenas, m.
        start: [A, R, 2] m.
        target: [A, R, 2] m.
        obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m); absent ones stand far away.
        hull_radius: Of the disc, m.
        target_radius: How near its centre must come to the target, m.

    Returns:
        [A, R] m; inf where there is no way at all.
    """
    start, target, obstacle = (np.asarray(x, np.float64) for x in (start, target, obstacle))
    offset = target - start
    apart = np.linalg.norm(offset, axis=-1)
    found = np.maximum(apart - target_radius, 0.0)
    share = np.divide(found, apart, out=np.zeros_like(apart), where=apart > 0.0)
    ends = start + share[..., None] * offset
    barred = _barred(start[:, :, None], ends[:, :, None], obstacle[:, None], hull_radius)
    inside = 0.5 * np.asarray(side, np.float64) - hull_radius
    walled = (found > 0.0) & ~_within(ends, inside[:, None])
    for arena, robot in np.argwhere(barred.any(axis=-1) | walled):
        found[arena, robot] = _way(
            float(inside[arena]),
            start[arena, robot],
            target[arena, robot],
            obstacle[arena],
            barred[arena, robot],
            (hull_radius, target_radius),
        )
    return found


def _way(
    inside: float,
    start: np.ndarray,
    target: np.ndarray,
    obstacle: np.ndarray,
    known: np.ndarray,
    radii: tuple[float, float],
) -> float:
    """Length of the shortest way of one robot, m.

    Only the obstacles [M] that are known are gone around. A way that is shortest among these, and
    meets no other, is shortest among all; else those that it meets become known too.
    """
    hull, reach = radii
    circle = _circle(target, reach, inside)
    while True:
        boxes = obstacle[known]
        corners = _outlines(boxes, hull).reshape(-1, 2)
        points = np.concatenate([start[None], _free(corners, boxes, hull, inside)])
        ends = _free(circle, boxes, hull, inside)
        length, way = _search(points, ends, target, boxes, (*radii, inside))
        if math.isinf(length):
            return length
        met = _barred(way[:-1, None], way[1:, None], obstacle[None], hull).any(axis=0)
        if not (met & ~known).any():
            return length
        known = known | met


def _circle(target: np.ndarray, reach: float, inside: float) -> np.ndarray:
    """Points [V, 2] around a target: `GOAL` of them, and those where the walls stop the disc."""
    angle = np.arange(GOAL) * (2.0 * math.pi / GOAL)
    around = [reach * np.stack([np.cos(angle), np.sin(angle)], axis=-1)]
    for axis, wall in ((axis, wall) for axis in (0, 1) for wall in (-inside, inside)):
        across = wall - target[axis]
        if abs(across) <= reach:
            along = math.sqrt(reach**2 - across**2)
            ends = np.array([(across, along), (across, -along)])
            around.append(ends[:, ::-1] if axis else ends)
    return target + np.concatenate(around)


def _search(
    points: np.ndarray,
    circle: np.ndarray,
    target: np.ndarray,
    boxes: np.ndarray,
    sizes: tuple[float, float, float],
) -> tuple[float, np.ndarray]:
    """Shortest way from the first of the points [V, 2] past boxes: its length, and [W, 2] points.

    Dijkstra 1959, "A note on two problems in connexion with graphs", on the visibility graph.
    """
    hull, reach, inside = sizes
    steps = _legs(points, points, boxes, hull)
    offset = target - points
    apart = np.linalg.norm(offset, axis=-1, keepdims=True)
    nearest = points + offset * np.maximum(1.0 - reach / np.maximum(apart, reach), 0.0)
    straight = np.where(_within(nearest, inside), _leg(points, nearest, boxes, hull), np.inf)
    last = np.concatenate([straight[:, None], _legs(points, circle, boxes, hull)], axis=-1)
    length = np.where(np.arange(len(points)) == 0, 0.0, np.inf)
    before, open_ = np.zeros(len(points), int), np.ones(len(points), bool)
    while np.isfinite(length[open_]).any():
        here = int(np.argmin(np.where(open_, length, np.inf)))
        open_[here] = False
        by_here = length[here] + steps[here]
        before = np.where(by_here < length, here, before)
        length = np.minimum(length, by_here)
    total = length + last.min(axis=-1)
    end = int(np.argmin(total))
    choice = int(np.argmin(last[end]))
    way = [nearest[end] if choice == 0 else circle[choice - 1], points[end]]
    while end and math.isfinite(total.min()):
        end = int(before[end])
        way.append(points[end])
    return float(total.min()), np.array(way)


def _legs(first: np.ndarray, second: np.ndarray, boxes: np.ndarray, hull: float) -> np.ndarray:
    """Lengths [V, W] of the straight lines between points [V, 2] and [W, 2], inf where barred."""
    return _leg(first[:, None], second[None], boxes, hull)


def _leg(first: np.ndarray, second: np.ndarray, boxes: np.ndarray, hull: float) -> np.ndarray:
    """Lengths [...] of the straight lines between points [..., 2], inf where barred."""
    barred = _barred(first[..., None, :], second[..., None, :], boxes, hull).any(axis=-1)
    return np.where(barred, np.inf, np.linalg.norm(second - first, axis=-1))


def _outlines(boxes: np.ndarray, hull: float) -> np.ndarray:
    """Points [M, 4 * CORNER, 2] around boxes [M, 5], just outside their widened outlines."""
    half_step = 0.25 * math.pi / CORNER
    angle = (2.0 * np.arange(CORNER) + 1.0) * half_step
    turned = angle + 0.5 * math.pi * np.arange(4)[:, None]
    round_ = np.stack([np.cos(turned), np.sin(turned)], axis=-1) * hull / math.cos(half_step)
    local = (_SIGNS[:, None] * boxes[:, None, None, 3:] + round_).reshape(len(boxes), 4 * CORNER, 2)
    cos, sin = np.cos(boxes[:, None, 2]), np.sin(boxes[:, None, 2])
    x, y = local[..., 0], local[..., 1]
    return boxes[:, None, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _free(points: np.ndarray, boxes: np.ndarray, hull: float, inside: float) -> np.ndarray:
    """Keeps those of points [V, 2] where the disc stands clear of boxes and walls."""
    barred = _barred(points[:, None], points[:, None], boxes[None], hull).any(axis=-1)
    return points[~barred & _within(points, inside)]


def _within(points: np.ndarray, inside: float | np.ndarray) -> np.ndarray:
    """Whether [...] points [..., 2] lie in the square of half edge `inside`."""
    return np.abs(points).max(axis=-1) <= inside + _SLACK


def _barred(first: np.ndarray, second: np.ndarray, box: np.ndarray, hull: float) -> np.ndarray:
    """Whether [...] boxes [..., 5] bar the straight ways of a disc between points [..., 2].

    The disc meets a box where its centre enters the box widened by its radius: two boxes, each
    longer by the radius at both ends of one axis, and a circle about each corner.
    """
    radius = hull - _SLACK
    start, way = _into(first - box[..., :2], box), _into(second - first, box)
    half = np.broadcast_to(box[..., 3:], start.shape)
    meets = _enters(start, way, half + np.array([radius, 0.0]))
    meets |= _enters(start, way, half + np.array([0.0, radius]))
    square = np.maximum((way * way).sum(axis=-1), 1e-30)
    for sign in _SIGNS:
        offset = sign * half - start
        along = np.clip((offset * way).sum(axis=-1) / square, 0.0, 1.0)
        beside = offset - along[..., None] * way
        meets |= (beside * beside).sum(axis=-1) < radius * radius
    return meets


def _into(vector: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Turns vectors [..., 2] into the frames of boxes [..., 5]."""
    cos, sin = np.cos(box[..., 2]), np.sin(box[..., 2])
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def _enters(start: np.ndarray, way: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Whether [...] lines from `start` by `way` [..., 2] enter boxes of these half edges."""
    pace = np.where(np.abs(way) < 1e-12, 1e-12, way)
    one, other = (-half - start) / pace, (half - start) / pace
    enter = np.minimum(one, other).max(axis=-1)
    leave = np.maximum(one, other).min(axis=-1)
    return np.maximum(enter, 0.0) < np.minimum(leave, 1.0)
