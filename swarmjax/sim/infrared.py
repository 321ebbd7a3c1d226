"""Eight infrared rays a robot, by geometry: a ray against the walls, discs and turned boxes.

One function a shape; each returns the distance at which the ray meets the shape, `inf` where it
misses, and 0 where it starts inside: a sensor sits 3.5 to 6 mm behind the hull's surface, so a
robot that is pressed against something has its sensor inside that thing. NumPy or JAX.
"""

from typing import Any

import numpy as np

from swarmjax import epuck

Array = Any
SENSOR_POSES = np.array(epuck.SENSOR_POSES, np.float32)


def rays(pose: Array, xp: Any) -> tuple[Array, Array]:
    """Places the rays of robots in the world.

    Args:
      pose: [..., 3] x (m), y (m), yaw (rad).
      xp: `numpy` or `jax.numpy`.

    Returns:
      Origins and unit directions, [..., K, 2] each, world frame.
    """
    cos, sin = xp.cos(pose[..., 2:]), xp.sin(pose[..., 2:])
    x, y, bearing = SENSOR_POSES.T
    origin_x = pose[..., :1] + cos * x - sin * y
    origin_y = pose[..., 1:2] + sin * x + cos * y
    # The angle-sum identities save a sine and a cosine for every ray.
    toward_x = cos * np.cos(bearing) - sin * np.sin(bearing)
    toward_y = sin * np.cos(bearing) + cos * np.sin(bearing)
    return xp.stack([origin_x, origin_y], axis=-1), xp.stack([toward_x, toward_y], axis=-1)


def ray_walls(origin: Array, direction: Array, half: Array, xp: Any) -> Array:
    """Distance to the walls of a square arena centred on the origin.

    Args:
      origin: [..., 2] m.
      direction: [..., 2] unit.
      half: [...] half of the arena's side, m.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] m; 0 outside the arena.
    """
    spare = half[..., None] - xp.abs(origin)
    room = half[..., None] - origin * xp.where(direction < 0.0, -1.0, 1.0)
    pace = xp.maximum(xp.abs(direction), 1e-9)  # a ray along a wall never meets it
    reach = xp.min(room / pace, axis=-1)
    return xp.where(xp.min(spare, axis=-1) <= 0.0, 0.0, reach)


def ray_disc(origin: Array, direction: Array, centre: Array, radius: float, xp: Any) -> Array:
    """Distance to a disc.

    Args:
      origin: [..., 2] m.
      direction: [..., 2] unit.
      centre: [..., 2] m.
      radius: m.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] m.
    """
    offset = centre - origin
    along = xp.sum(offset * direction, axis=-1)
    power = xp.sum(offset * offset, axis=-1) - radius * radius
    discriminant = along * along - power
    meets = (discriminant >= 0.0) & (along > 0.0)
    reach = xp.where(meets, along - xp.sqrt(xp.maximum(discriminant, 0.0)), xp.inf)
    return xp.where(power <= 0.0, 0.0, reach)


def ray_box(origin: Array, direction: Array, box: Array, xp: Any) -> Array:
    """Distance to a turned rectangle, by the slab method in the rectangle's own frame.

    Args:
      origin: [..., 2] m.
      direction: [..., 2] unit.
      box: [..., 5] x (m), y (m), yaw (rad), half edges (m).
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] m.
    """
    local = to_box_frame(origin - box[..., :2], box[..., 2], xp)
    toward = to_box_frame(direction, box[..., 2], xp)
    # A ray along a face gets a tiny slope, which decides between meeting the slab and missing it.
    toward = xp.where(xp.abs(toward) < 1e-9, 1e-9, toward)
    first = (-box[..., 3:] - local) / toward
    second = (box[..., 3:] - local) / toward
    enter = xp.max(xp.minimum(first, second), axis=-1)
    leave = xp.min(xp.maximum(first, second), axis=-1)
    meets = (enter <= leave) & (leave >= 0.0)
    return xp.where(meets, xp.maximum(enter, 0.0), xp.inf)


def to_box_frame(vector: Array, yaw: Array, xp: Any) -> Array:
    """Turns vectors [..., 2] from the world's frame into one that is turned by `yaw` [...]."""
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    x, y = vector[..., 0], vector[..., 1]
    return xp.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def distances(
    pose: Array, side: Array, obstacle: Array, hull_radius: float, limit: float, xp: Any
) -> Array:
    """What the infrared sensors of a swarm see, as ideal distances.

    Args:
      pose: [R, 3] x (m), y (m), yaw (rad) of the robots; absent ones are parked far away.
      side: [] of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m); absent ones are parked far away.
      hull_radius: m.
      limit: reach of a sensor from its own origin, m.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [R, K] distance from the sensor's origin to the nearest surface, m, 0..limit.
    """
    origin, direction = rays(pose, xp)
    nearest = ray_walls(origin, direction, 0.5 * side * xp.ones_like(origin[..., 0]), xp)
    start, toward = origin[:, :, None], direction[:, :, None]
    others = ray_disc(start, toward, pose[None, None, :, :2], hull_radius, xp)
    myself = np.eye(pose.shape[0], dtype=bool)[:, None, :]
    others = xp.where(myself, xp.inf, others)
    nearest = xp.minimum(nearest, xp.min(others, axis=-1, initial=limit))
    boxes = ray_box(start, toward, obstacle[None, None], xp)
    nearest = xp.minimum(nearest, xp.min(boxes, axis=-1, initial=limit))
    return xp.clip(nearest, 0.0, limit)
