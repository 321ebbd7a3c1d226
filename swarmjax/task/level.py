"""Levels: the starting conditions of an episode, drawn from uniform random numbers.

The code takes the array module as an argument. NumPy and JAX draw the same level from the same
numbers.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from swarmjax.sim import noise
from swarmjax.sim.noise import Stream
from swarmjax.task import fixed_level, ways
from swarmjax.task.layouts import drawing
from swarmjax.task.layouts.drawing import Kind, LayoutArrays
from swarmjax.task.maps import MapArrays
from swarmjax.task.placement import (
    UNITS,
    Gap,
    clearance,
    gaps_of,
    lattice,
    metres,
    place,
    poses,
    round_up,
    score_open,
    score_rectangles,
    score_things,
    score_walls,
    split,
    units,
)
from swarmjax.task.stage import Stage
from swarmjax.task.stage_config import passage

Array = Any

PARKING = 30.0  # m; parking place of absent robots and obstacles, outside the walls of any arena
PARKING_SPACING = 0.5  # m


class Level(NamedTuple):
    """Starting conditions of an episode.

    Attributes:
      side: [] side of the arena, m.
      present: [R] whether the robot is present.
      start: [R, 3] x (m), y (m), yaw (rad).
      target: [R, 2] x (m), y (m).
      obstacle_present: [M] whether the obstacle is present.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      seed: [] uint32; all other randomness of the episode follows from it.
    """

    side: Array
    present: Array
    start: Array
    target: Array
    obstacle_present: Array
    obstacle: Array
    seed: Array


class Spacing(NamedTuple):
    """Sizes for drawing levels, fixed for a program.

    Attributes:
      robots: largest number of robots, R.
      obstacles: largest number of obstacles, M.
      hull_radius: m.
      target_radius: distance at which a robot has arrived, m.
    """

    robots: int
    obstacles: int
    hull_radius: float
    target_radius: float


class _Uniforms(NamedTuple):
    """The uniform numbers, grouped by use, in arrays [2], [M] or [R]; the seed takes two."""

    obstacle_shift: Array
    target_shift: Array
    start_shift: Array
    obstacle: Array
    obstacle_yaw: Array
    target: Array
    start: Array
    heading: Array
    seed: Array


def uniform_count(spacing: Spacing) -> int:
    """Returns how many uniform numbers a level is drawn from."""
    return 8 + 2 * spacing.obstacles + 3 * spacing.robots


def sample(uniforms: Array, stage: Stage, spacing: Spacing, xp: Any) -> Level:
    """Draws a level of a stage.

    A random level places obstacles, then targets, then starts, without overlap. Obstacles leave a
    `passage` between each other and to the walls. An obstacle without such a place is left out.
    Where the arena has room, targets keep their distance from each other and from obstacles, so
    that a robot can pass between any two arrived robots. Every target then stays reachable,
    in any order of arrival.

    Args:
      uniforms: [uniform_count(spacing)] float32 in [0, 1).
      stage: fields [].
      spacing: sizes.
      xp: `numpy` or `jax.numpy`; both draw the same level.

    Returns:
      The level; absent robots and obstacles are parked outside.
    """
    drawn = _split(uniforms, spacing)
    level = _fixed(drawn, stage, spacing, xp)
    if stage.laid_out is None:  # skip the slow random placement if a layout replaces it
        level = _either(stage.fixed, level, _random(drawn, stage, spacing, xp), xp)
    if stage.map is not None:
        mapped = _mapped(drawn, stage, stage.map, spacing, xp)
        level = _either(stage.map.mapped, mapped, level, xp)
    for kind, arrays in (stage.layouts or {}).items():
        laid_out = _laid_out(kind, arrays, level.seed, stage, spacing, xp)
        level = _either(arrays.chosen, laid_out, level, xp)
    if stage.distance is not None:
        level = _at_distance(level, stage.distance, spacing, xp)
    return park(level, xp)


def _either(is_first: Array, first: Level, second: Level, xp: Any) -> Level:
    """Returns the first of two levels where `is_first` holds, else the second."""
    return Level(*(xp.where(is_first, a, b) for a, b in zip(first, second, strict=True)))


def _split(uniforms: Array, spacing: Spacing) -> _Uniforms:
    """Splits the uniform numbers by use."""
    many, few = spacing.obstacles, spacing.robots
    return _Uniforms(*split(uniforms, [2, 2, 2, many, many, few, few, few, 2]))


def _random(drawn: _Uniforms, stage: Stage, spacing: Spacing, xp: Any) -> Level:
    """Places obstacles, then targets, then starts at random."""
    seed = _seed(drawn, xp)
    length = _side(stage, seed, xp)
    side = units(length, xp)
    present = xp.arange(spacing.robots) < stage.robots
    centre, there, radius = _place_obstacles(drawn, stage, side, spacing, xp)
    hull, reach = spacing.hull_radius, spacing.target_radius
    apart, from_target, start_apart = gaps_of(hull, reach)
    clear = clearance(hull)

    def score(points: Array, beside: Gap) -> Array:
        obstacles = score_things(points, centre, there, beside, xp)
        return xp.minimum(score_walls(points, side, clear, xp), obstacles)

    points = lattice(drawn.target_shift, side, xp)
    # One robot parks on this side of its target while another one passes behind it.
    behind = radius + round_up(reach + 3.0 * hull)
    free = score(points, Gap(radius + clear, behind))
    target, _ = place(points, free, drawn.target, present, apart, xp)
    points = lattice(drawn.start_shift, side, xp)
    # No robot starts where another one may be parked.
    unparked = score_things(points, target, present, from_target, xp)
    free = xp.minimum(score(points, Gap(radius + clear, radius + clear)), unparked)
    start, _ = place(points, free, drawn.start, present, start_apart, xp)
    turn = drawn.obstacle_yaw * np.float32(0.5 * math.pi)
    half = 0.5 * stage.obstacle_size * xp.ones_like(turn)
    shape = xp.stack([turn, half, half], axis=-1)
    return Level(
        side=length,
        present=present,
        start=poses(start, drawn.heading, xp),
        target=metres(target, xp),
        obstacle_present=there,
        obstacle=xp.concatenate([metres(centre, xp), shape], axis=-1),
        seed=seed,
    )


def _seed(drawn: _Uniforms, xp: Any) -> Array:
    """Makes 32 random bits from two uniform numbers; each float32 provides 16 of them."""
    high, low = (drawn.seed * np.float32(2**16)).astype(xp.uint32)
    return (high << 16) | low


def _side(stage: Stage, seed: Array, xp: Any) -> Array:
    """Draws the side of the arena, m, in whole units, if the stage gives a range.

    The side is drawn from a hash of the level's seed, so it changes no other random number.
    """
    low = xp.ceil(stage.side * UNITS).astype(xp.int32)
    count = xp.floor(stage.largest_side * UNITS).astype(xp.int32) - low + 1
    uniform = noise.uniform(seed, 0, Stream.ARENA_SIDE, (), xp)
    above = xp.floor(uniform * count.astype(xp.float32)).astype(xp.int32)
    return xp.where(count > 1, metres(low + above, xp), stage.side)


def _place_obstacles(
    drawn: _Uniforms, stage: Stage, side: Array, spacing: Spacing, xp: Any
) -> tuple[Array, Array, Array]:
    """Places randomly turned boxes, with a passage between all of their outer circles.

    Returns:
      Centres [M, 2] (units), presence [M], and the outer radius [] (units).
    """
    radius = units(stage.obstacle_size * np.float32(math.sqrt(0.5)), xp) + 1
    free = round_up(passage(spacing.hull_radius))
    gap = 2 * radius + free
    points = lattice(drawn.obstacle_shift, side, xp)
    score = score_walls(points, side, radius + free, xp)
    there = xp.arange(drawn.obstacle.shape[0]) < stage.obstacles
    centre, there = place(points, score, drawn.obstacle, there, Gap(gap, gap), xp)
    return centre, there, radius


def _fixed(drawn: _Uniforms, stage: Stage, spacing: Spacing, xp: Any) -> Level:
    """Returns the paper's level, scaled with the arena; only its seed is random."""
    count = xp.where(stage.fence, xp.minimum(stage.obstacles, 1), stage.obstacles)
    return Level(
        side=stage.side,
        present=xp.arange(spacing.robots) < stage.robots,
        start=fixed_level.starts(spacing.robots, stage.side, xp),
        target=fixed_level.targets(spacing.robots, stage.side, xp),
        obstacle_present=xp.arange(spacing.obstacles) < count,
        obstacle=fixed_level.obstacles(spacing.obstacles, stage.side, stage.fence, xp),
        seed=_seed(drawn, xp),
    )


