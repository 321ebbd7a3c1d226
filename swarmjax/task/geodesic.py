"""How far it is to the target along the shortest path around walls and boxes.

A visibility graph (Lozano-Pérez & Wesley 1979, "An Algorithm for Planning Collision-Free Paths
Among Polyhedral Obstacles"), solved for every target once an episode: from then on the distance is
the least, over the corners that a robot sees, of the way to the corner and the way on from there.
Rewards of navigation count progress along it (Wijmans et al. 2020, "DD-PPO", section 4).

Other robots do not count. Obstacles are widened by a little less than a robot's radius, with square
corners, so that a robot that touches one is still outside. Lengths are then a millimetre too short
to three centimetres too long, and a gap of 59 to 74 mm counts as a way though no robot fits. What
matters to a reward is which way round a path leads, and that it gets shorter on the way.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from swarmjax.task.level import PARKING, Level
from swarmjax.task.surroundings import into_frame

# Of the hull's radius: by how much obstacles are widened, and how far off corners lie. Contacts
# are soft, so a robot that is pushed against a wall is a little nearer than its radius.
_WIDENED = 0.8
_CORNER = 0.9
_SIGNS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))


class Roadmap(NamedTuple):
    """Where paths turn, and how far it is from there.

    Attributes:
      corner: [K, 2] of the widened obstacles, x and y, m.
      to_go: [R, K] from each corner to each robot's target, m; inf where no path leads.
    """

    corner: Array
    to_go: Array


class Path(NamedTuple):
    """What an arena keeps of the paths of its robots.

    Attributes:
      roadmap: of the episode.
      distance: [R] along the shortest path to the target, m.
    """

    roadmap: Roadmap
    distance: Array


def begin(level: Level, hull_radius: float, fast: Any = None) -> Path:
    """Finds the paths of an episode.

    Args:
      level: what it starts from.
      hull_radius: of robots, m.
      fast: what finds them by Warp, `swarmjax.sim.fast.paths_warp`; None: plain JAX.

    Returns:
      The paths from where robots start. A robot that has none is as far away as the straight line.
    """
    level = jax.tree.map(jnp.asarray, level)
    roadmap = survey(level, hull_radius, fast)
    start = level.start[:, :2]
    straight = jnp.hypot(*(level.target - start).T)
    return Path(roadmap, _measured(roadmap, start, level, hull_radius, fast, straight))


def go_on(path: Path, place: Array, level: Level, hull_radius: float, fast: Any = None) -> Path:
    """Measures the paths from where robots are now.

    Args:
      path: before.
      place: [R, 2] where the robots are now, m.
      level: of the episode.
      hull_radius: of robots, m.
      fast: as of `begin`.

    Returns:
      The paths from there. A robot from where none is found keeps its distance.
    """
    distance = _measured(path.roadmap, place, level, hull_radius, fast, path.distance)
    return path._replace(distance=distance)


def _measured(
    roadmap: Roadmap, place: Array, level: Level, hull_radius: float, fast: Any, otherwise: Array
) -> Array:
    """Returns the distances [R], those of `otherwise` where no path leads."""
    distance = measure(roadmap, place, level, hull_radius, fast)
    return jnp.where(jnp.isfinite(distance), distance, otherwise)


def survey(level: Level, hull_radius: float, fast: Any = None) -> Roadmap:
    """Solves the visibility graph of a level for the targets of its robots.

    Args:
      level: of which obstacles and targets count.
      hull_radius: of robots, m.
      fast: as of `begin`.

    Returns:
      The corners, four an obstacle, and how far it is from there.
    """
    corner = jax.lax.optimization_barrier(_corners(level, _CORNER * hull_radius))
    if fast is not None and len(corner):
        widened, frame = _WIDENED * hull_radius, _frames(level)
        legs = fast.find_legs(corner, level.side, frame, widened)
        to_go = fast.settle(level.target, level.side, corner, frame, legs, widened)
        return Roadmap(corner, to_go)
    corners, targets = _locate(corner, level), _locate(level.target, level)
    usable = jnp.all(jnp.abs(corner) <= 0.5 * level.side - _WIDENED * hull_radius, axis=-1)
    usable &= ~_covers(corners, level, _WIDENED * hull_radius)
    usable = jax.lax.optimization_barrier(usable)
    legs = _legs(corners, corners, level, hull_radius)
    legs = jnp.where(usable[:, None] & usable[None, :], legs, jnp.inf)
    direct = jnp.where(usable, _legs(targets, corners, level, hull_radius), jnp.inf)

    def shorten(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        # Bellman and Ford's step: a path may have one corner more.
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
      roadmap: of the level.
      place: [R, 2] x and y, m.
      level: of the episode.
      hull_radius: of robots, m.
      fast: as of `begin`.

    Returns:
      [R] m; inf where no path leads.
    """
    if fast is not None and len(roadmap.corner):
        known = level.target, roadmap.corner, roadmap.to_go, _frames(level)
        return fast.measure(place, level.side, *known, _WIDENED * hull_radius)
    here, targets = _locate(place, level), _locate(level.target, level)
    barred = _is_barred(here, targets, level, _WIDENED * hull_radius)
    direct = jnp.where(barred, jnp.inf, jnp.hypot(*(level.target - place).T))
    around = _legs(here, _locate(roadmap.corner, level), level, hull_radius) + roadmap.to_go
    return jnp.minimum(direct, jnp.min(around, axis=-1, initial=jnp.inf))


