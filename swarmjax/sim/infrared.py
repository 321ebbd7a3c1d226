"""Eight infrared rays a robot, by geometry: a ray against the walls, discs and turned boxes.

One function a shape; each returns the distance at which the ray meets the shape, `inf` where it
misses, and 0 where it starts inside: a sensor sits 3.5 to 6 mm behind the hull's surface, so a
robot that is pressed against something has its sensor inside that thing. NumPy or JAX.
"""

import itertools
from typing import Any, NamedTuple

import numpy as np

from swarmjax import epuck
from swarmjax.sim.pieces import nearest, pieces

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
    (x, y), (toward_x, toward_y) = xy(origin), xy(direction)
    reach = xp.minimum(_to_wall(x, toward_x, half, xp), _to_wall(y, toward_y, half, xp))
    return xp.where(xp.maximum(xp.abs(x), xp.abs(y)) >= half, 0.0, reach)


def _to_wall(at: Array, toward: Array, half: Array, xp: Any) -> Array:
    """Distance [...] along a ray to the wall that it looks at, of the two across one axis."""
    pace = xp.maximum(xp.abs(toward), 1e-9)  # a ray along a wall never meets it
    return (half - xp.where(toward < 0.0, -at, at)) / pace


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
    (toward_x, toward_y), (x, y) = xy(direction), xy(origin)
    x, y = centre[..., 0] - x, centre[..., 1] - y
    along = x * toward_x + y * toward_y
    power = x * x + y * y - radius * radius
    discriminant = along * along - power
    meets = (discriminant >= 0.0) & (along > 0.0)
    reach = xp.where(meets, along - xp.sqrt(xp.maximum(discriminant, 0.0)), xp.inf)
    return xp.where(power <= 0.0, 0.0, reach)


def ray_box(origin: Array, direction: Array, box: Array, xp: Any) -> Array:
    """Distance to a turned rectangle, by the slab method in the rectangle's own frame.

    Args:
      origin: [..., 2] m.
      direction: [..., 2] unit.
      box: [..., 6] as `turned` has it.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] m.
    """
    (x, y), (toward_x, toward_y) = xy(origin), xy(direction)
    x, y = to_box_frame(x - box[..., 0], y - box[..., 1], box)
    toward_x, toward_y = to_box_frame(toward_x, toward_y, box)
    enter_x, leave_x = _cross(x, toward_x, box[..., 4], xp)
    enter_y, leave_y = _cross(y, toward_y, box[..., 5], xp)
    enter, leave = xp.maximum(enter_x, enter_y), xp.minimum(leave_x, leave_y)
    meets = (enter <= leave) & (leave >= 0.0)
    return xp.where(meets, xp.maximum(enter, 0.0), xp.inf)


def _cross(at: Array, toward: Array, half: Array, xp: Any) -> tuple[Array, Array]:
    """Where [...] a ray enters and leaves the slab between two faces of a rectangle."""
    # A ray along a face gets a tiny slope, which decides between meeting the slab and missing it.
    pace = 1.0 / xp.where(xp.abs(toward) < 1e-9, 1e-9, toward)
    first, second = (-half - at) * pace, (half - at) * pace
    return xp.minimum(first, second), xp.maximum(first, second)


def xy(vector: Array) -> tuple[Array, Array]:
    """Takes the coordinates [...] of vectors [..., 2] apart."""
    return vector[..., 0], vector[..., 1]


def turned(box: Array, xp: Any) -> Array:
    """Works out which way rectangles are turned, once for all that look at them.

    Args:
      box: [..., 5] x (m), y (m), yaw (rad), half edges (m).
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., 6] x (m), y (m), cosine and sine of the yaw, half edges (m).
    """
    yaw = box[..., 2:3]
    return xp.concatenate([box[..., :2], xp.cos(yaw), xp.sin(yaw), box[..., 3:]], axis=-1)


def to_box_frame(x: Array, y: Array, box: Array) -> tuple[Array, Array]:
    """Turns vectors [...] from the world's frame into that of rectangles [..., 6], as `turned`."""
    cos, sin = box[..., 2], box[..., 3]
    return cos * x + sin * y, cos * y - sin * x


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
    reaches = itertools.chain(*_reaches(pose, side, obstacle, hull_radius, mount, xp))
    return xp.maximum(nearest(reaches, limit, xp), 0.0)


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
    least, bright = xp.inf, 1.0
    for reaches, shade in things:
        here = nearest(reaches, xp.inf, xp)
        bright = xp.where(here < least, _brightest(reaches, here, shade, xp), bright)
        least = xp.minimum(least, here)
    return xp.clip(least, 0.0, limit), xp.where(least < limit, bright, 1.0)


def _brightest(reaches: list[Array], here: Array, shade: Array | None, xp: Any) -> Array | float:
    """Reflectance [..., R, K] of the things of one kind, [..., N], that rays meet at `here`."""
    if shade is None:
        return 1.0
    found = 0.0
    for reach, piece in zip(reaches, pieces(shade.shape[-1], xp), strict=True):
        meets = reach <= here[..., None]
        shades = xp.where(meets, shade[..., None, None, piece], 0.0)
        found = xp.maximum(found, xp.max(shades, axis=-1, initial=0.0))
    return found


def _reaches(
    pose: Array, side: Array, obstacle: Array, hull_radius: float, mount: Mount | None, xp: Any
) -> tuple[list[Array], list[Array], list[Array]]:
    """Distances (m) to the walls, the other robots and the obstacles, [..., R, K, 1] a piece."""
    origin, direction = rays(pose, xp, mount)
    wall = ray_walls(origin, direction, 0.5 * side[..., None, None], xp)[..., None]
    start, toward = origin[..., None, :], direction[..., None, :]
    myself = np.eye(pose.shape[-2], dtype=bool)[:, None, :]
    centre = pose[..., None, None, :, :2]
    box = turned(obstacle, xp)[..., None, None, :, :]
    others = [
        xp.where(
            myself[..., i], xp.inf, ray_disc(start, toward, centre[..., i, :], hull_radius, xp)
        )
        for i in pieces(pose.shape[-2], xp)
    ]
    boxes = [ray_box(start, toward, box[..., i, :], xp) for i in pieces(obstacle.shape[-2], xp)]
    return [wall], others, boxes
