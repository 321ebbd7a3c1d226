"""The MuJoCo model of one arena: robots, obstacles and walls, from one builder.

Everything that a stage may change (side, obstacles, who is there) is a pose or a size, set at
run time; the model itself is compiled once for the largest case. MuJoCo only, no JAX.
"""

import itertools
from typing import Any, NamedTuple

import mujoco
import numpy as np

from swarmjax import epuck
from swarmjax.config import RobotConfig

WALL_HALF_THICKNESS = 0.05  # m; a robot sinks 4 mm into a wall at most, so none gets through
WALL_HALF_LENGTH = 2.5  # m; longer than half the largest arena (4 m)
HALF_HEIGHT = 0.05  # m; walls and obstacles are 0.1 m high (Webots RectangleArena)
# Contacts are between a sphere at half the obstacles' height and upright faces, which is exactly
# a disc of the hull's radius in the plane, at one contact point a pair instead of a capsule's two.
CONTACT_HEIGHT = HALF_HEIGHT
WALLS = 4


class ArenaSize(NamedTuple):
    """What the model is compiled for.

    Attributes:
      robots: largest number of robots, R.
      obstacles: largest number of obstacles, M.
      largest_half: largest half edge of an obstacle, m; Warp's broadphase keeps this bound.
    """

    robots: int
    obstacles: int
    largest_half: float


class Ids(NamedTuple):
    """Where things lie in the model's arrays.

    Attributes:
      fixture_mocap: [M + 4] rows of `mocap_pos`: obstacles, then walls east, north, west, south.
      obstacle_geom: [M] rows of `geom_size`.
      hull_body: [R] bodies, for `bodyexclude` of a ray.
    """

    fixture_mocap: np.ndarray
    obstacle_geom: np.ndarray
    hull_body: np.ndarray


def build(
    robot: RobotConfig, size: ArenaSize, timestep: float, *, ray_geoms: bool = False
) -> mujoco.MjSpec:
    """Describes one arena with `planar` robots.

    Args:
      robot: the robot's numbers.
      size: what to compile for.
      timestep: one physics step, s.
      ray_geoms: add the hull as the cylinder that a ray sees; the analytic sensors need none.

    Returns:
      The spec, ready to compile: qpos and qvel are [x, y, yaw] of each robot in turn, ctrl is
      [forward speed, lateral speed, turn rate] of each robot in turn.
    """
    spec = mujoco.MjSpec()
    _set_options(spec, timestep)
    hulls = [_add_robot(spec, i, robot, timestep, ray_geoms) for i in range(size.robots)]
    obstacles = [_add_box(spec, f"obstacle{i}", size.largest_half) for i in range(size.obstacles)]
    walls = [_add_box(spec, f"wall{i}", WALL_HALF_LENGTH) for i in range(WALLS)]
    solid = itertools.product(hulls, obstacles + walls)
    for first, second in itertools.chain(itertools.combinations(hulls, 2), solid):
        # condim 1: the hull's plastic slides along what it touches, as the paper's robots do.
        spec.add_pair(geomname1=first, geomname2=second, condim=1)
    return spec


def ids(model: mujoco.MjModel, size: ArenaSize) -> Ids:
    """Looks the rows of robots, obstacles and walls up by name."""
    obstacles = [model.body(f"obstacle{i}") for i in range(size.obstacles)]
    walls = [model.body(f"wall{i}") for i in range(WALLS)]
    return Ids(
        fixture_mocap=np.array([model.body_mocapid[b.id] for b in obstacles + walls], np.int32),
        obstacle_geom=np.array([model.body_geomadr[b.id] for b in obstacles], np.int32),
        hull_body=np.array([model.body(f"robot{i}").id for i in range(size.robots)], np.int32),
    )


