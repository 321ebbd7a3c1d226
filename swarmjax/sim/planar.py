"""The planar body: three degrees of freedom, moved by servos instead of wheels on a floor.

The planar body trains five times faster than the wheeled body. Servo forces are limited to the
friction that wheels can pass to the floor. But a servo is deadbeat over one step of 32 ms, and
seldom reaches that limit. The two bodies therefore differ in three ways. The planar body reaches
its set speed in one step, while the wheeled body gets two thirds of the way. A blocked planar body
pushes with m v / dt = 0.6 N, while a blocked wheeled body pushes with 1.0 N. A blocked planar body
also turns freely, while a blocked body on two slipping wheels hardly turns. Policies that push
objects, if trained on the planar body, therefore perform worse on the wheeled body (docs/robot.md).
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
      gain: gains of the forward, lateral and turn servo: N s/m, N s/m, N m s/rad.
      limit: largest forces of the forward and lateral servo, N, and largest torque of the turn
        servo, N m.
    """

    gain: Array
    limit: Array


def _add(spec: mujoco.MjSpec, name: str, robot: RobotConfig, timestep: float) -> str:
    """Adds one robot; qpos and qvel are [x, y, yaw] and their rates."""
    body = spec.worldbody.add_body(name=name)
    body.explicitinertial = True
    body.mass = robot.mass
    # The robot never turns about x and y, but MuJoCo requires three moments of inertia that fulfil
    # the triangle inequality.
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

    The gain is that of a deadbeat servo, mass / timestep (for turns, inertia / timestep),
    multiplied by `servo_share`. At every step, the velocity then equals that of a first-order lag,
    for any step length. The lateral servo has no lag. The limits are the Coulomb friction that
    wheels can pass to the floor: mu m g along either axis, and a torque of mu m g times half the
    track.
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
    # Start with float64 numbers, which MuJoCo C uses; the values of a chassis are float32.
    grip = np.ones((1, 1)) * mass * _ratio(chassis.friction, robot.friction)
    if chassis.track is None:
        return _Numbers(mass, grip)
    arm = _ratio(chassis.track, robot.grip_track)
    turns = np.array([label == "turn" for label in _SERVOS])
    return _Numbers(mass, grip * xp.where(turns, arm, 1.0))


def _ratio(drawn: Array | None, nominal: float) -> Array:
    """Returns the ratios [R, 1] of a chassis' values [R] to the nominal value; [[1]] for None."""
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

    The forces equal those of the actuators of `_add_servos` (MuJoCo, Computation: actuation model):
    gain * (set point - velocity in the robot's frame), clamped, and rotated from the robot's frame
    to the world frame.
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
    """Returns the share of a change of its set point that a servo follows in one physics step.

    Args:
      lag: time constant of the servo's first-order lag, s; with 0, the servo reaches the set point
        in one step.
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
    """Returns set points: the velocity of a body that rolls without slip at these wheel speeds."""
    radius = robot.wheel_radius if chassis.wheel_radius is None else chassis.wheel_radius
    track = robot.grip_track if chassis.track is None else chassis.track
    velocity = body_velocity(wheels, radius, track, xp)
    forward, turn = velocity[..., 0], velocity[..., 1]
    return _flat(xp.stack([forward, 0.0 * forward, turn], axis=-1))


def _changes(chassis: Chassis, rows: Rows, robot: RobotConfig, model: mujoco.MjModel) -> Changes:
    """Returns changes of mass and inertia, and changes of the servos if they are actuators."""
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
    # With this cone, a hull's push and its friction are two separate forces, and a contact is as
    # soft as a contact without friction. In the plane, friction acts along one line only, so the
    # cone has two edges, and the friction is exactly Coulomb's.
    cone=mujoco.mjtCone.mjCONE_ELLIPTIC,
    add=_add,
    qpos=_qpos,
    pose=_pose,
    ctrl=_ctrl,
    changes=_changes,
    servos=Servos(add=_add_servos, force=_force),
)
