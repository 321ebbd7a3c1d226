"""Exact surroundings of each robot in its own frame, only for a critic in training.

The critic may see the full state, since only the actor is deployed (Pinto et al. 2017, "Asymmetric
Actor Critic for Image-Based Robot Learning"). The nearest robots and walls are listed, nearest
first. The list has the same length in every arena, so a critic can continue its training in another
arena.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from swarmjax.sim import model
from swarmjax.task.level import Level
from swarmjax.task.nearest import nearest

NEAREST_ROBOTS = 8
NEAREST_RECTANGLES = 12  # boxes, and walls inside and around the arena
# m; anything farther away is shown at this distance, in its direction. No arena of the stage
# files is wider. The numbers are not normalised: most rows are 0, so a running deviation would be
# small and would magnify the first other entries.
REACH = 2.0
FARTHEST = 4.0  # m; the largest distance to go that is shown, because paths wind around walls
_NEAR = 1e-3  # m; nearer than this, the direction to a waypoint shrinks to 0

_OWN = 6  # target x, y; arrived; distance to go; direction to the waypoint x, y
_ROBOT = 8  # presence; x, y, heading x, y, target x, y, arrived
_RECTANGLE = 8  # presence; nearest x, y, right end x, y, left end x, y, half the short edge

SIZE = _OWN + NEAREST_ROBOTS * _ROBOT + NEAREST_RECTANGLES * _RECTANGLE  # entries, P


def look(pose: Array, level: Level, arrived: Array, to_go: Array, waypoint: Array) -> Array:
    """Lists the surroundings of each robot of one arena.

    Args:
      pose: [R, 3] x (m), y (m), yaw (rad).
      level: level of the episode.
      arrived: [R] whether the robot has arrived.
      to_go: [R] distance to the target, along the shortest path if it is known, m.
      waypoint: [R, 2] first waypoint of this path, m; the target if the path is not known.

    Returns:
      [R, P] in the robots' frames, x forward. Lengths are in m, within +-2; the distance to go is
      within 4. Directions are within +-1. Flags are 0 or 1. Rows of absent objects are 0.
    """
    target = _shown(*into_frame(pose, level.target))
    ahead = _direction(*into_frame(pose, waypoint))
    own = [*target, arrived.astype(jnp.float32), jnp.minimum(to_go, FARTHEST), *ahead]
    parts = [jnp.stack(own, axis=-1), _robots(pose, level, arrived), _rectangles(pose, level)]
    found = jnp.concatenate(parts, axis=-1)
    # Learning skips an arena with broken physics, but its critic still needs finite numbers.
    return jnp.where(jnp.isfinite(found), found, 0.0)


def _direction(x: Array, y: Array) -> tuple[Array, Array]:
    """Scales vectors to length 1, and those shorter than `_NEAR` to less."""
    length = jnp.maximum(jnp.hypot(x, y), _NEAR)
    return x / length, y / length


def _shown(x: Array, y: Array) -> tuple[Array, Array]:
    """Moves points that are farther away than `REACH` to that distance."""
    scale = jnp.minimum(1.0, REACH / jnp.maximum(jnp.hypot(x, y), REACH))
    return scale * x, scale * y


def _robots(pose: Array, level: Level, arrived: Array) -> Array:
    """Lists the other robots, [R, N * _ROBOT]."""
    viewer = pose[:, None]
    distance = jnp.hypot(*into_frame(viewer, pose[None, :, :2]))
    is_there = level.present & ~jnp.eye(len(pose), dtype=bool)
    chosen, is_there = _nearest(distance, is_there, NEAREST_ROBOTS)
    yaw = pose[chosen, 2] - viewer[..., 2]
    place, target = (into_frame(viewer, x[chosen, :2]) for x in (pose, level.target))
    heading = jnp.cos(yaw), jnp.sin(yaw)
    rows = (1.0, *_shown(*place), *heading, *_shown(*target), arrived[chosen])
    return _listed(rows, is_there, NEAREST_ROBOTS)


def _rectangles(pose: Array, level: Level) -> Array:
    """Lists the boxes and walls, [R, N * _RECTANGLE]."""
    every = model.fixture_rectangles(level.side, level.obstacle, jnp)
    is_there = jnp.concatenate([level.obstacle_present, jnp.ones(model.WALLS, bool)])
    gap = _to_rectangle(pose, every)[1]
    chosen, is_there = _nearest(gap, is_there, NEAREST_RECTANGLES)
    found = every[chosen]
    x, y, yaw, half_x, half_y = jnp.moveaxis(found, -1, 0)
    along = jnp.where(half_x >= half_y, 0.0, 0.5 * jnp.pi) + yaw
    reach = jnp.maximum(half_x, half_y)
    middle, viewer = jnp.stack([x, y], axis=-1), pose[:, None]
    end = jnp.stack([reach * jnp.cos(along), reach * jnp.sin(along)], axis=-1)
    one, other = (into_frame(viewer, middle + sign * end) for sign in (-1.0, 1.0))
    is_left = one[0] * other[1] - one[1] * other[0] >= 0.0  # of `other`, seen from the robot
    right = _shown(*(jnp.where(is_left, a, b) for a, b in zip(one, other, strict=True)))
    left = _shown(*(jnp.where(is_left, b, a) for a, b in zip(one, other, strict=True)))
    closest = _shown(*into_frame(viewer, _to_rectangle(pose, found)[0]))
    rows = (1.0, *closest, *right, *left, jnp.minimum(half_x, half_y))
    return _listed(rows, is_there, NEAREST_RECTANGLES)


def _to_rectangle(pose: Array, rectangle: Array) -> tuple[Array, Array]:
    """Finds the nearest points [R, N, 2] of rectangles [N or R, N, 5], and their distances.

    A nearest point is the robot's place, clipped to the rectangle in the rectangle's frame.
    """
    x, y, yaw, half_x, half_y = jnp.moveaxis(rectangle, -1, 0)
    centre = jnp.stack([x, y, yaw], axis=-1)
    at_x, at_y = into_frame(centre, pose[:, None, :2])
    in_x, in_y = jnp.clip(at_x, -half_x, half_x), jnp.clip(at_y, -half_y, half_y)
    return _out_of_frame(centre, in_x, in_y), jnp.hypot(at_x - in_x, at_y - in_y)


def _nearest(distance: Array, is_there: Array, count: int) -> tuple[Array, Array]:
    """Chooses the nearest of N objects at distances [R, N]: `count` or all, nearest first.

    Returns:
      [R, n] indices of the chosen objects, and [R, n] whether they are present.
    """
    ranked = jnp.where(is_there, distance, jnp.inf)
    chosen = nearest(ranked, min(count, distance.shape[1]))
    there = jnp.broadcast_to(is_there, distance.shape)
    return chosen, jnp.take_along_axis(there, chosen, axis=1)


def _listed(rows: tuple[Any, ...], is_there: Array, count: int) -> Array:
    """Interleaves rows of F numbers, [R, n] each, into [R, count * F]; absent rows are 0."""
    every = tuple(jnp.where(is_there, row, 0.0) for row in rows)
    # Compute each number before interleaving. Neighbouring GPU threads that compute different
    # numbers would wait for each other.
    found = jnp.stack(jax.lax.optimization_barrier(every), axis=-1)
    found = jnp.pad(found, ((0, 0), (0, count - found.shape[1]), (0, 0)))
    return found.reshape(len(found), -1)


def into_frame(frame: Array, point: Array) -> tuple[Array, Array]:
    """Converts points [..., 2] of the arena to coordinates in frames [..., 3]."""
    x, y = point[..., 0] - frame[..., 0], point[..., 1] - frame[..., 1]
    cos, sin = jnp.cos(frame[..., 2]), jnp.sin(frame[..., 2])
    return cos * x + sin * y, cos * y - sin * x


def _out_of_frame(frame: Array, x: Array, y: Array) -> Array:
    """Converts coordinates in frames [..., 3] to points [..., 2] of the arena."""
    cos, sin = jnp.cos(frame[..., 2]), jnp.sin(frame[..., 2])
    return jnp.stack([frame[..., 0] + cos * x - sin * y, frame[..., 1] + sin * x + cos * y], -1)
