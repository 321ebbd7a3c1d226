"""Finds what surrounds each robot, in one Warp kernel instead of several XLA kernels.

The results equal those of `infrared` and `gaps`. A thread computes rays and gaps of one robot. It
looks only at other robots in the cells around this robot (`cells_warp`), and skips boxes that are
too far away. XLA would intersect each ray with each box, and would sort the robots to list those
near each robot.
"""

# Warp's types know neither the arguments of a struct nor those of an array.
# pyright: reportCallIssue=false

import functools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import warp as wp
from jax import Array

from swarmjax.sim import dispatch, infrared
from swarmjax.sim.fast import cells_warp
from swarmjax.sim.fast.arenas_warp import over_arenas
from swarmjax.sim.fast.gaps_warp import WarpBox
from swarmjax.sim.gaps import KINDS
from swarmjax.sim.infrared import Mount
from swarmjax.sim.senses import Scene

_SLACK = wp.constant(1.01)  # look a little further than needed, because numbers are rounded
_THREADS = 2**18  # threads of all arenas together; more do not help
_BOX, _WALL = wp.constant(KINDS.index("obstacle")), wp.constant(KINDS.index("wall"))
_MISS = wp.constant(float("inf"))


def look(scene: Scene, poses: Sequence[Sequence[float]], hull_radius: float, limit: float) -> Array:
    """Finds what surrounds each robot of an arena; under `vmap`, one kernel computes all arenas.

    Args:
      scene: an arena.
      poses: x (m), y (m) and yaw (rad) of each sensor in the frame of the robot.
      hull_radius: m.
      limit: range of a sensor from its own origin, m.

    Returns:
      [K + 3, R, 2] distances (m), and reflectances of what is at these distances. The first K rows
      are ray lengths; the last three are the gaps to the nearest object of each of `gaps.KINDS`. A
      gap larger than `limit` is returned as any number above `limit`, or infinity.
    """
    return over_arenas(functools.partial(_look, poses, hull_radius, limit), scene)


