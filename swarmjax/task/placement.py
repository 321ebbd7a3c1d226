"""Places objects one after the other on the points of a lattice, in integers.

With integer arithmetic, NumPy and JAX choose the same point from the same uniform number. The unit
is 1/4096 m, a power of two, so lengths convert to metres exactly. It is large enough that squared
distances within the largest arena fit an int32.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

Array = Any

UNITS = 4096  # per metre; (4 m * sqrt(2) * 4096)**2 = 5.4e8 < 2**30
LATTICE = 24  # points along a side
MARGIN = 0.02  # m; least free space around anything at the start
TARGET_SPACING = 0.25  # m; least distance between targets where the arena has room
_UNROLLED = 5  # number of objects placed without a loop; XLA would take a second to compile twenty
FORBIDDEN = -(2**30)  # a score at or below half of this means that a hard distance is violated


class Gap(NamedTuple):
    """Least distance between two centres, in units.

    Attributes:
      hard: distance that is always kept if any point allows it.
      soft: distance that is kept where the arena has room.
    """

    hard: Array
    soft: Array


class Gaps(NamedTuple):
    """Least distances between targets, from starts to targets, and between starts."""

    target: Gap
    from_target: Gap
    start: Gap


def gaps_of(hull: float, reach: float) -> Gaps:
    """Computes the least distances between starts and targets.

    Args:
      hull: radius of a robot, m.
      reach: radius of the arrival zone, m.

    Returns:
      Distances in units.
    """
    # A third robot must fit between two robots parked on the near sides of their targets.
    through = max(TARGET_SPACING, 2.0 * reach + 4.0 * hull)
    return Gaps(
        target=Gap(round_up(2.0 * hull + 2.0 * MARGIN), round_up(through)),
        # Hard: no robot starts within its arrival zone. Soft: no robot starts where another may
        # park.
        from_target=Gap(round_up(reach + MARGIN), round_up(reach + 2.0 * hull + MARGIN)),
        start=Gap(round_up(2.0 * hull + MARGIN), round_up(2.0 * hull + 2.0 * MARGIN)),
    )


def clearance(hull: float) -> int:
    """Returns the least distance between a robot's centre and a wall at the start, units."""
    return round_up(hull + MARGIN)


def round_up(metres: float) -> int:
    """Rounds a length up to units, so that no distance falls below the requested one."""
    return math.ceil(metres * UNITS)


def units(metres: Array, xp: Any) -> Array:
    """Rounds metres to units (int32)."""
    return xp.round(metres * UNITS).astype(xp.int32)


def metres(units: Array, xp: Any) -> Array:
    """Converts units to metres (float32)."""
    return units.astype(xp.float32) / UNITS


def poses(place: Array, heading: Array, xp: Any) -> Array:
    """Returns poses [R, 3] (m, rad) at places [R, 2] (units); `heading` is [R] in [0, 1)."""
    yaw = (heading * 2.0 - 1.0) * np.float32(math.pi)
    return xp.concatenate([metres(place, xp), yaw[:, None]], axis=-1)


def split(uniforms: Array, counts: Sequence[int]) -> list[Array]:
    """Splits uniform numbers into parts of the given lengths."""
    ends = np.cumsum(counts)
    return [uniforms[end - count : end] for end, count in zip(ends, counts, strict=True)]


def lattice(shift: Array, side: Array, xp: Any) -> Array:
    """Returns points that cover a square around the origin, shifted by a part of their spacing.

    Args:
      shift: [2] shift in [0, 1), as a share of the spacing.
      side: [] side of the square, units.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [LATTICE**2, 2] int32, units.
    """
    offset = xp.floor(shift * side.astype(xp.float32)).astype(xp.int32)
    steps = xp.arange(LATTICE, dtype=xp.int32)[:, None] * side
    axes = (steps + offset) // LATTICE - side // 2
    x = xp.broadcast_to(axes[:, None, 0], (LATTICE, LATTICE))
    y = xp.broadcast_to(axes[None, :, 1], (LATTICE, LATTICE))
    return xp.stack([x.reshape(-1), y.reshape(-1)], axis=-1)


def score_walls(points: Array, side: Array, gap: Array, xp: Any) -> Array:
    """Scores points by their distance to the walls, which is a hard limit.

    Args:
      points: [P, 2] units.
      side: [] side of the arena, units.
      gap: [] least distance to a wall, units.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [P] 0 where the distance is kept, very low where it is not.
    """
    spare = side // 2 - xp.max(xp.abs(points), axis=-1) - gap
    return xp.where(spare >= 0, 0, FORBIDDEN + spare)


