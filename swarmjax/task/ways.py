"""Places starts from which the shortest paths around walls to the targets have a given length.

For many points of the arena, a visibility graph (Lozano-Pérez & Wesley 1979, "An Algorithm for
Planning Collision-Free Paths Among Polyhedral Obstacles") gives the shortest path to the target. A
point whose path is too long moves along the path's first straight leg, until the rest has the given
length. All lengths are integers, so NumPy and JAX choose the same starts.

Walls are widened as in `geodesic.py`. Paths turn only at corners of walls. Among turned boxes,
a start therefore sees its target past the squares around the boxes, and its path is straight.

Axes: R robots, M obstacles, K = 4 M corners, P points. Lengths are units of 1/4096 m.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from swarmjax.sim import noise
from swarmjax.sim.noise import Stream
from swarmjax.task.layouts.site import pick
from swarmjax.task.placement import (
    FORBIDDEN,
    UNITS,
    choose,
    clearance,
    fold,
    gaps_of,
    repeat,
    round_up,
    score_rectangles,
    score_things,
    score_walls,
    units,
)

Array = Any

# Shares of the hull's radius, as in `geodesic.py`: walls are widened by the first, and corners are
# set off by the second.
_WIDENED, _CORNER = 0.8, 0.9
_NO_WAY = 2**29  # length of a path that does not exist; an int32 holds the sum of two
_SQUARE = np.float32(1.41422)  # half edge of the square around a turned square of half edge 1
_OTHER = 2**27  # subtracted from scores of starts with other path lengths; soft scores are less
_POINTS = 576
_LARGE = 2**15  # legs of a table that is made in blocks
_TIGHT = 4e-3  # m; least free space beside walls where there is no room for more
# Multiples of these shares of 2**32 fill a square evenly, and no two points have the same x or y,
# so that some lie in every narrow corridor (Roberts 2018, "The Unreasonable Effectiveness of
# Quasirandom Sequences": 1 / g and 1 / g**2 with g**3 = g + 1).
_STEPS = np.array([3242174889, 2447445414], np.uint32)
_SIGNS = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)], np.int32)


class Plan(NamedTuple):
    """The straight legs of a level between points, corners and targets.

    Attributes:
      points: [P, 2] points all over the arena.
      corner: [K, 2] corners of the widened walls.
      target: [R, 2].
      to_corner: [P, K] lengths of legs from points to corners; `_NO_WAY` if blocked, also below.
      to_target: [P, R] lengths of legs from points to targets.
      to_go: [R, K] path lengths from the corners to the targets.
    """

    points: Array
    corner: Array
    target: Array
    to_corner: Array
    to_target: Array
    to_go: Array


def starts(
    level: Any, distance: Array, hull: float, reach: float, xp: Any
) -> tuple[Array, Array, Array]:
    """Chooses starts from which the paths to the targets have a given length.

    Starts keep the distances of `gaps_of` from each other and from the targets of other robots. If
    a robot finds no such start, it gets one with another path length, or else one without room.

    Args:
      level: the level as drawn, a `level.Level`.
      distance: [2] shortest and longest path, units. All robots of a level get the same length.
      hull: radius of the robots, m.
      reach: radius of the arrival zone, m.
      xp: `numpy` or `jax.numpy`; both choose the same starts.

    Returns:
      [R, 2] x and y of the starts, units; [R] whether their paths have the drawn length; and []
      whether all starts keep the least distances to everything else.
    """
    side, rectangle = units(level.side, xp), _rectangles(level, xp)
    number = xp.arange(len(level.target))
    drawn = noise.uniform(level.seed, 0, Stream.WAY, (3 + len(number),), xp)
    way = pick(drawn[0], distance[0], distance[1], xp)
    plan = _plan(level, _points(drawn[1:3], side, xp), rectangle, hull, xp)
    gaps = gaps_of(hull, reach)

    def beside_walls(candidates: Array, clear: int) -> Array:
        within = score_walls(candidates, side, clear, xp)
        beside = score_rectangles(candidates, rectangle, level.obstacle_present, clear, xp)
        return xp.minimum(within, beside)

    def step(placed: Array, row: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        robot, there = row
        candidates, has_way, exists = _candidates(plan, robot, way, gaps.from_target.hard, xp)
        others = level.present & (number != robot)
        score = [
            xp.where(exists, 0, FORBIDDEN),
            beside_walls(candidates, round_up(hull + _TIGHT)),
            xp.maximum(beside_walls(candidates, clearance(hull)), -1),
            score_things(candidates, plan.target, others, gaps.from_target, xp),
            score_things(candidates, placed[:, :2], placed[:, 2] > 0, gaps.start, xp),
        ]
        score = xp.min(xp.stack(score), axis=0) - xp.where(has_way, 0, _OTHER)
        best = choose(score, drawn[3 + robot], xp)
        mine = (number == robot) & there
        start = xp.concatenate([candidates[best], xp.ones(1, xp.int32)])
        placed = xp.where(mine[:, None], start, placed)
        reached = xp.stack([score[best] > -_OTHER, score[best] > FORBIDDEN // 2])
        return placed, (candidates[best], reached)

    none_placed = xp.zeros((len(number), 3), xp.int32)
    place, reached = fold(step, none_placed, (number, level.present), xp, unroll=1)
    has_way, has_room = reached[:, 0], reached[:, 1]
    return place, has_way, xp.all(has_room | ~level.present)


def _points(shift: Array, side: Array, xp: Any) -> Array:
    """Spreads points [P, 2] over a square, shifted by two uniform numbers; units."""
    first = (shift * np.float32(2**24)).astype(xp.uint32) << 8
    share = first + np.arange(_POINTS, dtype=np.uint32)[:, None] * _STEPS
    return ((share >> 17).astype(xp.int32) * side >> 15) - side // 2


def _candidates(
    plan: Plan, robot: Array, way: Array, least: int, xp: Any
) -> tuple[Array, Array, Array]:
    """Lists possible starts of a robot: points moved along their paths, and the points themselves.

    Returns:
      The starts [2 P, 2], whether their paths have the length `way`, and whether they have any
      path of at least the length `least`.
    """
    place = xp.concatenate([plan.target[robot][None], plan.corner])
    legs = xp.concatenate([plan.to_target[:, robot][:, None], plan.to_corner], axis=1)
    to_go = xp.concatenate([xp.zeros(1, xp.int32), plan.to_go[robot]])
    first = xp.argmin(legs + to_go, axis=-1)
    leg = xp.take_along_axis(legs, first[:, None], axis=1)[:, 0]
    length = leg + to_go[first]
    excess = xp.clip(length - way, 0, leg)
    away = place[first] - plan.points
    moved = (
        plan.points + (away * excess[:, None] + leg[:, None] // 2) // xp.maximum(leg, 1)[:, None]
    )
    has_way = (length < _NO_WAY) & (length - excess == way)
    return (
        xp.concatenate([moved, plan.points]),
        xp.concatenate([has_way, xp.zeros_like(has_way)]),
        xp.concatenate([has_way, (length < _NO_WAY) & (length >= least)]),
    )


def _rectangles(level: Any, xp: Any) -> Array:
    """Returns obstacles [M, 4] as axis-aligned rectangles: the squares around turned boxes."""
    half = level.obstacle[:, 3:]
    half = xp.where(level.obstacle[:, 2:3] != 0.0, half * _SQUARE, half)
    return units(xp.concatenate([level.obstacle[:, :2], half], axis=-1), xp)


def _plan(level: Any, points: Array, rectangle: Array, hull: float, xp: Any) -> Plan:
    """Measures all legs, and the shortest paths from the corners."""
    there, target = level.obstacle_present, units(level.target, xp)
    off, widened = round(_CORNER * hull * UNITS), round(_WIDENED * hull * UNITS)
    corner = rectangle[:, None, :2] + _SIGNS * (rectangle[:, None, 2:] + off)
    corner = corner.reshape(-1, 2)
    usable = xp.repeat(there & (level.obstacle[:, 2] == 0.0), len(_SIGNS))
    usable &= xp.max(xp.abs(corner), axis=-1) <= units(level.side, xp) // 2 - widened

    def legs(begin: Array, end: Array) -> Array:
        return _legs(begin, end, rectangle, there, widened, xp)

    between = xp.where(usable[:, None] & usable, legs(corner, corner), _NO_WAY)
    direct = xp.where(usable, legs(target, corner), _NO_WAY)
    return Plan(
        points=points,
        corner=corner,
        target=target,
        to_corner=legs(points, corner),
        to_target=legs(points, target),
        to_go=_settle(direct, between, xp),
    )


def _settle(to_go: Array, between: Array, xp: Any) -> Array:
    """Shortens paths [R, K] by legs between corners [K, K] until no path gets shorter."""

    def shorten(to_go: Array) -> Array:
        # One Bellman-Ford step allows paths with one more corner.
        further = xp.min(between + to_go[:, None, :], axis=-1, initial=_NO_WAY)
        return xp.minimum(to_go, further)

    def step(state: tuple[Array, Array]) -> tuple[Array, Array]:
        shorter = shorten(state[0])
        return shorter, xp.any(shorter < state[0])

    state = (to_go, xp.asarray(True))
    if xp is not np:
        from jax import lax  # evaluations draw levels without JAX

        return lax.while_loop(lambda state: state[1], step, state)[0]
    while state[1]:
        state = step(state)
    return state[0]


def _legs(begin: Array, end: Array, rectangle: Array, there: Array, widened: int, xp: Any) -> Array:
    """Measures straight legs [B, E] from points to others; `_NO_WAY` where a wall blocks them.

    A large table is made in blocks of rows. With whole tables, 20,480 arenas with mazes of 6 x 6
    cells took 233 GiB of a GPU's memory.
    """

    def measure(rows: Array) -> Array:
        return _block(rows, end, rectangle, there, widened, xp)

    blocks = math.gcd(len(begin), 16)
    if xp is np or len(begin) * len(end) < _LARGE:
        return measure(begin)
    from jax import lax  # evaluations draw levels without JAX

    return lax.map(measure, begin.reshape(blocks, -1, 2)).reshape(len(begin), len(end))


def _block(
    begin: Array, end: Array, rectangle: Array, there: Array, widened: int, xp: Any
) -> Array:
    """Measures the legs of some points, as in `_legs`.

    The test uses separating axes (Ericson 2005, "Real-Time Collision Detection", section 5.3.3).
    """
    # `middle` is twice the middle of the leg. In an arena of 4 m, twice the middle is at most 2**15
    # from a wall's, and the leg at most 2**14 long, so an int32 holds the sum of two products.
    middle, across = begin[:, None] + end[None], end[None] - begin[:, None]
    centre, half = 2 * rectangle[:, :2], 2 * (rectangle[:, 2:] + widened)

    def is_barred(i: Array, barred: Array) -> Array:
        x, y = middle[..., 0] - centre[i, 0], middle[..., 1] - centre[i, 1]
        along_x, along_y = xp.abs(across[..., 0]), xp.abs(across[..., 1])
        turned = xp.abs(x * across[..., 1] - y * across[..., 0])
        meets = (xp.abs(x) < half[i, 0] + along_x) & (xp.abs(y) < half[i, 1] + along_y)
        meets &= turned < half[i, 0] * along_y + half[i, 1] * along_x
        return barred | (meets & there[i])

    barred = repeat(len(rectangle), is_barred, xp.zeros((len(begin), len(end)), bool), xp)
    # Squares of distances to parking places may overflow; no path leads there.
    square = xp.maximum(xp.sum(across * across, axis=-1, dtype=xp.int32), 0)
    return xp.where(barred, _NO_WAY, _root(square, xp))


def _root(square: Array, xp: Any) -> Array:
    """Returns the integer part of the square root, and corrects the rounding error of `sqrt`."""
    root = xp.floor(xp.sqrt(square.astype(xp.float32))).astype(xp.int32)
    root = root - (root * root > square)
    return root + ((root + 1) * (root + 1) <= square)
