"""Plans: proof that the robots of a level can all arrive if one moves at a time.

A plan is found on a grid, for discs of the hull's radius. `check` tests the plan against the exact
shapes, with independent arithmetic. If no robot can reach its target, one robot first steps aside
to let another pass: into a bay, or off another robot's target. A robot stops for good as soon as it
has reached its target. NumPy only.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np

from swarmjax.task.level import Level

CELL = 0.015  # m, of a grid cell; in the narrowest door, 0.1 m, a hull's centre can move by 0.023 m
_SPARE = 0.0016  # m, added to the hull: between two cells a disc comes up to 1.5 mm nearer a corner
_NEVER = np.iinfo(np.int32).max // 2
_ORDERS = 30  # orders of robots to try: a robot that parks first may block others
_REFUGES = 400  # most cells to try for stepping aside
_STEPS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]


class Move(NamedTuple):
    """The path of one robot.

    Attributes:
      robot: Number of the robot.
      path: [P, 2] points that it visits along straight lines, m.
    """

    robot: int
    path: np.ndarray


class _Grid(NamedTuple):
    """Cells of an arena, [N, N] each.

    Attributes:
      place: [N, N, 2] centres of the cells, m.
      free: Whether the walls leave enough space for a hull there.
      apart: Least distance between two robots, m.
      reach: Distance from the target at which a robot has arrived, m.
    """

    place: np.ndarray
    free: np.ndarray
    apart: float
    reach: float


def find(level: Level, hull_radius: float, target_radius: float) -> list[Move] | None:
    """Finds a plan.

    Args:
      level: Level of one arena, NumPy; absent robots are ignored.
      hull_radius: Radius of the robots, m.
      target_radius: Radius within which a robot has arrived, m.

    Returns:
      The moves in order; None if no plan was found, although a plan may still exist.
    """
    grid = _grid(level, hull_radius, target_radius)
    robots = np.flatnonzero(level.present)
    random = np.random.default_rng(0)
    orders = [robots, *(random.permutation(robots) for _ in range(_ORDERS - 1))]
    return next((found for order in orders if (found := _try(grid, level, order))), None)


def _try(grid: _Grid, level: Level, order: np.ndarray) -> list[Move] | None:
    """Finds a plan in which the robots go in the given order where they can."""
    place = level.start[:, :2].astype(np.float64)
    left, moves = [int(i) for i in order], []
    while left:
        step = _next(grid, level, place, order, left)
        if step is None:
            return None
        for move in step:
            moves.append(move)
            place[move.robot] = move.path[-1]
        left.remove(step[-1].robot)
    return moves


def _next(
    grid: _Grid, level: Level, place: np.ndarray, robots: np.ndarray, left: list[int]
) -> list[Move] | None:
    """Finds moves that let one robot arrive, if necessary past another that steps aside."""
    for robot in left:
        if (path := _arrive(grid, level, place, robots, robot)) is not None:
            return [Move(robot, path)]
    for robot in left:
        for path in _refuges(grid, place, robots, robot):
            if (found := _pass(grid, level, place, robots, left, Move(robot, path))) is not None:
                return found
    return None


def _pass(
    grid: _Grid,
    level: Level,
    place: np.ndarray,
    robots: np.ndarray,
    left: list[int],
    aside: Move,
) -> list[Move] | None:
    """Lets one robot step aside so that another can arrive, if the first can still arrive later."""
    for other in left:
        if other == aside.robot:
            continue
        moved = place.copy()
        moved[aside.robot] = aside.path[-1]
        if (path := _arrive(grid, level, moved, robots, other)) is None:
            continue
        moved[other] = path[-1]
        if _arrive(grid, level, moved, robots, aside.robot) is not None:
            return [aside, Move(other, path)]
    return None


def _arrive(
    grid: _Grid, level: Level, place: np.ndarray, robots: np.ndarray, robot: int
) -> np.ndarray | None:
    """Finds a robot's path to its target past all others in their places, [P, 2]."""
    free = _free(grid, place, robots, robot)
    away = np.linalg.norm(grid.place - level.target[robot], axis=-1)
    goal = free & (away <= grid.reach - _SPARE)
    if not goal.any():
        return None
    far = _spread(free, goal, _near(grid, free, place[robot]))
    return _descend(grid, far, place[robot])


