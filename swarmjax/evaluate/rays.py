"""The judge's infrared rays: MuJoCo's rays, cast on the real shapes. No JAX."""

from dataclasses import dataclass

import mujoco
import numpy as np

from swarmjax.sim import infrared, neighbours
from swarmjax.sim import model as sim_model
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.geometry import FLOOR_GROUP, HULL_GROUP

# Rays pass through contact spheres, wheels, skids and floor.
_RAY_GROUPS = np.array([i not in (HULL_GROUP, FLOOR_GROUP) for i in range(6)], np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class RayScene:
    """The scene that rays are cast in.

    Attributes:
      model: The compiled arena.
      ids: Rows of the model's moving bodies.
      robot: The robots, with their hulls and sensors.
      side: Side of the smallest arena, m.
      reach: Length of the rays, m.
    """

    model: mujoco.MjModel
    ids: sim_model.Ids
    robot: RobotConfig
    side: float
    reach: float


def cast_rays(
    scene: RayScene,
    data: np.ndarray,
    pose: np.ndarray,
    obstacle: np.ndarray,
    yaw: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Casts the infrared sensors' rays with MuJoCo.

    A ray that starts inside an object reads 0. For such a ray MuJoCo reports where the ray leaves
    the object, at a face whose normal points along the ray. So each sensor casts two rays, ahead
    and back, and is inside an object if either ray leaves one. Pushing robots overlap a little, so
    a single ray may enter a second object before it leaves the first.

    Args:
      scene: The scene.
      data: [A] of `MjData`, positions up to date; each model's boxes have that arena's sizes.
      pose: [A, R, 3] x (m), y (m), yaw (rad).
      obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m).
      yaw: [A, R, K] by how much each sensor is turned from its nominal yaw, rad.

    Returns:
      [A, R, K] distance along the ray to the nearest surface, m, at most `scene.reach`; and the
      geom that the ray meets, -1 if none.
    """
    limit = scene.reach
    origin, direction = infrared.rays(pose, np, infrared.Mount(scene.robot.sensor_poses, yaw))
    near = _near(scene, origin + 0.5 * limit * direction, pose[..., :2], obstacle)
    arena, robot, _ = np.nonzero(near)
    origin, direction = origin[near], direction[near]
    flat = np.zeros((len(origin), 1))
    origin = np.concatenate([origin, flat + scene.robot.sensor_height], axis=-1)
    toward = np.concatenate([direction, flat, -direction, flat], axis=-1)
    distance, normal = np.zeros((len(origin), 2)), np.zeros_like(toward)
    met = np.full((len(origin), 2), -1, np.int32)
    cast_one, far = mujoco.mj_multiRay, mujoco.mjMAXVAL
    body = scene.ids.hull_body[robot].tolist()
    rays = zip(data[arena], body, origin, toward, met, distance, normal, strict=True)
    for where, me, start, ways, geom, reach, face in rays:
        cast_one(where.model, where, start, ways, _RAY_GROUPS, True, me, geom, reach, face, 2, far)
    leaves = (normal * toward).reshape(-1, 2, 3).sum(axis=-1) > 0.0
    ahead = np.where(distance[:, 0] < 0.0, limit, distance[:, 0])  # -1: no hit
    seen, geoms = np.full(near.shape, limit), np.full(near.shape, -1)
    seen[near] = np.where(leaves.any(axis=-1), 0.0, np.minimum(ahead, limit))
    geoms[near] = met[:, 0]
    return seen, geoms


def brightness(scene: RayScene, shades: infrared.Reflectance, geom: np.ndarray) -> np.ndarray:
    """Returns the reflectance of the geoms that rays meet.

    Args:
      scene: The scene.
      shades: Reflectances of walls, obstacles and robots, [A, ...].
      geom: [A, R, K] from `cast_rays`.

    Returns:
      [A, R, K] reflectance; 1 where a ray meets nothing.
    """
    model, table = scene.model, np.ones((len(geom), scene.model.ngeom + 1))  # last column: no hit
    obstacles = scene.ids.obstacle_geom
    if shades.fixture is not None:
        table[:, scene.ids.fixture_geom[len(obstacles) :]] = shades.fixture[:, :1]
        table[:, obstacles] = shades.fixture[:, 1:]
    if shades.robot is not None:
        hulls = [model.geom(f"robot{i}_body").id for i in range(len(scene.ids.hull_body))]
        table[:, hulls] = shades.robot
    return np.take_along_axis(table, geom.reshape(len(geom), -1), axis=1).reshape(geom.shape)


def _near(
    scene: RayScene, middle: np.ndarray, place: np.ndarray, obstacle: np.ndarray
) -> np.ndarray:
    """Finds which rays [A, R, K] may meet an object, by comparing circles around rays and objects.

    Casting rays is the slowest part, and most rays meet nothing. The walls are taken to be those of
    the stage's smallest arena.

    Args:
      scene: The scene.
      middle: [A, R, K, 2] middles of the rays, m.
      place: [A, R, 2] places of the robots, m.
      obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [A, R, K] bool.
    """
    robots = _apart_from_robots(scene, middle, place) - scene.robot.hull_radius
    boxes = _apart(middle, obstacle[..., :2])
    boxes -= np.linalg.norm(obstacle[:, None, None, :, 3:], axis=-1)
    wall = 0.5 * scene.side - np.abs(middle).max(axis=-1)
    things = [robots, boxes, wall[..., None]]
    radius = 0.5 * scene.reach
    return np.concatenate(things, axis=-1).min(axis=-1) <= radius


def _apart_from_robots(scene: RayScene, middle: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Computes distances [A, R, K, N], m, from middles of rays to other robots that may be near."""
    robots, hull = place.shape[-2], scene.robot.hull_radius
    near = [neighbours.look(each, hull, scene.reach, np) for each in place]
    index = [each.index for each in near if each is not None and not each.full]
    if len(index) < len(place) or not index:
        return np.where(np.eye(robots, dtype=bool)[:, None], np.inf, _apart(middle, place))
    listed = np.stack([each[found] for each, found in zip(place, index, strict=True)])
    myself = np.stack(index) == np.arange(robots)[:, None]
    apart = np.linalg.norm(middle[..., None, :] - listed[:, :, None], axis=-1)
    return np.where(myself[:, :, None], np.inf, apart)


def _apart(ray: np.ndarray, thing: np.ndarray) -> np.ndarray:
    """Computes distances [A, R, K, N] from points [A, R, K, 2] to points [A, N, 2], m."""
    offset = ray[..., None, :] - thing[:, None, None]
    return np.sqrt(np.einsum("...i,...i", offset, offset))