def fixture_poses(side: Any, obstacle: Any, xp: Any) -> tuple[Any, Any]:
    """Places the obstacles, and the walls east, north, west and south of the arena.

    Args:
      side: [] of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      xp: `numpy` or `jax.numpy`.

    Returns:
      Positions [M + 4, 3] (m) and unit quaternions [M + 4, 4] (w, x, y, z).
    """
    bearing = np.arange(WALLS, dtype=np.float32) * np.float32(np.pi / 2)
    away = 0.5 * side + WALL_HALF_THICKNESS
    wall = xp.stack([away * np.cos(bearing), away * np.sin(bearing)], axis=-1)
    flat = xp.concatenate([obstacle[:, :2], wall])
    half_yaw = 0.5 * xp.concatenate([obstacle[:, 2], xp.asarray(bearing)])
    zero = xp.zeros_like(half_yaw)
    place = xp.concatenate([flat, zero[:, None]], axis=-1)
    return place, xp.stack([xp.cos(half_yaw), zero, zero, xp.sin(half_yaw)], axis=-1)


def _set_options(spec: mujoco.MjSpec, timestep: float) -> None:
    """Euler and no gravity: three planar joints carry each robot, the servo is discrete."""
    spec.option.timestep = timestep
    spec.option.gravity = [0.0, 0.0, 0.0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    # Nothing is damped, and MJX pays a factorisation a step for asking.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)


def _add_robot(
    spec: mujoco.MjSpec, index: int, robot: RobotConfig, timestep: float, ray_geoms: bool
) -> str:
    """Adds one robot and returns the name of its contact geom."""
    name = f"robot{index}"
    body = spec.worldbody.add_body(name=name)
    body.explicitinertial = True
    body.mass = robot.mass
    # The first two never turn; MuJoCo asks that no axis exceed the other two together.
    body.inertia = [robot.yaw_inertia] * 3
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    body.add_joint(name=f"{name}_x", type=slide, axis=[1, 0, 0])
    body.add_joint(name=f"{name}_y", type=slide, axis=[0, 1, 0])
    body.add_joint(name=f"{name}_yaw", type=hinge, axis=[0, 0, 1])
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    _add_geom(body, f"{name}_hull", sphere, [robot.hull_radius, 0, 0], CONTACT_HEIGHT, group=3)
    if ray_geoms:
        cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
        half = 0.5 * (epuck.HULL_TOP - epuck.HULL_BOTTOM)
        middle = 0.5 * (epuck.HULL_TOP + epuck.HULL_BOTTOM)
        _add_geom(body, f"{name}_body", cylinder, [robot.hull_radius, half, 0], middle)
    body.add_site(name=f"{name}_axle")
    _add_servos(spec, name, robot, timestep)
    return f"{name}_hull"


def _add_servos(spec: mujoco.MjSpec, name: str, robot: RobotConfig, timestep: float) -> None:
    """Adds the servos of the forward, lateral and turning velocity of a robot.

    Gains are deadbeat: mass / timestep takes the velocity to its set point in one Euler step.
    The force limits are what the wheels can pass to the floor (Coulomb): mu m g along either
    axis, and mu m g times half the track as a torque.
    """
    grip = robot.friction * robot.mass * epuck.GRAVITY
    servos = (
        ("forward", 0, robot.mass, grip),
        ("lateral", 1, robot.mass, grip),
        ("turn", 5, robot.yaw_inertia, grip * 0.5 * robot.track),
    )
    for label, axis, inertia, limit in servos:
        actuator = spec.add_actuator(
            name=f"{name}_{label}",
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            target=f"{name}_axle",
            gear=np.eye(6)[axis],
            forcelimited=True,
            forcerange=[-limit, limit],
        )
        actuator.set_to_velocity(inertia / timestep)


def _add_box(spec: mujoco.MjSpec, name: str, half: float) -> str:
    """Adds a box that is moved by its mocap pose and returns the name of its geom."""
    body = spec.worldbody.add_body(name=name, mocap=True)
    thickness = WALL_HALF_THICKNESS if name.startswith("wall") else half
    box = mujoco.mjtGeom.mjGEOM_BOX
    _add_geom(body, f"{name}_box", box, [thickness, half, HALF_HEIGHT], HALF_HEIGHT)
    return f"{name}_box"


def _add_geom(
    body: mujoco.MjsBody,
    name: str,
    kind: mujoco.mjtGeom,
    size: list[float],
    height: float,
    group: int = 0,
) -> None:
    """Adds a massless geom that touches nothing but through an explicit pair."""
    body.add_geom(
        name=name,
        type=kind,
        size=size,
        pos=[0.0, 0.0, height],
        contype=0,
        conaffinity=0,
        mass=0.0,
        group=group,
    )
