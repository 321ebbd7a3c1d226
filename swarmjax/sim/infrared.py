"""Eight infrared rays a robot, by geometry: a ray against the walls, discs and turned boxes.

One function a shape; each returns the distance at which the ray meets the shape, `inf` where it
misses, and 0 where it starts inside: a sensor sits 3.5 to 6 mm behind the hull's surface, so a
robot that is pressed against something has its sensor inside that thing. NumPy or JAX.
"""

from typing import Any, NamedTuple

import numpy as np

from swarmjax import epuck

Array = Any
SENSOR_POSES = np.array(epuck.SENSOR_POSES, np.float32)


class Mount(NamedTuple):
    """How far off its nominal pose each sensor sits; None where none does.

    Attributes:
      yaw: [..., R, K] rad, counter-clockwise.
      position: [..., R, K, 2] forward and left in the robot's frame, m.
    """

    yaw: Array | None = None
    position: Array | None = None


class Reflectance(NamedTuple):
    """How bright things are, above 0 and at most 1; None is 1.

    Attributes:
      wall: [...] of all the walls.
      obstacle: [..., M].
      robot: [..., R].
    """

    wall: Array | None = None
    obstacle: Array | None = None
    robot: Array | None = None


def rays(pose: Array, xp: Any, mount: Mount | None = None) -> tuple[Array, Array]:
    """Places the rays of robots in the world.

    Args:
      pose: [..., 3] x (m), y (m), yaw (rad).
      xp: `numpy` or `jax.numpy`.
      mount: errors of the sensors' poses; None is none.

    Returns:
      Origins and unit directions, [..., K, 2] each, world frame.
    """
    cos, sin = xp.cos(pose[..., 2:]), xp.sin(pose[..., 2:])
    x, y, bearing = SENSOR_POSES.T
    # The angle-sum identities save a sine and a cosine for every ray that sits where it should.
    ahead, aside = np.cos(bearing), np.sin(bearing)
    if mount is not None and mount.yaw is not None:
        ahead, aside = xp.cos(bearing + mount.yaw), xp.sin(bearing + mount.yaw)
    if mount is not None and mount.position is not None:
        x, y = x + mount.position[..., 0], y + mount.position[..., 1]
    origin_x = pose[..., :1] + cos * x - sin * y
    origin_y = pose[..., 1:2] + sin * x + cos * y
    toward_x = cos * ahead - sin * aside
    toward_y = sin * ahead + cos * aside
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
    room = half[..., None] - xp.where(direction < 0.0, -origin, origin)
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
    pose: Array,
    side: Array,
    obstacle: Array,
    hull_radius: float,
    limit: float,
    xp: Any,
    mount: Mount | None = None,
) -> Array:
    """What the infrared sensors of a swarm see, as ideal distances.

    Args:
      pose: [..., R, 3] x (m), y (m), yaw (rad) of the robots; absent ones are parked far away.
      side: [...] of the arena, m.
      obstacle: [..., M, 5] x (m), y (m), yaw (rad), half edges (m); absent ones are parked far
        away.
      hull_radius: m.
      limit: reach of a sensor from its own origin, m.
      xp: `numpy` or `jax.numpy`.
      mount: errors of the sensors' poses; None is none.

    Returns:
      [..., R, K] distance from the sensor's origin to the nearest surface, m, 0..limit.
    """
    nearest = limit
    for reach in _reaches(pose, side, obstacle, hull_radius, mount, xp):
        nearest = xp.minimum(nearest, xp.min(reach, axis=-1, initial=limit))
    return xp.maximum(nearest, 0.0)


def sights(
    pose: Array,
    side: Array,
    obstacle: Array,
    hull_radius: float,
    limit: float,
    reflectance: Reflectance,
    mount: Mount | None,
    xp: Any,
) -> tuple[Array, Array]:
    """What the infrared sensors of a swarm see, and how bright it is.

    Args:
      pose: [..., R, 3] as for `distances`, as are all but `reflectance`.
      side: [...] of the arena, m.
      obstacle: [..., M, 5] x (m), y (m), yaw (rad), half edges (m).
      hull_radius: m.
      limit: reach of a sensor from its own origin, m.
      reflectance: of things.
      mount: errors of the sensors' poses; None is none.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., R, K] distance from the sensor's origin to the nearest surface, m, 0..limit; and the
      reflectance of what is there, 1 where nothing is. Of two things at the same distance, the
      wall counts before a robot and a robot before an obstacle, of a kind the brightest.
    """
    wall, robot, box = _reaches(pose, side, obstacle, hull_radius, mount, xp)
    walls = None if reflectance.wall is None else reflectance.wall[..., None]
    things = ((wall, walls), (robot, reflectance.robot), (box, reflectance.obstacle))
    nearest, bright = xp.inf, 1.0
    for reach, shade in things:
        here = xp.min(reach, axis=-1, initial=xp.inf)
        bright = xp.where(here < nearest, _brightest(reach, here, shade, xp), bright)
        nearest = xp.minimum(nearest, here)
    return xp.clip(nearest, 0.0, limit), xp.where(nearest < limit, bright, 1.0)


def _brightest(reach: Array, here: Array, shade: Array | None, xp: Any) -> Array | float:
    """Reflectance [..., R, K] of the things of one kind, [..., N], that rays meet at `here`."""
    if shade is None:
        return 1.0
    meets = reach <= here[..., None]
    return xp.max(xp.where(meets, shade[..., None, None, :], 0.0), axis=-1, initial=0.0)


def _reaches(
    pose: Array, side: Array, obstacle: Array, hull_radius: float, mount: Mount | None, xp: Any
) -> tuple[Array, Array, Array]:
    """Distances [..., R, K, N] (m) to the walls (N = 1), the other robots and the obstacles."""
    origin, direction = rays(pose, xp, mount)
    half = 0.5 * side[..., None, None] * xp.ones_like(origin[..., 0])
    wall = ray_walls(origin, direction, half, xp)[..., None]
    start, toward = origin[..., None, :], direction[..., None, :]
    others = ray_disc(start, toward, pose[..., None, None, :, :2], hull_radius, xp)
    myself = np.eye(pose.shape[-2], dtype=bool)[:, None, :]
    others = xp.where(myself, xp.inf, others)
    return wall, others, ray_box(start, toward, obstacle[..., None, None, :, :], xp)