class _Places(NamedTuple):
    """Places, [P, 2] x and y, m, and where they lie in the frames of the obstacles, [M, P] each."""

    place: Array
    x: Array
    y: Array


def _corners(level: Level, off: float) -> Array:
    """Lists the corners [4 M, 2] of obstacles that are widened by `off`, m."""
    x, y, yaw, half_x, half_y = (each[:, None] for each in level.obstacle.T)
    sign = jnp.asarray(_SIGNS)
    in_x, in_y = sign[:, 0] * (half_x + off), sign[:, 1] * (half_y + off)
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    corner = jnp.stack([x + cos * in_x - sin * in_y, y + sin * in_x + cos * in_y], axis=-1)
    return corner.reshape(-1, 2)


def _frames(level: Level) -> Array:
    """Lists obstacles [M, 6]: x, y (m), cosine and sine of yaw, half edges (m); absent ones far."""
    x, y, yaw, half_x, half_y = level.obstacle.T
    x = jnp.where(level.obstacle_present, x, PARKING)
    return jnp.stack([x, y, jnp.cos(yaw), jnp.sin(yaw), half_x, half_y], axis=-1)


def _locate(place: Array, level: Level) -> _Places:
    """Turns places [P, 2] into coordinates in the frames of the obstacles."""
    local = into_frame(level.obstacle[:, None, :3], place)
    # Pairs of places look at this. Without the barrier XLA puts all of it into the code of each
    # pair, and compiles that for minutes on a GPU.
    return _Places(place, *jax.lax.optimization_barrier(local))


def _covers(places: _Places, level: Level, off: float) -> Array:
    """Tells which places [P] lie within an obstacle that is widened by `off`, m."""

    def within(i: Array) -> Array:
        half_x, half_y = level.obstacle[i, 3] + off, level.obstacle[i, 4] + off
        inside = (jnp.abs(places.x[i]) < half_x) & (jnp.abs(places.y[i]) < half_y)
        return inside & level.obstacle_present[i]

    return _any(within, places.x)


def _legs(begin: _Places, end: _Places, level: Level, hull_radius: float) -> Array:
    """Measures the straight ways [B, E] from B places to E others; inf where barred."""
    away_x, away_y = (end.place[None] - begin.place[:, None]).transpose(2, 0, 1)
    rows = _Places(begin.place, begin.x[:, :, None], begin.y[:, :, None])
    columns = _Places(end.place, end.x[:, None], end.y[:, None])
    barred = _is_barred(rows, columns, level, _WIDENED * hull_radius)
    legs = jnp.where(barred, jnp.inf, jnp.hypot(away_x, away_y))
    return jax.lax.optimization_barrier(legs)


def _is_barred(begin: _Places, end: _Places, level: Level, off: float) -> Array:
    """Tells whether segments meet an obstacle that is widened by `off`.

    Args:
      begin: where they begin; the axes behind that of the obstacles broadcast.
      end: where they end.
      level: whose obstacles.
      off: m.

    Returns:
      [...]. By separating axes (Ericson 2005, "Real-Time Collision Detection", section 5.3.3).
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
    """Tells whether something holds of any obstacle, [...]; `like` is [M, ...].

    One obstacle after the other: as a reduction, or written out, XLA compiles it for minutes on a
    GPU.
    """
    nothing = jnp.zeros(like.shape[1:], bool)
    if not len(like):
        return nothing
    return jax.lax.fori_loop(0, like.shape[0], lambda i, found: found | of(i), nothing)
