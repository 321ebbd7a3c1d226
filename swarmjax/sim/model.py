"""Builds the MuJoCo model of one arena: robots, obstacles and walls.

Stages differ only in poses and sizes: the arena's side, the obstacles, and which robots and
obstacles are present. Poses and sizes are set at run time, so the model is compiled only once, for
the largest case. This module uses MuJoCo only, no JAX.
"""

import copy
import itertools
from typing import Any, Literal, NamedTuple

import mujoco
import numpy as np

from swarmjax import epuck
from swarmjax.sim.body import Body, Rows, find_rows
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.geometry import SPIN, add_geom, add_ray_hull
from swarmjax.sim.planar import PLANAR
from swarmjax.sim.wheeled import WHEELED

WALL_HALF_THICKNESS = 0.05  # m; a robot sinks at most 4 mm into a wall, so no robot gets through
WALL_HALF_LENGTH = 20.5  # m; longer than half the largest arena (40 m)
HALF_HEIGHT = 0.05  # m; walls and obstacles are 0.1 m high (Webots RectangleArena)
WALLS = 4
BODIES: dict[str, Body] = {"planar": PLANAR, "wheeled": WHEELED}
# Representation of obstacles and walls. MuJoCo C precomputes data for geoms of the world when it
# compiles them (`geom_sameframe`, a bounding hierarchy for rays). In MuJoCo C, obstacles and walls
# are therefore movable bodies. MJX does not use that data, and every body costs time in MJX, so in
# MJX obstacles and walls are geoms of the world. Every actuator also costs time in MJX, so there
# the servos are forces (`Servos.force`).
Fixtures = Literal["mocap", "world"]


class ArenaSize(NamedTuple):
    """Sizes that the model is compiled for.

    Attributes:
      robots: largest number of robots, R.
      obstacles: largest number of obstacles, M.
      largest_half: largest half edge of an obstacle, m; Warp's broadphase always uses this size.
    """

    robots: int
    obstacles: int
    largest_half: float


class Ids(NamedTuple):
    """The rows of the model's arrays that belong to robots, obstacles and walls.

    Attributes:
      fixture_geom: [M + 4] consecutive rows of `geom_size`: first the obstacles, then the east,
        north, west and south wall.
      fixture_mocap: [M + 4] rows of `mocap_pos`, in the order of `fixture_geom`; all are -1 if
        obstacles and walls are geoms of the world.
      obstacle_geom: [M] the first M entries of `fixture_geom`.
      hull_body: [R] rows of the hulls' bodies, for a ray's `bodyexclude`.
      robots: rows that belong to each robot.
    """

    fixture_geom: np.ndarray
    fixture_mocap: np.ndarray
    obstacle_geom: np.ndarray
    hull_body: np.ndarray
    robots: Rows


def build(
    robot: RobotConfig,
    size: ArenaSize,
    timestep: float,
    *,
    ray_geoms: bool = False,
    fixtures: Fixtures = "mocap",
) -> mujoco.MjSpec:
    """Builds the spec of one arena.

    Args:
      robot: settings of the robot.
      size: sizes to compile for.
      timestep: one physics step, s.
      ray_geoms: whether to add the cylinder hulls that MuJoCo's rays see; the sensors of
        `infrared.py` do not need them.
      fixtures: with `mocap`, obstacles and walls are bodies, for MuJoCo C. With `world`, they are
        geoms of the world, for MJX; the engine then sets the poses of these geoms and the servo
        forces at run time.

    Returns:
      The spec, ready to compile. qpos, qvel and ctrl hold the values of one robot after the other,
      in the layout of the robots' body.
    """
    spec = mujoco.MjSpec()
    _set_options(spec, timestep, BODIES[robot.body], rubs=robot.hull_friction > 0.0)
    names = [f"robot{i}" for i in range(size.robots)]
    hulls = [BODIES[robot.body].add(spec, name, robot, timestep) for name in names]
    servos = BODIES[robot.body].servos
    if servos is not None and fixtures == "mocap":
        servos.add(spec, names, robot, timestep)
    for name in names if ray_geoms else ():
        add_ray_hull(spec.body(name), name, robot.hull_radius)
    halves = [size.largest_half] * size.obstacles + [WALL_HALF_LENGTH] * WALLS
    named = zip(_fixture_names(size), halves, strict=True)
    boxes = [_add_box(spec, name, half, fixtures) for name, half in named]
    solid = itertools.product(hulls, boxes)
    for first, second in itertools.chain(itertools.combinations(hulls, 2), solid):
        spec.add_pair(geomname1=first, geomname2=second, **_rubbing(robot.hull_friction))
    return spec


