"""The planar body: three degrees of freedom, and a servo that stands for wheels on a floor.

It trains five times faster than the wheeled one. Its forces are limited by what the wheels could
pass to the floor, but a servo that is deadbeat over 32 ms seldom reaches that: it has its speed in
one step where wheels take two thirds of one, and blocked it pushes with m v / dt = 0.6 N where
wheels push with 1.0 N. It also turns freely while it is blocked, where two slipping wheels hardly
turn: what policies that push things lose on the wheeled body (docs/robot.md).
"""

import math
from typing import Any

import mujoco
import numpy as np

from swarmjax import epuck
from swarmjax.config import RobotConfig
from swarmjax.sim.body import Body, Changes, Chassis, Rows, scale_mass
from swarmjax.sim.drive import body_velocity
from swarmjax.sim.geom import add_hull

Array = Any
_SERVOS = 3  # forward, lateral, turn


def _add(spec: mujoco.MjSpec, name: str, robot: RobotConfig, timestep: float) -> str:
    """Adds one robot; qpos and qvel are [x, y, yaw] and their rates."""
    body = spec.worldbody.add_body(name=name)
    body.explicitinertial = True
    body.mass = robot.mass
    # The first two never turn; MuJoCo asks that no axis exceed the other two together.
    body.inertia = [robot.yaw_inertia] * 3
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    body.add_joint(name=f"{name}_x", type=slide, axis=[1, 0, 0])
    body.add_joint(name=f"{name}_y", type=slide, axis=[0, 1, 0])
    body.add_joint(name=f"{name}_yaw", type=hinge, axis=[0, 0, 1])
    body.add_site(name=f"{name}_axle")
    _add_servos(spec, name, robot, timestep)
    return add_hull(body, name, robot.hull_radius)


def _add_servos(spec: mujoco.MjSpec, name: str, robot: RobotConfig, timestep: float) -> None:
    """Adds the servos of the forward, lateral and turning velocity of a robot.

    Gains are deadbeat, mass / timestep, times the share of the way that a first-order lag goes in
    one step: the velocity is that of the lag at every step, whatever its length. The force limits
    are what the wheels can pass to the floor (Coulomb): mu m g along either axis, and mu m g times
    half the track as a torque.
    """
    grip = robot.friction * robot.mass * epuck.GRAVITY
    share = servo_share(robot.motor_lag, timestep)
    servos = (
        ("forward", 0, share * robot.mass, grip),
        ("lateral", 1, robot.mass, grip),
        ("turn", 5, share * robot.yaw_inertia, grip * 0.5 * robot.effective_track),
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


def servo_share(lag: float, timestep: float) -> float:
    """Share of the way to its set point that a first-order servo goes in one physics step.

    Args:
      lag: time constant, s; 0 reaches the set point in one step.
      timestep: s.

    Returns:
      1 - exp(-timestep / lag), so that n steps go the closed form's 1 - exp(-n timestep / lag).
    """
    return 1.0 if lag == 0.0 else -math.expm1(-timestep / lag)


def _qpos(pose: Array, xp: Any) -> Array:
    return pose.reshape(*pose.shape[:-2], -1)


def _pose(qpos: Array, xp: Any) -> Array:
    return qpos.reshape(*qpos.shape[:-1], -1, 3)


def _ctrl(wheels: Array, chassis: Chassis, robot: RobotConfig, xp: Any) -> Array:
    """Velocity of the body that rolls on these wheels without slip."""
    radius = robot.wheel_radius if chassis.wheel_radius is None else chassis.wheel_radius
    track = robot.effective_track if chassis.track is None else chassis.track
    velocity = body_velocity(wheels, radius, track, xp)
    forward, turn = velocity[..., 0], velocity[..., 1]
    servos = xp.stack([forward, 0.0 * forward, turn], axis=-1)
    return servos.reshape(*servos.shape[:-2], -1)


def _changes(chassis: Chassis, rows: Rows, robot: RobotConfig, model: mujoco.MjModel) -> Changes:
    """The servo stays deadbeat for another mass; the grip follows mass, friction and track."""
    acts = rows.actuators
    changes: Changes = {}
    grip: Array = np.ones((len(acts), 1))
    if chassis.mass is not None:
        ratio = (chassis.mass / robot.mass)[:, None]
        changes = scale_mass(ratio[:, 0], rows, model) | {
            "actuator_gainprm": ((acts, 0), ratio * model.actuator_gainprm[acts, 0]),
            "actuator_biasprm": ((acts, 2), ratio * model.actuator_biasprm[acts, 2]),
        }
        grip = grip * ratio
    if chassis.friction is not None:
        grip = grip * (chassis.friction / robot.friction)[:, None]
    if chassis.track is not None:
        turn = (chassis.track / robot.effective_track)[:, None]
        grip = grip * (turn ** (np.arange(_SERVOS) == _SERVOS - 1))
    if any(part is not None for part in (chassis.mass, chassis.friction, chassis.track)):
        limits = model.actuator_forcerange[acts]
        changes["actuator_forcerange"] = (acts, grip[..., None] * limits)
    return changes


PLANAR = Body(gravity=False, add=_add, qpos=_qpos, pose=_pose, ctrl=_ctrl, changes=_changes)