def _look(
    poses: Sequence[Sequence[float]], hull_radius: float, limit: float, scene: Scene
) -> Array:
    """Finds what surrounds each robot of A arenas; returns [A, K + 3, R, 2] as `look` does."""
    pose, side, obstacle, turn, shades = scene
    (arenas, robots), rows = pose.shape[:2], len(poses) + len(KINDS)
    threads = min(rows, max(1, _THREADS // (arenas * robots)))
    sensor = _with_last(infrared.mounted(Mount(poses, turn), jnp), hull_radius, limit, threads)
    given = sensor, _shades(shades, pose, obstacle), *_cells(pose, hull_radius, limit)
    size, shape = (arenas, threads, robots), {"found": (arenas, rows, robots)}
    call = wp.jax_kernel(_look_around)
    return call(pose, side, obstacle, *given, launch_dims=size, output_dims=shape)[0]


def _with_last(sensor: infrared.Ray, *last: float) -> Array:
    """Returns `WarpLook.sensor` [A or 1, R or 1, K + 1, 4]: all sensors, then the row `last`."""
    rows = jnp.stack(jnp.broadcast_arrays(*sensor), axis=-1)
    rows = rows.reshape(*(1, 1, *rows.shape)[-4:])
    row = np.broadcast_to(np.array([*last, 0.0], np.float32), (*rows.shape[:2], 1, 4))
    return jnp.concatenate([rows, row], axis=2)


def _shades(shades: infrared.Reflectance | None, pose: Array, obstacle: Array) -> Array:
    """Returns the reflectances [A, 1 + M + R] of walls, boxes and robots; [[1]] if all are 1."""
    if shades is None:
        return jnp.ones((1, 1))
    (arenas, robots), boxes = pose.shape[:2], obstacle.shape[1]
    each = zip(shades, (1 + boxes, robots), strict=True)
    rows = [jnp.ones((arenas, n)) if shade is None else shade for shade, n in each]
    return jnp.concatenate(rows, axis=1)


def _cells(pose: Array, hull_radius: float, limit: float) -> tuple[Array, Array]:
    """Puts robots into cells; all robots of a small swarm go into the same single cell."""
    robots = pose.shape[1]
    if robots > dispatch.MOST_COMPARED:
        return cells_warp.chain(pose, _SLACK * (hull_radius + limit) + hull_radius)
    after = np.append(np.arange(1, robots, dtype=np.int32), np.int32(-1))
    return jnp.zeros((1, 1, 1), jnp.int32), jnp.asarray(after[None])


@wp.struct
class WarpLook:
    """What a thread needs to find what surrounds one robot, and where it writes the result.

    Attributes:
      place: x (m), y (m), yaw (rad).
      cos: cosine of the yaw.
      sin: sine of the yaw.
      hull: radius of the hulls, m.
      reach: largest distance from the robot's centre at which a sensor sees a surface, m.
      sensor: [K + 1] the first K rows hold x (m), y (m), cosine and sine of the yaw of each sensor
        in the robot's frame. The last row holds the radius of the hulls (m), the range of the
        sensors (m), the number of threads per robot, and 0.
      rays: K, number of rays.
      found: [K + 3, R] distance to the nearest surface (m), and its reflectance; rows as in `look`.
      robot: index of the robot.
      first: first row of `found` that this thread computes.
      step: distance between the rows that this thread computes.
    """

    place: wp.vec3
    cos: float
    sin: float
    hull: float
    reach: float
    sensor: wp.array[wp.vec4]
    rays: int
    found: wp.array2d[wp.vec2]
    robot: int
    first: int
    step: int


@wp.kernel(enable_backward=False)
def _look_around(
    place: wp.array2d[wp.vec3],
    side: wp.array[float],
    obstacle: wp.array3d[float],
    sensor: wp.array3d[wp.vec4],
    shade: wp.array2d[float],
    first: wp.array3d[int],
    after: wp.array2d[int],
    found: wp.array3d[wp.vec2],
) -> None:
    """Finds the nearest surface for each row of a robot that this thread computes."""
    i, thread, robot = wp.tid()
    look = WarpLook()
    look.place = place[i, robot]
    look.cos = wp.cos(look.place[2])
    look.sin = wp.sin(look.place[2])
    look.sensor = sensor[wp.min(i, sensor.shape[0] - 1), wp.min(robot, sensor.shape[1] - 1)]
    look.rays = sensor.shape[2] - 1
    numbers = look.sensor[look.rays]
    look.hull = numbers[0]
    look.reach = _SLACK * (numbers[0] + numbers[1])
    look.step = int(numbers[2])
    look.found = found[i]
    look.robot = robot
    look.first = thread
    shades, boxes, last = wp.min(i, shade.shape[0] - 1), obstacle.shape[1], shade.shape[1] - 1
    _see_walls(look, 0.5 * side[i], numbers[1], shade[shades, 0])
    for m in range(boxes):
        _see_box(look, obstacle[i, m], shade[shades, wp.min(1 + m, last)])
    chain, links = wp.min(i, first.shape[0] - 1), wp.min(i, after.shape[0] - 1)
    across, width = first.shape[1], look.reach + look.hull
    columns = cells_warp.cells_around(look.place[0], width, width, across)
    rows = cells_warp.cells_around(look.place[1], width, width, across)
    for column in range(columns[0], columns[1]):
        for row in range(rows[0], rows[1]):
            other = wp.int32(first[chain, column & (across - 1), row & (across - 1)])
            while other >= 0:
                if other != robot:
                    mine = wp.min(1 + boxes + other, last)
                    _see_robot(look, place[i, other], shade[shades, mine])
                other = after[links, other]


@wp.func
def _see_walls(look: WarpLook, half: float, limit: float, shade: float) -> None:
    """Sets each row to the distance to the walls of the arena, as `infrared.ray_walls` does."""
    for row in range(look.first, look.found.shape[0], look.step):
        look.found[row, look.robot] = wp.vec2(_MISS, 1.0)
        if row < look.rays:
            look.found[row, look.robot] = wp.vec2(limit, 1.0)
            ray = _ray(look, row)
            across = wp.min(_to_wall(ray[0], ray[2], half), _to_wall(ray[1], ray[3], half))
            if wp.max(wp.abs(ray[0]), wp.abs(ray[1])) >= half:
                across = 0.0
            _see(look, row, across, shade)
        elif row == look.rays + _WALL:
            away = wp.max(wp.abs(look.place[0]), wp.abs(look.place[1]))
            look.found[row, look.robot] = wp.vec2(half - away - look.hull, 1.0)


@wp.func
def _see_robot(look: WarpLook, other: wp.vec3, shade: float) -> None:
    """Updates the thread's rows with the distances to another robot, if it is near enough."""
    x, y = other[0] - look.place[0], other[1] - look.place[1]
    apart = x * x + y * y
    if apart < (look.reach + look.hull) * (look.reach + look.hull):
        for row in range(look.first, look.rays + 1, look.step):
            if row < look.rays:
                _see(look, row, _to_disc(_ray(look, row), other, look.hull), shade)
            else:
                _see(look, row, wp.sqrt(apart) - 2.0 * look.hull, 1.0)


@wp.func
def _see_box(look: WarpLook, obstacle: wp.array[float], shade: float) -> None:
    """Updates the thread's rows with the distances to a box, if it is near enough."""
    x, y = look.place[0] - obstacle[0], look.place[1] - obstacle[1]
    far = look.reach + obstacle[3] + obstacle[4]  # more than the box's half diagonal
    if x * x + y * y < far * far:
        cos, sin = wp.cos(obstacle[2]), wp.sin(obstacle[2])
        box = WarpBox(obstacle[0], obstacle[1], cos, sin, obstacle[3], obstacle[4])
        for row in range(look.first, look.rays + _WALL, look.step):
            if row < look.rays:
                _see(look, row, _to_box(_ray(look, row), box), shade)
            elif row == look.rays + _BOX:
                over_x = wp.abs(cos * x + sin * y) - box.half_x
                over_y = wp.abs(cos * y - sin * x) - box.half_y
                outside = wp.length(wp.vec2(wp.max(over_x, 0.0), wp.max(over_y, 0.0)))
                gap = outside + wp.min(wp.max(over_x, over_y), 0.0) - look.hull
                _see(look, row, gap, 1.0)


@wp.func
def _see(look: WarpLook, row: int, distance: float, shade: float) -> None:
    """Updates a row if a surface is nearer than the row's, or as near and brighter."""
    before = look.found[row, look.robot]
    if distance < before[0]:
        look.found[row, look.robot] = wp.vec2(distance, shade)
    elif distance == before[0]:
        look.found[row, look.robot] = wp.vec2(distance, wp.max(shade, before[1]))


@wp.func
def _ray(look: WarpLook, k: int) -> wp.vec4:
    """Returns a ray in the world frame: x and y of its origin (m), x and y of its direction."""
    at = look.sensor[k]
    x, y = look.cos * at[0] - look.sin * at[1], look.sin * at[0] + look.cos * at[1]
    toward_x = look.cos * at[2] - look.sin * at[3]
    toward_y = look.sin * at[2] + look.cos * at[3]
    return wp.vec4(look.place[0] + x, look.place[1] + y, toward_x, toward_y)


@wp.func
def _to_wall(at: float, toward: float, half: float) -> float:
    """Returns the distance to the wall ahead, as `infrared._to_wall` does."""
    return (half - wp.where(toward < 0.0, -at, at)) / wp.max(wp.abs(toward), 1.0e-9)


@wp.func
def _to_disc(ray: wp.vec4, centre: wp.vec3, radius: float) -> float:
    """Returns the distance to a disc, as in `infrared.ray_disc`."""
    x, y = centre[0] - ray[0], centre[1] - ray[1]
    along = x * ray[2] + y * ray[3]
    power = x * x + y * y - radius * radius
    root = along * along - power
    if power <= 0.0:
        return 0.0
    if root < 0.0 or along <= 0.0:
        return _MISS
    return along - wp.sqrt(root)


@wp.func
def _to_box(ray: wp.vec4, box: WarpBox) -> float:
    """Returns the distance to a rotated rectangle, as in `infrared.ray_box`."""
    away_x, away_y = ray[0] - box.x, ray[1] - box.y
    x, y = box.cos * away_x + box.sin * away_y, box.cos * away_y - box.sin * away_x
    across_x = _cross(x, box.cos * ray[2] + box.sin * ray[3], box.half_x)
    across_y = _cross(y, box.cos * ray[3] - box.sin * ray[2], box.half_y)
    enter, leave = wp.max(across_x[0], across_y[0]), wp.min(across_x[1], across_y[1])
    return wp.where(enter <= leave and leave >= 0.0, wp.max(enter, 0.0), _MISS)


@wp.func
def _cross(at: float, toward: float, half: float) -> wp.vec2:
    """Returns where a ray enters and leaves the slab between two faces (`infrared._cross`)."""
    pace = 1.0 / wp.where(wp.abs(toward) < 1.0e-9, 1.0e-9, toward)
    first, second = (-half - at) * pace, (half - at) * pace
    return wp.vec2(wp.min(first, second), wp.max(first, second))