def _mapped(drawn: _Uniforms, stage: Stage, arena: MapArrays, spacing: Spacing, xp: Any) -> Level:
    """Draws targets and starts in the areas of a map; robots with letters come first."""
    present = xp.arange(spacing.robots) < stage.robots
    paired = present & (xp.arange(spacing.robots) < arena.pairs)
    pair = _rows(arena.pair, spacing.robots, xp)
    apart, from_target, start_apart = gaps_of(spacing.hull_radius, spacing.target_radius)
    clear, side = clearance(spacing.hull_radius), units(stage.side, xp)
    walls = units(arena.wall[:, np.array([0, 1, 3, 4])], xp)
    walled = xp.arange(arena.wall.shape[0]) < stage.obstacles

    def score(points: Array, is_open: Array) -> Array:
        beside = score_rectangles(points, walls, walled, clear, xp)
        within = score_walls(points, side, clear, xp)
        return xp.minimum(score_open(points, is_open, xp), xp.minimum(beside, within))

    def place_others(points: Array, score: Array, fixed: Array, gap: Gap, picks: Array) -> Array:
        score = xp.minimum(score, score_things(points, fixed, paired, gap, xp))
        placed, _ = place(points, score, picks, present & ~paired, gap, xp)
        return xp.where(paired[:, None], fixed, placed)

    free = score(arena.target, arena.target_open)
    target = place_others(arena.target, free, pair[:, 1], apart, drawn.target)
    unparked = score_things(arena.start, target, present, from_target, xp)
    free = xp.minimum(score(arena.start, arena.start_open), unparked)
    start = place_others(arena.start, free, pair[:, 0], start_apart, drawn.start)
    wall = _rows(arena.wall, spacing.obstacles, xp)
    there = xp.arange(spacing.obstacles) < stage.obstacles
    return Level(
        side=stage.side,
        present=present,
        start=poses(start, drawn.heading, xp),
        target=metres(target, xp),
        obstacle_present=there,
        obstacle=xp.where(there[:, None], wall, np.float32(0.5) * stage.obstacle_size),
        seed=_seed(drawn, xp),
    )