def score_things(points: Array, centres: Array, there: Array, gap: Gap, xp: Any) -> Array:
    """Scores points by their distances to objects already placed.

    Args:
      points: [P, 2] units.
      centres: [N, 2] centres of the objects, units.
      there: [N] whether the object is present.
      gap: distances to keep.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [P] 0 where all soft distances are kept, below 0 where a soft distance is violated, and very
      low where a hard distance is violated. Worse violations score lower.
    """
    apart = points[:, None, :] - centres[None, :, :]
    square = xp.sum(apart * apart, axis=-1)
    lacking = xp.minimum(square - gap.soft * gap.soft, 0)
    worst = xp.where(square < gap.hard * gap.hard, FORBIDDEN + square, lacking)
    return xp.min(xp.where(there, worst, 0), axis=-1, initial=0)


def score_open(points: Array, is_open: Array, xp: Any) -> Array:
    """Scores points by whether they are open for placement.

    Args:
      points: [P, 2] units.
      is_open: [P] bool.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [P] 0 where a point is open, else very low.
    """
    return xp.where(is_open, 0, FORBIDDEN + 0 * points[:, 0])


def score_rectangles(points: Array, rectangle: Array, there: Array, gap: int, xp: Any) -> Array:
    """Scores points by their distances to axis-aligned rectangles, which are hard limits.

    Args:
      points: [P, 2] units.
      rectangle: [W, 4] x, y, half edges, units.
      there: [W] whether the rectangle is present.
      gap: least distance, units.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [P] 0 where all distances are kept, very low where any distance is violated.
    """
    apart = xp.abs(points[:, None, :] - rectangle[None, :, :2]) - rectangle[None, :, 2:]
    apart = xp.maximum(apart, 0)
    square = xp.sum(apart * apart, axis=-1)
    score = xp.where(square < gap * gap, FORBIDDEN + square, 0)
    return xp.min(xp.where(there, score, 0), axis=-1, initial=0)


def place(
    points: Array, score: Array, picks: Array, there: Array, gap: Gap, xp: Any
) -> tuple[Array, Array]:
    """Places objects of one kind one after the other.

    Args:
      points: [P, 2] candidates, units.
      score: [P] scores of the candidates against everything else.
      picks: [N] uniform numbers in [0, 1).
      there: [N] whether to place the object; only placed objects keep others away.
      gap: least distances among these objects.
      xp: `numpy` or `jax.numpy`.

    Returns:
      Centres [N, 2] (units), and [N] whether the object is placed and keeps all hard distances.
    """

    def step(score: Array, one: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        pick, is_there = one
        best = choose(score, pick, xp)
        kept = is_there & (score[best] > FORBIDDEN // 2)
        against = score_things(points, points[best][None], is_there[None], gap, xp)
        return xp.minimum(score, against), (points[best], kept)

    return fold(step, score, (picks, there), xp)


def fold(
    step: Callable, state: Array, rows: tuple[Array, Array], xp: Any, unroll: int = _UNROLLED
) -> tuple[Array, Array]:
    """Calls `step` for each row, passes its state on to the next call, and stacks the results."""
    if xp is not np:
        from jax import lax  # evaluations draw levels without JAX

        # The score is a constant if all points are free. Without the barrier, XLA evaluates the
        # search at compile time, arena by arena. For 4,096 arenas of a trap, this took 105 s on two
        # cores.
        state = lax.optimization_barrier(state)
        return lax.scan(step, state, rows, unroll=max(1, min(unroll, len(rows[0]))))[1]
    first, second = [], []
    for one in zip(*rows, strict=True):
        state, found = step(state, one)
        first.append(found[0])
        second.append(found[1])
    return np.array(first, np.int32).reshape(-1, 2), np.array(second, bool)


def repeat[S](count: int, step: Callable[[Array, S], S], state: S, xp: Any) -> S:
    """Calls `step(i, state)` for each i below `count`, not unrolled, so that XLA compiles fast."""
    if xp is not np and count:  # JAX would trace the step even if `count` is 0
        from jax import lax  # evaluations draw levels without JAX

        return lax.fori_loop(0, count, step, state)
    for i in range(count):
        state = step(i, state)
    return state


def choose(score: Array, pick: Array, xp: Any) -> Array:
    """Picks uniformly among the points that score 0; if there are none, picks the highest score."""
    rank = xp.cumsum((score >= 0).astype(xp.int32))
    free = rank[-1]
    wanted = xp.floor(pick * free.astype(xp.float32)).astype(xp.int32)
    wanted = xp.minimum(wanted, free - 1)
    return xp.where(free > 0, xp.argmax(rank > wanted), xp.argmax(score))
