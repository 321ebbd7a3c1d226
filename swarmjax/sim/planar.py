"""The planar body: three degrees of freedom, and servos instead of wheels on a floor.

The planar body trains five times faster than the wheeled body. Servo forces are limited to what
wheels can pass to the floor. But a servo is deadbeat over 32 ms, and seldom reaches that limit. A
servo reaches its speed in one step, while wheels get two thirds of the way. A blocked servo pushes
with m v / dt = 0.6 N, while blocked wheels push with 1.0 N. A blocked planar robot also turns
freely, while two slipping wheels hardly turn. Policies that push objects therefore perform worse on
the wheeled body (docs/robot.md).
"""

import itertools
import math
from typing import Any, NamedTuple

import mujoco
import numpy as np

from swarmjax import epuck
from swarmjax.sim.body import Body, Changes, Chassis, Rows, Servos, scale_mass
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.drive import body_velocity
from swarmjax.sim.geometry import add_hull

Array = Any
_SERVOS = "forward", "lateral", "turn"
_WRENCH = 0, 1, 5  # axes of the servos in the robot's frame: force along x and y, torque about z


class _Numbers(NamedTuple):
    """Gains and limits of the three servos: [3], or [R, 3] if robots differ.

    Attributes:
      gain: N s/m, N s/m, N m s/rad.
      limit: largest force, N, N, N m.
    """

    gain: Array
    limit: Array


def _add(spec: mujoco.MjSpec, name: str, robot: RobotConfig, timestep: float) -> str:
    """Adds one robot; qpos and qvel are [x, y, yaw] and their rates."""
    body = spec.worldbody.add_body(name=name)
    body.explicitinertial = True
    body.mass = robot.mass
    # The robot never turns about x and y, but MuJoCo requires the triangle inequality of moments.
    body.inertia = [robot.yaw_inertia] * 3
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    body.add_joint(name=f"{name}_x", type=slide, axis=[1, 0, 0])
    body.add_joint(name=f"{name}_y", type=slide, axis=[0, 1, 0])
    body.add_joint(name=f"{name}_yaw", type=hinge, axis=[0, 0, 1])
    return add_hull(body, name, robot.hull_radius)


def _add_servos(spec: mujoco.MjSpec, names: list[str], robot: RobotConfig, timestep: float) -> None:
    """Adds the servos of forward, lateral and turning velocity as actuators."""
    for name in names:
        spec.body(name).add_site(name=f"{name}_axle")
    servos = list(zip(_SERVOS, _WRENCH, *_servos(robot, timestep), strict=True))
    for name, (label, axis, gain, limit) in itertools.product(names, servos):
        actuator = spec.add_actuator(
            name=f"{name}_{label}",
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            target=f"{name}_axle",
            gear=np.eye(6)[axis],
            forcelimited=True,
            forcerange=[-limit, limit],
        )
        actuator.set_to_velocity(gain)


def _servos(robot: RobotConfig, timestep: float) -> _Numbers:
    """Returns the servos of a nominal robot.

    A deadbeat gain, mass / timestep, is multiplied by the share of a change that a first-order lag
    makes in one step. At every step, the velocity then equals that of the lag, for any step length.
    The force limits are those that wheels can pass to the floor (Coulomb): mu m g along either
    axis, and a torque of mu m g times half the track.
    """
    grip = robot.friction * robot.mass * epuck.GRAVITY
    share = servo_share(robot.motor_lag, timestep)
    inertia = np.array([share * robot.mass, robot.mass, share * robot.yaw_inertia])
    return _Numbers(inertia / timestep, grip * np.array([1.0, 1.0, 0.5 * robot.grip_track]))


def _ratios(chassis: Chassis, robot: RobotConfig, xp: Any) -> _Numbers:
    """Returns the factors of a chassis for gains and limits: [R, 3], or 1 where nothing changes.

    A servo stays deadbeat for another mass. The grip depends on mass, friction and track.
    """
    mass = _ratio(chassis.mass, robot.mass)
    # Start in float64, which MuJoCo C uses; the drawn factors are float32.
    grip = np.ones((1, 1)) * mass * _ratio(chassis.friction, robot.friction)
    if chassis.track is None:
        return _Numbers(mass, grip)
    arm = _ratio(chassis.track, robot.grip_track)
    turns = np.array([label == "turn" for label in _SERVOS])
    return _Numbers(mass, grip * xp.where(turns, arm, 1.0))