def _laid_out(
    kind: Kind, of: LayoutArrays, seed: Array, stage: Stage, spacing: Spacing, xp: Any
) -> Level:
    """Draws a level of a layout. Robots and walls that the layout does not have are absent."""
    present = xp.arange(spacing.robots) < stage.robots
    count = drawing.uniform_count(kind, spacing.robots)
    uniforms = noise.uniform(seed, 0, Stream.LAYOUT, (count,), xp)
    if xp is not np:
        from jax import lax  # evaluations draw levels without JAX

        # Without the barrier, XLA repeats the hash at each use of a number. The layout of 20 robots
        # on plots then takes 18 s to compile instead of 1 s.
        uniforms = lax.optimization_barrier(uniforms)
    hull, reach = spacing.hull_radius, spacing.target_radius
    side, drawn = drawing.draw(kind, of, uniforms, present, hull, reach, xp)
    absent = xp.stack([xp.zeros_like(stage.obstacle_size)] * 3 + [0.5 * stage.obstacle_size] * 2)
    mine = np.arange(spacing.obstacles)[:, None] < len(drawn.wall)
    return Level(
        side=side,
        present=present,
        start=drawn.start,
        target=drawn.target,
        obstacle_present=_rows(drawn.there, spacing.obstacles, xp),
        obstacle=xp.where(mine, _rows(drawn.wall, spacing.obstacles, xp), absent),
        seed=seed,
    )


def _at_distance(level: Level, distance: Array, spacing: Spacing, xp: Any) -> Level:
    """Moves the starts so that paths to targets have the length that the stage gives, if any.

    If such starts have no room for all robots, the level keeps its own starts.
    """
    sizes = spacing.hull_radius, spacing.target_radius
    place, _, has_room = ways.starts(level, distance, *sizes, xp)
    start = xp.concatenate([metres(place, xp), level.start[:, 2:]], axis=-1)
    return level._replace(start=xp.where((distance[1] > 0) & has_room, start, level.start))


def _rows(array: Array, count: int, xp: Any) -> Array:
    """Cuts an array to `count` rows, or appends rows of zeros."""
    lacking = max(0, count - array.shape[0])
    zeros = xp.zeros((lacking, *array.shape[1:]), array.dtype)
    return xp.concatenate([array[:count], zeros])


def park(level: Level, xp: Any) -> Level:
    """Moves absent robots and obstacles outside, each to its own parking place.

    Args:
      level: level of one arena; the places of absent robots and obstacles are ignored.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The level. Absent robots get heading 0. Obstacles keep their edges and angles.
    """
    robots, obstacles = level.present.shape[0], level.obstacle_present.shape[0]
    line = PARKING + PARKING_SPACING * np.arange(max(robots, obstacles), dtype=np.float32)
    away = np.stack([line, line * 0 + PARKING], axis=-1)
    robot = np.concatenate([away, 0 * away[:, :1]], axis=-1)[:robots]
    box = -away[:obstacles]
    present = level.present[:, None]
    place = xp.where(level.obstacle_present[:, None], level.obstacle[:, :2], box)
    return level._replace(
        start=xp.where(present, level.start, robot),
        target=xp.where(present, level.target, robot[:, :2]),
        obstacle=xp.concatenate([place, level.obstacle[:, 2:]], axis=-1),
    )
