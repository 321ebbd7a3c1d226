"""Distance to the target along the shortest path around walls and boxes.

A visibility graph (Lozano-Pérez & Wesley 1979, "An Algorithm for Planning Collision-Free Paths
Among Polyhedral Obstacles") is solved once per episode for every target. A
robot's path is then the straight line, if it is free, or the shortest path through a corner that
the robot can see. Navigation rewards count progress along this path (Wijmans et al. 2020,
"DD-PPO", section 4).

Other robots are ignored. Obstacles are widened by a little less than a robot's radius, with square
corners, so a robot that touches one is still outside the wider shape. Paths are therefore between a
millimetre too short and three centimetres too long. A gap of 59 to 74 mm counts as passable, but no
robot fits through. Neither error matters to the reward, which only needs the right way around the
obstacles, and a length that shrinks along that way.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from swarmjax.task.level import PARKING, Level
from swarmjax.task.surroundings import into_frame

# Shares of the hull's radius. Obstacles are widened by the first share, and corners are set off by
# the second. Contacts are soft, so a robot pushed against a wall can come closer to it than its
# radius.
_WIDENED = 0.8
_CORNER = 0.9
# m; path lengths that differ by less count as equal. They are float32 sums below 10 m.
_SAME = 1e-4
_SIGNS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))


class Roadmap(NamedTuple):
    """Corners at which paths can turn, and the distances from these corners to the targets.

    Attributes:
      corner: [K, 2] x and y of the corners of the widened obstacles, m.
      to_go: [R, K] distance from each corner to each robot's target, m; inf without a path.
    """

    corner: Array
    to_go: Array


class Path(NamedTuple):
    """Path state of an arena.

    Attributes:
      roadmap: roadmap of the episode.
      distance: [R] distance along the shortest path to the target, m.
    """

    roadmap: Roadmap
    distance: Array


def begin(level: Level, hull_radius: float, fast: Any = None) -> Path:
    """Finds the paths of an episode.

    Args:
      level: the level that the episode starts from.
      hull_radius: radius of the robots, m.
      fast: path finder in Warp, `swarmjax.sim.fast.paths_warp`; None for plain JAX.

    Returns:
      The paths from the starts. A robot without a path gets its straight-line distance.
    """
    level = jax.tree.map(jnp.asarray, level)
    roadmap = survey(level, hull_radius, fast)
    start = level.start[:, :2]
    straight = jnp.hypot(*(level.target - start).T)
    return Path(roadmap, _measured(roadmap, start, level, hull_radius, fast, straight))


def go_on(path: Path, place: Array, level: Level, hull_radius: float, fast: Any = None) -> Path:
    """Measures the paths from the robots' current places.

    Args:
      path: path state of the previous control step.
      place: [R, 2] current places of the robots, m.
      level: level of the episode.
      hull_radius: radius of the robots, m.
      fast: path finder, as for `begin`.

    Returns:
      The new paths. A robot without a path keeps its previous distance.
    """
    distance = _measured(path.roadmap, place, level, hull_radius, fast, path.distance)
    return path._replace(distance=distance)


def waypoint(path: Path, place: Array, level: Level) -> Array:
    """Finds the first waypoint of each robot's shortest path: a corner or the target.

    Args:
      path: path state, measured from these places.
      place: [R, 2] current places of the robots, m.
      level: level of the episode.

    Returns:
      [R, 2] x and y, m. For a robot without a path, it is the target.
    """
    corner = jnp.broadcast_to(path.roadmap.corner, (len(place), *path.roadmap.corner.shape))
    choices = jnp.concatenate([level.target[:, None], corner], axis=1)
    to_go = jnp.pad(path.roadmap.to_go, ((0, 0), (1, 0)))
    length = jnp.linalg.norm(choices - place[:, None], axis=-1) + to_go
    # The waypoint is the choice whose path has the measured length, so lines of sight, which are
    # costly, are not checked again. A hidden corner has the same length only by chance.
    off = jnp.abs(length - path.distance[:, None])
    chosen = jnp.where(jnp.min(off, axis=1) < _SAME, jnp.argmin(off, axis=1), 0)
    return jnp.take_along_axis(choices, chosen[:, None, None], axis=1)[:, 0]


def _measured(
    roadmap: Roadmap, place: Array, level: Level, hull_radius: float, fast: Any, otherwise: Array
) -> Array:
    """Returns the distances [R], with values of `otherwise` for robots without a path."""
    distance = measure(roadmap, place, level, hull_radius, fast)
    return jnp.where(jnp.isfinite(distance), distance, otherwise)


def survey(level: Level, hull_radius: float, fast: Any = None) -> Roadmap:
    """Solves the visibility graph of a level for the robots' targets.

    Args:
      level: obstacles and targets.
      hull_radius: radius of the robots, m.
      fast: path finder, as for `begin`.

    Returns:
      The corners, four per obstacle, with the distances from them to the targets.
    """
    corner = jax.lax.optimization_barrier(_corners(level, _CORNER * hull_radius))
    if fast is not None and len(corner):
        widened, frame = _WIDENED * hull_radius, _frames(level)
        legs = fast.find_legs(corner, level.side, frame, widened)
        to_go = fast.settle(level.target, corner, frame, legs, widened)
        return Roadmap(corner, to_go)
    corners, targets = _locate(corner, level), _locate(level.target, level)
    usable = jnp.all(jnp.abs(corner) <= 0.5 * level.side - _WIDENED * hull_radius, axis=-1)
    usable &= ~_covers(corners, level, _WIDENED * hull_radius)
    usable = jax.lax.optimization_barrier(usable)
    legs = _legs(corners, corners, level, hull_radius)
    legs = jnp.where(usable[:, None] & usable[None, :], legs, jnp.inf)
    direct = jnp.where(usable, _legs(targets, corners, level, hull_radius), jnp.inf)

    def shorten(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        # One Bellman-Ford step allows paths with one more corner.
        to_go, _ = carry
        further = jnp.min(legs + to_go[:, None, :], axis=-1, initial=jnp.inf)
        shorter = jnp.minimum(to_go, further)
        return shorter, jnp.any(shorter < to_go)

    to_go, _ = jax.lax.while_loop(lambda carry: carry[1], shorten, (direct, jnp.array(True)))
    return Roadmap(corner, to_go)


def measure(
    roadmap: Roadmap, place: Array, level: Level, hull_radius: float, fast: Any = None
) -> Array:
    """Measures the shortest paths from places [R, 2] to the robots' targets.

    Args:
      roadmap: roadmap of the level.
      place: [R, 2] x and y, m.
      level: level of the episode.
      hull_radius: radius of the robots, m.
      fast: path finder, as for `begin`.

    Returns:
      [R] m; inf without a path.
    """
    if fast is not None and len(roadmap.corner):
        known = level.target, roadmap.corner, roadmap.to_go, _frames(level)
        return fast.measure(place, *known, _WIDENED * hull_radius)
    here, targets = _locate(place, level), _locate(level.target, level)
    barred = _is_barred(here, targets, level, _WIDENED * hull_radius)
    direct = jnp.where(barred, jnp.inf, jnp.hypot(*(level.target - place).T))
    around = _legs(here, _locate(roadmap.corner, level), level, hull_radius) + roadmap.to_go
    return jnp.minimum(direct, jnp.min(around, axis=-1, initial=jnp.inf))


class _Places(NamedTuple):
    """Places [P, 2] x and y (m), and their coordinates [M, P] in the frames of the obstacles."""

    place: Array
    x: Array
    y: Array


def _corners(level: Level, off: float) -> Array:
    """Lists the corners [4 M, 2] of obstacles widened by `off`, m."""
    x, y, yaw, half_x, half_y = (each[:, None] for each in level.obstacle.T)
    sign = jnp.asarray(_SIGNS)
    in_x, in_y = sign[:, 0] * (half_x + off), sign[:, 1] * (half_y + off)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    corner = jnp.stack([x + cos * in_x - sin * in_y, y + sin * in_x + cos * in_y], axis=-1)
    return corner.reshape(-1, 2)


def _frames(level: Level) -> Array:
    """Lists obstacles [M, 6]: x, y (m), cos and sin of yaw, half edges (m).

    Absent obstacles are far off.
    """
    x, y, yaw, half_x, half_y = level.obstacle.T
    x = jnp.where(level.obstacle_present, x, PARKING)
    return jnp.stack([x, y, jnp.cos(yaw), jnp.sin(yaw), half_x, half_y], axis=-1)


def _locate(place: Array, level: Level) -> _Places:
    """Turns places [P, 2] into coordinates in the frames of the obstacles."""
    local = into_frame(level.obstacle[:, None, :3], place)
    # Without the barrier, XLA inlines this computation into the code of every pair of places, and
    # compiling takes minutes on a GPU.
    return _Places(place, *jax.lax.optimization_barrier(local))


def _covers(places: _Places, level: Level, off: float) -> Array:
    """Returns which places [P] lie within an obstacle widened by `off`, m."""

    def within(i: Array) -> Array:
        half_x, half_y = level.obstacle[i, 3] + off, level.obstacle[i, 4] + off
        inside = (jnp.abs(places.x[i]) < half_x) & (jnp.abs(places.y[i]) < half_y)
        return inside & level.obstacle_present[i]

    return _any(within, places.x)


def _legs(begin: _Places, end: _Places, level: Level, hull_radius: float) -> Array:
    """Measures straight lines [B, E] from B places to E others, m; inf where one is blocked."""
    away_x, away_y = (end.place[None] - begin.place[:, None]).transpose(2, 0, 1)
    rows = _Places(begin.place, begin.x[:, :, None], begin.y[:, :, None])
    columns = _Places(end.place, end.x[:, None], end.y[:, None])
    barred = _is_barred(rows, columns, level, _WIDENED * hull_radius)
    legs = jnp.where(barred, jnp.inf, jnp.hypot(away_x, away_y))
    return jax.lax.optimization_barrier(legs)


def _is_barred(begin: _Places, end: _Places, level: Level, off: float) -> Array:
    """Returns whether segments meet an obstacle widened by `off`.

    The test uses separating axes (Ericson 2005, "Real-Time Collision Detection", section 5.3.3).

    Args:
      begin: places where the segments begin.
      end: places where the segments end; the axes after the obstacle axis broadcast with `begin`.
      level: the level, whose obstacles are tested.
      off: m.

    Returns:
      [...] bool.
    """

    def meets(i: Array) -> Array:
        half_x, half_y = level.obstacle[i, 3] + off, level.obstacle[i, 4] + off
        middle_x, middle_y = 0.5 * (begin.x[i] + end.x[i]), 0.5 * (begin.y[i] + end.y[i])
        reach_x, reach_y = 0.5 * (end.x[i] - begin.x[i]), 0.5 * (end.y[i] - begin.y[i])
        across = middle_x * reach_y - middle_y * reach_x
        reach_x, reach_y = jnp.abs(reach_x), jnp.abs(reach_y)
        return (
            (jnp.abs(middle_x) < half_x + reach_x)
            & (jnp.abs(middle_y) < half_y + reach_y)
            & (jnp.abs(across) < half_x * reach_y + half_y * reach_x)
            & level.obstacle_present[i]
        )

    return _any(meets, begin.x + end.x)


def _any(of: Callable[[Array], Array], like: Array) -> Array:
    """Returns [...] whether `of` holds for any obstacle; `like` has shape [M, ...].

    The obstacles are handled in a loop. With a reduction or unrolled code, XLA takes minutes to
    compile on a GPU.
    """
    nothing = jnp.zeros(like.shape[1:], bool)
    if not len(like):
        return nothing
    return jax.lax.fori_loop(0, like.shape[0], lambda i, found: found | of(i), nothing)