def ids(model: mujoco.MjModel, size: ArenaSize) -> Ids:
    """Looks up by name which rows belong to robots, obstacles and walls."""
    boxes = [model.geom(f"{name}_box").id for name in _fixture_names(size)]
    fixture_geom = np.array(boxes, np.int32)
    return Ids(
        fixture_geom=fixture_geom,
        fixture_mocap=np.array(model.body_mocapid[model.geom_bodyid[fixture_geom]], np.int32),
        obstacle_geom=fixture_geom[: size.obstacles],
        hull_body=np.array([model.body(f"robot{i}").id for i in range(size.robots)], np.int32),
        robots=find_rows(model, size.robots),
    )


def resize_obstacles(model: mujoco.MjModel, ids: Ids, half: np.ndarray) -> mujoco.MjModel:
    """Changes the obstacle sizes of a compiled arena.

    This needs no new compilation: MuJoCo's compiler derives only a box's bounds from its size.

    Args:
      model: made by `build` with `fixtures="mocap"`; it stays unchanged.
      ids: made by `ids`.
      half: [M, 2] half edges, m.

    Returns:
      A model equal to one compiled with these sizes.
    """
    found, geoms = copy.copy(model), ids.obstacle_geom
    size = np.column_stack([half, np.full(len(half), HALF_HEIGHT)])
    found.geom_size[geoms] = size
    found.geom_rbound[geoms] = np.linalg.norm(size, axis=-1)
    found.geom_aabb[geoms, 3:] = size
    return found


def fixture_rectangles(side: Any, obstacle: Any, xp: Any) -> Any:
    """Returns the rectangles of obstacles, and of the walls east, north, west and south.

    Args:
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      xp: `numpy` or `jax.numpy`.

    Returns:
      [M + 4, 5], in the same format as `obstacle`.
    """
    bearing = np.arange(WALLS, dtype=np.float32) * np.float32(np.pi / 2)
    away = 0.5 * side + WALL_HALF_THICKNESS
    middle = xp.stack([away * np.cos(bearing), away * np.sin(bearing)], axis=-1)
    halves = np.full((WALLS, 2), [WALL_HALF_THICKNESS, WALL_HALF_LENGTH], np.float32)
    wall = xp.concatenate([middle, bearing[:, None], halves], axis=-1)
    return xp.concatenate([obstacle, wall])


def fixture_poses(side: Any, obstacle: Any, xp: Any) -> tuple[Any, Any]:
    """Returns the poses of obstacles, and of the walls east, north, west and south.

    Args:
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      xp: `numpy` or `jax.numpy`.

    Returns:
      Positions [M + 4, 3] on the floor (m) and unit quaternions [M + 4, 4] (w, x, y, z).
    """
    rectangle = fixture_rectangles(side, obstacle, xp)
    half_yaw = 0.5 * rectangle[:, 2]
    zero = xp.zeros_like(half_yaw)
    place = xp.concatenate([rectangle[:, :2], zero[:, None]], axis=-1)
    return place, xp.stack([xp.cos(half_yaw), zero, zero, xp.sin(half_yaw)], axis=-1)


def _fixture_names(size: ArenaSize) -> list[str]:
    """Returns the names of obstacles, then walls."""
    return [f"obstacle{i}" for i in range(size.obstacles)] + [f"wall{i}" for i in range(WALLS)]


def _rubbing(friction: float) -> dict[str, Any]:
    """Returns contact options of hulls: condim 1 without friction, condim 3 with friction."""
    if friction == 0.0:
        return {"condim": 1}
    return {"condim": 3, "friction": [friction, friction, *SPIN]}


def _set_options(spec: mujoco.MjSpec, timestep: float, body: Body, *, rubs: bool) -> None:
    """Selects Euler's method, as servos are discrete; disables unused features, which cost time."""
    if rubs:
        spec.option.cone = body.cone
    spec.option.timestep = timestep
    spec.option.gravity = [0.0, 0.0, -epuck.GRAVITY]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    off = mujoco.mjtDisableBit
    # No joint has damping (which has two flags: one for its force, one for its factorisation), a
    # spring, or dry friction.
    spec.option.disableflags |= int(off.mjDSBL_EULERDAMP | off.mjDSBL_DAMPER | off.mjDSBL_SPRING)
    spec.option.disableflags |= int(off.mjDSBL_FRICTIONLOSS)
    if not body.gravity:
        spec.option.disableflags |= int(off.mjDSBL_GRAVITY)


def _add_box(spec: mujoco.MjSpec, name: str, half: float, fixtures: Fixtures) -> str:
    """Adds a box, whose pose is set at run time, and returns the name of its geom."""
    world = spec.worldbody
    body = world.add_body(name=name, mocap=True) if fixtures == "mocap" else world
    thickness = WALL_HALF_THICKNESS if name.startswith("wall") else half
    box, size = mujoco.mjtGeom.mjGEOM_BOX, [thickness, half, HALF_HEIGHT]
    return add_geom(body, f"{name}_box", box, size, [0.0, 0.0, HALF_HEIGHT])