def _ratio(drawn: Array | None, nominal: float) -> Array:
    """Returns ratios [R, 1] of drawn values [R] to the nominal value; [1, 1] if none are drawn."""
    return np.ones((1, 1)) if drawn is None else drawn[:, None] / nominal


def _force(
    qpos: Array,
    qvel: Array,
    ctrl: Array,
    chassis: Chassis,
    robot: RobotConfig,
    timestep: float,
    xp: Any,
) -> Array:
    """Returns the servos' forces along x and y of the world, and torques about z.

    This replicates the actuators of `_add_servos` (MuJoCo, Computation: actuation model): gain *
    (set point - velocity in the robot's frame), clamped, and rotated to the world by the heading.
    """
    numbers, ratios = _servos(robot, timestep), _ratios(chassis, robot, xp)
    gain, limit = numbers.gain * ratios.gain, numbers.limit * ratios.limit
    yaw = _pose(qpos, xp)[..., 2]
    cos, sin = xp.cos(yaw), xp.sin(yaw)
    velocity = _turn(_each(qvel), cos, -sin, xp)
    force = xp.clip(gain * (_each(ctrl) - velocity), -limit, limit)
    return _flat(_turn(force, cos, sin, xp))


def _turn(vector: Array, cos: Array, sin: Array, xp: Any) -> Array:
    """Rotates x and y of vectors [..., R, 3] by angles [..., R], given as cos and sin."""
    x, y, about = vector[..., 0], vector[..., 1], vector[..., 2]
    return xp.stack([cos * x - sin * y, sin * x + cos * y, about], axis=-1)


def servo_share(lag: float, timestep: float) -> float:
    """Returns the share of a change that a first-order servo makes in one physics step.

    Args:
      lag: time constant, s; with 0, the servo reaches the set point in one step.
      timestep: s.

    Returns:
      1 - exp(-timestep / lag). After n steps, the share is exactly 1 - exp(-n timestep / lag).
    """
    return 1.0 if lag == 0.0 else -math.expm1(-timestep / lag)


def _flat(each: Array) -> Array:
    return each.reshape(*each.shape[:-2], -1)


def _each(flat: Array) -> Array:
    return flat.reshape(*flat.shape[:-1], -1, 3)


def _qpos(pose: Array, xp: Any) -> Array:
    return _flat(pose)


def _pose(qpos: Array, xp: Any) -> Array:
    return _each(qpos)


def _ctrl(wheels: Array, chassis: Chassis, robot: RobotConfig, xp: Any) -> Array:
    """Returns the velocity of a body that rolls on these wheels without slip."""
    radius = robot.wheel_radius if chassis.wheel_radius is None else chassis.wheel_radius
    track = robot.grip_track if chassis.track is None else chassis.track
    velocity = body_velocity(wheels, radius, track, xp)
    forward, turn = velocity[..., 0], velocity[..., 1]
    return _flat(xp.stack([forward, 0.0 * forward, turn], axis=-1))


def _changes(chassis: Chassis, rows: Rows, robot: RobotConfig, model: mujoco.MjModel) -> Changes:
    """Changes mass and inertia, and the servos if they are actuators."""
    changes: Changes = {}
    if chassis.mass is not None:
        changes |= scale_mass(chassis.mass / robot.mass, rows, model)
    acts = rows.actuators
    if acts.size == 0:
        return changes
    gain, limit = _ratios(chassis, robot, np)
    return changes | {
        "actuator_gainprm": ((acts, 0), gain * model.actuator_gainprm[acts, 0]),
        "actuator_biasprm": ((acts, 2), gain * model.actuator_biasprm[acts, 2]),
        "actuator_forcerange": (acts, limit[..., None] * model.actuator_forcerange[acts]),
    }


PLANAR = Body(
    gravity=False,
    # With this cone, a hull's push and its friction are two separate forces, and contacts are as
    # soft as without friction. Planar friction has only two cone edges, so it is exactly Coulomb's.
    cone=mujoco.mjtCone.mjCONE_ELLIPTIC,
    add=_add,
    qpos=_qpos,
    pose=_pose,
    ctrl=_ctrl,
    changes=_changes,
    servos=Servos(add=_add_servos, force=_force),
)
