"""The infrared rays of robots, computed from the geometry of walls, discs and rotated boxes.

There is one function per shape. Each function returns the distance at which a ray meets the shape,
`inf` for a ray that misses it, and 0 for a ray that starts inside it. The e-puck's sensors sit 3.5
to 6 mm behind the hull's surface, so a robot pressed against an object has its sensor inside that
object. The code runs on NumPy or JAX.
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from swarmjax import epuck
from swarmjax.sim.dispatch import in_turn, least, pieces
from swarmjax.sim.neighbours import Near, others

Array = Any
# Objects of one kind: their distances (m) along rays, in pieces [..., R, K, N], and their
# reflectances [..., R or 1, K or 1, N]; None if all reflectances are 1.
_Thing = tuple[list[Array], Array | None]


class Mount(NamedTuple):
    """Where the sensors of robots sit, and where they point.

    Attributes:
      poses: x (m), y (m) and yaw (rad) of each sensor in the frame of the robot.
      turn: [..., K] angle by which each sensor is turned to the left of its nominal yaw, rad; None
        if all are 0.
    """

    poses: Sequence[Sequence[float]] = epuck.SENSOR_POSES
    turn: Array | None = None


EPUCK = Mount()


class Reflectance(NamedTuple):
    """Reflectances of surfaces, above 0 and at most 1; None means 1.

    Attributes:
      fixture: [..., 1 + M] one reflectance for all walls, then one for each obstacle.
      robot: [..., R] reflectance of each robot.
    """

    fixture: Array | None = None
    robot: Array | None = None


class Ray(NamedTuple):
    """Rays, by default in the world frame; separate coordinate arrays spare XLA gather operations.

    Attributes:
      x: [...] x of the origin, m.
      y: [...] y of the origin, m.
      toward_x: [...] x of the unit direction.
      toward_y: [...] y of the unit direction.
    """

    x: Array
    y: Array
    toward_x: Array
    toward_y: Array


class Box(NamedTuple):
    """Rotated rectangles, with sine and cosine of the yaw computed once for all rays.

    Attributes:
      x: [...] x of the centre, m.
      y: [...] y of the centre, m.
      cos: [...] cosine of the yaw.
      sin: [...] sine of the yaw.
      half_x: [...] half edge along the rectangle's own x axis, m.
      half_y: [...] half edge along the rectangle's own y axis, m.
    """

    x: Array
    y: Array
    cos: Array
    sin: Array
    half_x: Array
    half_y: Array

    def at(self, index: Any) -> "Box":
        """Returns the rectangles at an index, applied to each of the arrays."""
        return Box(*(part[index] for part in self))


def rays(pose: Array, xp: Any, mount: Mount = EPUCK) -> tuple[Array, Array]:
    """Places the rays of robots in the world.

    Args:
      pose: [..., 3] x (m), y (m), yaw (rad).
      xp: `numpy` or `jax.numpy`.
      mount: how the sensors are mounted.

    Returns:
      Two arrays [..., K, 2] in the world frame: the origins (m) and the unit directions of the
      rays.
    """
    x, y, toward_x, toward_y = _cast(pose, xp, mount)
    return xp.stack([x, y], axis=-1), xp.stack([toward_x, toward_y], axis=-1)


def _cast(pose: Array, xp: Any, mount: Mount) -> Ray:
    """Places the rays [..., K] of robots [..., 3] in the world."""
    cos, sin = xp.cos(pose[..., 2])[..., None], xp.sin(pose[..., 2])[..., None]
    x, y, ahead, aside = mounted(mount, xp)
    return Ray(
        x=pose[..., :1] + cos * x - sin * y,
        y=pose[..., 1:2] + sin * x + cos * y,
        toward_x=cos * ahead - sin * aside,
        toward_y=sin * ahead + cos * aside,
    )


def mounted(mount: Mount, xp: Any) -> Ray:
    """Returns rays [K] or [..., K] in the frames of the robots; rotate them by a robot's yaw.

    Args:
      mount: how the sensors are mounted.
      xp: `numpy` or `jax.numpy`.
    """
    x, y, bearing = np.array(mount.poses, np.float32).T
    if mount.turn is None:
        return Ray(x, y, np.cos(bearing), np.sin(bearing))
    yaw = bearing + mount.turn
    return Ray(x, y, xp.cos(yaw), xp.sin(yaw))


def ray_walls(ray: Ray, half: Array, xp: Any) -> Array:
    """Returns the distance to the walls of a square arena centred on the origin.

    Args:
      ray: [...].
      half: [...] half of the arena's side, m.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] m; 0 outside the arena.
    """
    to_x = _to_wall(ray.x, ray.toward_x, half, xp)
    to_y = _to_wall(ray.y, ray.toward_y, half, xp)
    outside = xp.maximum(xp.abs(ray.x), xp.abs(ray.y)) >= half
    return xp.where(outside, 0.0, xp.minimum(to_x, to_y))


def _to_wall(at: Array, toward: Array, half: Array, xp: Any) -> Array:
    """Returns the distance [...] to the wall ahead, of the two walls perpendicular to one axis."""
    pace = xp.maximum(xp.abs(toward), 1e-9)  # a ray along a wall never meets it
    return (half - xp.where(toward < 0.0, -at, at)) / pace


def ray_disc(ray: Ray, x: Array, y: Array, radius: float, xp: Any) -> Array:
    """Returns the distance to a disc.

    Args:
      ray: [...].
      x: [...] x of the centre, m.
      y: [...] y of the centre, m.
      radius: m.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] m.
    """
    x, y = x - ray.x, y - ray.y
    along = x * ray.toward_x + y * ray.toward_y
    power = x * x + y * y - radius * radius
    discriminant = along * along - power
    meets = (discriminant >= 0.0) & (along > 0.0)
    reach = xp.where(meets, along - xp.sqrt(xp.maximum(discriminant, 0.0)), xp.inf)
    return xp.where(power <= 0.0, 0.0, reach)


def ray_box(ray: Ray, box: Box, xp: Any) -> Array:
    """Returns the distance to a rotated rectangle, by the slab method in the rectangle's frame.

    Args:
      ray: [...].
      box: [...].
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] m.
    """
    x, y = to_box_frame(ray.x - box.x, ray.y - box.y, box)
    toward_x, toward_y = to_box_frame(ray.toward_x, ray.toward_y, box)
    enter_x, leave_x = _cross(x, toward_x, box.half_x, xp)
    enter_y, leave_y = _cross(y, toward_y, box.half_y, xp)
    enter, leave = xp.maximum(enter_x, enter_y), xp.minimum(leave_x, leave_y)
    meets = (enter <= leave) & (leave >= 0.0)
    return xp.where(meets, xp.maximum(enter, 0.0), xp.inf)


def _cross(at: Array, toward: Array, half: Array, xp: Any) -> tuple[Array, Array]:
    """Returns where [...] a ray enters and leaves the slab between two faces of a rectangle."""
    # A ray along a face gets a tiny slope, which decides whether it hits or misses the slab.
    pace = 1.0 / xp.where(xp.abs(toward) < 1e-9, 1e-9, toward)
    first, second = (-half - at) * pace, (half - at) * pace
    return xp.minimum(first, second), xp.maximum(first, second)


def turned(box: Array, xp: Any) -> Box:
    """Converts rectangles [..., 5] to `Box`: x (m), y (m), yaw (rad), half edges (m)."""
    x, y, yaw, half_x, half_y = (box[..., i] for i in range(5))
    return Box(x, y, xp.cos(yaw), xp.sin(yaw), half_x, half_y)


def to_box_frame(x: Array, y: Array, box: Box) -> tuple[Array, Array]:
    """Rotates vectors x [...] and y [...] from the world frame into the frames of rectangles."""
    return box.cos * x + box.sin * y, box.cos * y - box.sin * x


def distances(
    pose: Array,
    side: Array,
    obstacle: Array,
    hull_radius: float,
    limit: float,
    xp: Any,
    mount: Mount = EPUCK,
    near: Near | None = None,
) -> Array:
    """Returns the exact distances from the infrared sensors of a swarm to what they see.

    Args:
      pose: [..., R, 3] x (m), y (m), yaw (rad) of the robots; absent ones are parked far away.
        [R, 3] with `near`.
      side: [...] side of the arena, m.
      obstacle: [..., M, 5] x (m), y (m), yaw (rad), half edges (m); absent ones are parked far
        away.
      hull_radius: m.
      limit: range of a sensor from its own origin, m.
      xp: `numpy` or `jax.numpy`.
      mount: how the sensors are mounted.
      near: the robots near each robot, found with this `limit`; None compares all pairs.

    Returns:
      [..., R, K] distance from the sensor's origin to the nearest surface, m, 0..limit.
    """
    dull = Reflectance()
    things = _things(pose, side, obstacle, hull_radius, mount, dull, near, xp)
    reaches = itertools.chain(*(reaches for reaches, _ in things))
    return xp.maximum(least(reaches, limit, xp), 0.0)


def sights(
    pose: Array,
    side: Array,
    obstacle: Array,
    hull_radius: float,
    limit: float,
    reflectance: Reflectance,
    mount: Mount,
    near: Near | None = None,
) -> tuple[Array, Array]:
    """Returns the distances and reflectances of what the infrared sensors of a swarm see.

    Args:
      pose: [..., R, 3] x (m), y (m), yaw (rad) of the robots; absent ones are parked far away.
        [R, 3] with `near`. If this is a NumPy array, the code runs on NumPy, otherwise on JAX.
      side: [...] side of the arena, m.
      obstacle: [..., M, 5] x (m), y (m), yaw (rad), half edges (m).
      hull_radius: m.
      limit: range of a sensor from its own origin, m.
      reflectance: reflectances of surfaces.
      mount: how the sensors are mounted.
      near: the robots near each robot, found with this `limit`; None compares all pairs.

    Returns:
      The distance [..., R, K] from each sensor's origin to the nearest surface, m, 0..limit, and
      the reflectance [..., R, K] of that surface. The reflectance is 1 where there is no surface
      within `limit`. If several surfaces are equally near, it is that of the brightest.
    """
    xp = pose.__array_namespace__()
    nearest, bright = xp.inf, 1.0
    for reaches, shade in _things(pose, side, obstacle, hull_radius, mount, reflectance, near, xp):
        here = least(reaches, xp.inf, xp)
        found = _brightest(reaches, here, shade, xp)
        brighter = xp.where(here == nearest, xp.maximum(bright, found), bright)
        bright = xp.where(here < nearest, found, brighter)
        nearest = xp.minimum(nearest, here)
    return xp.clip(nearest, 0.0, limit), xp.where(nearest < limit, bright, 1.0)


def _brightest(reaches: list[Array], here: Array, shade: Array | None, xp: Any) -> Array | float:
    """Returns the largest reflectance [..., R, K] of the objects that rays meet at `here` (m)."""
    if shade is None:
        return 1.0
    found = 0.0
    for reach, piece in zip(reaches, pieces(shade.shape[-1], xp), strict=True):
        meets = reach <= here[..., None]
        shades = xp.where(meets, shade[..., piece], 0.0)
        found = xp.maximum(found, xp.max(shades, axis=-1, initial=0.0))
    return found


def _things(
    pose: Array,
    side: Array,
    obstacle: Array,
    hull_radius: float,
    mount: Mount,
    reflectance: Reflectance,
    near: Near | None,
    xp: Any,
) -> tuple[_Thing, _Thing, _Thing]:
    """Returns distances and reflectances of walls, other robots and obstacles, for all rays."""
    ray = _cast(pose, xp, mount)
    wall = ray_walls(ray, 0.5 * side[..., None, None], xp)[..., None]
    x, y, myself = others(pose, near, xp)
    long = Ray(*(part[..., None] for part in ray))

    def to_robots(i: slice) -> Array:
        reach = ray_disc(long, x[..., None, i], y[..., None, i], hull_radius, xp)
        return xp.where(myself[:, None, i], xp.inf, reach)

    robots = [to_robots(i) for i in pieces(myself.shape[-1], xp)]
    fixture, shade = reflectance
    shade = _pick(shade, np.s_[..., None, None, :] if near is None else np.s_[near.index[:, None]])
    walls = [wall], _pick(fixture, np.s_[..., None, None, :1])
    box = turned(obstacle, xp)
    if near is not None and xp is not np:
        found = _boxes_in_turn(ray, box, _pick(fixture, np.s_[1:]), xp)
        return walls, (robots, shade), found
    boxes = [ray_box(long, box.at((..., None, None, i)), xp) for i in pieces(box.x.shape[-1], xp)]
    return walls, (robots, shade), (boxes, _pick(fixture, np.s_[..., None, None, 1:]))


def _pick(shade: Array | None, index: Any) -> Array | None:
    return None if shade is None else shade[index]


def _boxes_in_turn(ray: Ray, box: Box, shades: Array | None, xp: Any) -> _Thing:
    """Returns the nearest obstacle for each ray [R, K], by going through all obstacles in turn."""

    def meet(found: tuple[Array, Array], one: tuple[Box, Array]) -> tuple[Array, Array]:
        (here, bright), (each, shade) = found, one
        reach = ray_box(ray, each, xp)
        if shades is not None:
            brighter = xp.where(reach == here, xp.maximum(bright, shade), bright)
            bright = xp.where(reach < here, shade, brighter)
        return xp.minimum(here, reach), bright

    nothing = xp.full(ray.x.shape, xp.inf)
    here, bright = in_turn(meet, (nothing, xp.zeros_like(nothing)), (box, shades))
    return [here[..., None]], None if shades is None else bright[..., None]