def _refuges(grid: _Grid, place: np.ndarray, robots: np.ndarray, robot: int) -> list[np.ndarray]:
    """Lists paths of a robot to places where it can step aside, the farthest first."""
    free = _free(grid, place, robots, robot)
    near = _near(grid, free, place[robot])
    far = _spread(free, near, np.zeros_like(free))
    cells = np.argwhere(far < _NEVER)
    order = np.argsort(-far[tuple(cells.T)], kind="stable")
    chosen = cells[order[:: max(1, len(order) // _REFUGES)]]
    ways = []
    for cell in chosen:
        way = [grid.place[tuple(cell)], *_walk(far, tuple(cell), grid.place)]
        ways.append(np.array([place[robot], *way[::-1]]))
    return ways


def _grid(level: Level, hull: float, reach: float) -> _Grid:
    count = math.ceil(float(level.side) / CELL)
    axis = (np.arange(count) + 0.5) * (float(level.side) / count) - 0.5 * float(level.side)
    place = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    free = 0.5 * float(level.side) - np.abs(place).max(axis=-1) >= hull + _SPARE
    for box in level.obstacle[level.obstacle_present].astype(np.float64):
        free &= _box_distance(place, box) >= hull + _SPARE
    return _Grid(place, free, 2.0 * hull + _SPARE, reach)


def _box_distance(place: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Computes the distance [...] of points [..., 2] from a turned rectangle [5], m; 0 inside."""
    cos, sin = math.cos(box[2]), math.sin(box[2])
    x, y = place[..., 0] - box[0], place[..., 1] - box[1]
    across = np.abs(cos * x + sin * y) - box[3], np.abs(cos * y - sin * x) - box[4]
    return np.hypot(*(np.maximum(each, 0.0) for each in across))


def _free(grid: _Grid, place: np.ndarray, robots: np.ndarray, robot: int) -> np.ndarray:
    """Returns the cells that neither walls nor other robots block, [N, N]."""
    free = grid.free.copy()
    for other in robots:
        if other != robot:
            free &= np.linalg.norm(grid.place - place[other], axis=-1) >= grid.apart
    return free


def _near(grid: _Grid, free: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Returns the free cells next to a robot, where its path can begin, [N, N]."""
    return free & (np.linalg.norm(grid.place - place, axis=-1) <= CELL)


def _spread(free: np.ndarray, goal: np.ndarray, until: np.ndarray) -> np.ndarray:
    """Counts each cell's steps to the nearest goal, [N, N]; stops at the first cell of `until`."""
    far = np.where(goal, 0, _NEVER).astype(np.int32)
    edge, steps = goal, 0
    while edge.any() and not (far[until] < _NEVER).any():
        steps += 1
        wide = np.zeros_like(edge)
        padded = np.pad(edge, 1)
        for i, j in _STEPS:
            wide |= padded[1 + i : 1 + i + len(edge), 1 + j : 1 + j + len(edge)]
        edge = wide & free & (far == _NEVER)
        far[edge] = steps
    return far


def _descend(grid: _Grid, far: np.ndarray, place: np.ndarray) -> np.ndarray | None:
    """Follows decreasing steps from a robot's place to a goal, [P, 2]."""
    near = np.where(_near(grid, far < _NEVER, place), far, _NEVER)
    cell = np.unravel_index(int(np.argmin(near)), near.shape)
    if near[cell] == _NEVER:
        return None
    first = (int(cell[0]), int(cell[1]))
    return np.array([place, grid.place[first], *_walk(far, first, grid.place)])


def _walk(far: np.ndarray, cell: tuple[int, ...], place: np.ndarray) -> list[np.ndarray]:
    """Lists the places on the way from a cell to a goal; `far` is 0 at a goal."""
    found = []
    while far[cell]:
        around = [(cell[0] + i, cell[1] + j) for i, j in _STEPS]
        inside = [c for c in around if 0 <= c[0] < len(far) and 0 <= c[1] < len(far)]
        cell = min(inside, key=lambda c: far[c])
        found.append(place[cell])
    return found


def check(level: Level, moves: list[Move], hull_radius: float, target_radius: float) -> str | None:
    """Tests a plan against the exact shapes.

    Args:
      level: Level of one arena.
      moves: The plan.
      hull_radius: Radius of the robots, m.
      target_radius: Radius within which a robot has arrived, m.

    Returns:
      What is wrong with the plan; None if nothing is wrong.
    """
    place = level.start[:, :2].astype(np.float64)
    robots = np.flatnonzero(level.present)
    boxes = level.obstacle[level.obstacle_present].astype(np.float64)
    inside = 0.5 * float(level.side) - hull_radius
    for robot, path in moves:
        points = _between(path)
        others = place[robots[robots != robot]]
        apart = np.linalg.norm(points[:, None] - others[None], axis=-1)
        if np.abs(path[0] - place[robot]).max() > 0.0:
            return f"robot {robot} jumps"
        if np.abs(points).max() > inside:
            return f"robot {robot} collides with a wall of the arena"
        if any((_box_distance(points, box) < hull_radius).any() for box in boxes):
            return f"robot {robot} collides with a wall"
        if apart.size and apart.min() < 2.0 * hull_radius:
            return f"robot {robot} collides with another robot"
        place[robot] = path[-1]
    late = np.linalg.norm(place - level.target, axis=-1) > target_radius
    return (
        f"robot {int(np.argmax(late & level.present))} is late"
        if (late & level.present).any()
        else None
    )


def _between(path: np.ndarray) -> np.ndarray:
    """Returns points [P, 2] along a path, at most 2 mm apart."""
    parts = [path[:1]]
    for first, last in itertools.pairwise(path):
        count = max(1, math.ceil(float(np.linalg.norm(last - first)) / 0.002))
        share = np.arange(1, count + 1)[:, None] / count
        parts.append(first + share * (last - first))
    return np.concatenate(parts)
