"""The wheeled body: a free body in space that stands on two driven wheels and two skids.

The e-puck's motors are stepper motors with a 50:1 gear. A command sets the speed of a wheel, and a
load does not change this speed unless it is so large that the motor loses steps. (Webots gives its
motors 10 N m, which has the same effect.) Here a motor is a velocity servo on a wheel with a large
reflected inertia, and the servo is deadbeat in one physics step. The floor's friction exerts a
torque of at most mu m g r / 2 = 0.016 N m on each wheel. Over 16 ms, this torque changes the
wheel's speed by 0.2 % of the speed limit, and the next step undoes the change. A servo on the
wheel's own inertia alone (1e-6 kg m^2) would not work: with a stable gain, it would lag by several
milliseconds, and the lag would depend on the time step.

Wheels grip the floor through a contact. Within one physics step, this contact removes half the
penetration, and all slip as far as friction allows. MuJoCo's default contact would take 10 to 30 ms
for this, depending on the time step, and wheels would creep meanwhile.
"""

from typing import Any

import mujoco
import numpy as np

from swarmjax import epuck
from swarmjax.sim.body import Body, Changes, Chassis, Rows, scale_mass
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.geometry import FLOOR_GROUP, SPIN, add_geom, add_hull
from swarmjax.sim.planar import servo_share

Array = Any
FLOOR = "floor"
ROTOR_INERTIA = 0.02  # kg m^2, reflected through the gear; chosen as explained above
SKID_RADIUS = 0.005  # m; half the height of the box that carries the Webots e-puck
_QPOS = 9  # x, y, z, quaternion (w, x, y, z), left wheel, right wheel
REST_DEPTH = 1e-5  # m; depth of the wheels in the floor at rest; 9e-6 with steps of 16 ms
_PENETRATION = 0.5  # share of the penetration that one physics step removes
_IMPEDANCE = 0.999  # impedance of the grip, which cancels all but a thousandth of gravity
# m; from the middle of a tyre to the origin of the wheel's frame, half the tyre's width of 5 mm.
# The wheel's geom must not lie at this origin: MuJoCo treats a geom that is compiled at the origin
# of its body's frame as fixed there, so `geom_pos` could not move it.
_TO_INNER_EDGE = 0.0025
_SIDES = np.array([1.0, -1.0], np.float32)  # left, right


def _add(spec: mujoco.MjSpec, name: str, robot: RobotConfig, timestep: float) -> str:
    """Adds one robot; see `_QPOS` for its positions."""
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    _set_inertia(body, robot)
    _add_floor(spec)
    for label, side in (("left", 1.0), ("right", -1.0)):
        _add_wheel(spec, body, f"{name}_{label}", side, robot, timestep)
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    skid_x = epuck.SKID_X * (robot.hull_radius / epuck.HULL_RADIUS)
    for label, x in (("front", skid_x), ("back", -skid_x)):
        place = [x, 0.0, SKID_RADIUS + epuck.SKID_CLEARANCE]
        skid = add_geom(body, f"{name}_{label}", sphere, [SKID_RADIUS, 0, 0], place, FLOOR_GROUP)
        # With condim 1, skids carry weight but do not brake, like the smooth box under the Webots
        # e-puck.
        spec.add_pair(geomname1=FLOOR, geomname2=skid, condim=1, **_grip(timestep))
    return add_hull(body, name, robot.hull_radius)


def _add_floor(spec: mujoco.MjSpec) -> None:
    """Adds the floor, unless an earlier robot has already added it."""
    if spec.geom(FLOOR) is None:
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        add_geom(spec.worldbody, FLOOR, plane, [0, 0, 1], [0, 0, 0], FLOOR_GROUP)


def _set_inertia(body: mujoco.MjsBody, robot: RobotConfig) -> None:
    """Gives the body the mass and inertia of the robot without its wheels."""
    wheel, axle = robot.wheel_mass, 0.5 * robot.track
    yaw = robot.yaw_inertia - 2.0 * (wheel * axle**2 + robot.wheel_inertia[0])
    body.explicitinertial = True
    body.mass = robot.mass - 2.0 * wheel
    body.ipos = [0.0, 0.0, epuck.COM_HEIGHT]
    body.inertia = [yaw / epuck.BODY_INERTIA[2] * part for part in epuck.BODY_INERTIA]


def _add_wheel(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    side: float,
    robot: RobotConfig,
    timestep: float,
) -> None:
    """Adds a wheel, its motor, and its grip on the floor; `side` is 1 for left and -1 for right.

    The wheel's geom is a sphere, centred on the axle above the tyre's contact point. The sphere
    rolls like a wheel of the same radius, and the distance between the contact points of the two
    wheels stays constant.
    """
    inner_edge = _inner_edge(robot)
    wheel = body.add_body(name=name, pos=[0.0, side * inner_edge, robot.wheel_radius])
    wheel.explicitinertial = True
    wheel.mass = robot.wheel_mass
    wheel.ipos = [0.0, side * (0.5 * robot.track - inner_edge), 0.0]
    wheel.inertia = robot.wheel_inertia
    hinge = mujoco.mjtJoint.mjJNT_HINGE
    wheel.add_joint(name=name, type=hinge, axis=[0, 1, 0], armature=ROTOR_INERTIA)
    place = [0.0, side * (0.5 * robot.grip_track - inner_edge), 0.0]
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    add_geom(wheel, name, sphere, [robot.wheel_radius, 0, 0], place, FLOOR_GROUP)
    friction = [robot.friction, robot.friction, *SPIN]
    spec.add_pair(geomname1=FLOOR, geomname2=name, condim=3, friction=friction, **_grip(timestep))
    motor = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
    inertia = ROTOR_INERTIA + robot.wheel_inertia[1]
    motor.set_to_velocity(servo_share(robot.motor_lag, timestep) * inertia / timestep)


def _inner_edge(robot: RobotConfig) -> float:
    """Returns the distance of a wheel's frame from the middle of the robot, m."""
    return 0.5 * robot.track - _TO_INNER_EDGE


def _grip(timestep: float) -> dict[str, list[float]]:
    """Returns a floor contact's stiffness and damping (negative `solref`) per unit of mass."""
    return {
        "solref": [-_PENETRATION / timestep**2, -1.0 / timestep],
        "solimp": [_IMPEDANCE, _IMPEDANCE, 1e-3, 0.5, 2.0],
    }


def _qpos(pose: Array, xp: Any) -> Array:
    x, y, half = pose[..., 0], pose[..., 1], 0.5 * pose[..., 2]
    zero = 0.0 * x
    place = [x, y, zero - REST_DEPTH]
    turn = [xp.cos(half), zero, zero, xp.sin(half)]
    qpos = xp.stack([*place, *turn, zero, zero], axis=-1)
    return qpos.reshape(*qpos.shape[:-2], -1)


def _pose(qpos: Array, xp: Any) -> Array:
    robot = qpos.reshape(*qpos.shape[:-1], -1, _QPOS)
    w, x, y, z = (robot[..., i] for i in range(3, 7))
    yaw = xp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return xp.stack([robot[..., 0], robot[..., 1], yaw], axis=-1)


def _ctrl(wheels: Array, chassis: Chassis, robot: RobotConfig, xp: Any) -> Array:
    return wheels.reshape(*wheels.shape[:-2], -1)


def encoders(qpos: Array, xp: Any) -> Array:
    """Returns the angles that the wheels' encoders report.

    Args:
      qpos: [..., R * 9] joint positions of wheeled robots.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., R, 2] angles of the left and right wheel since the start, rad, rounded down to whole
      steps of 0.00628 rad (Webots E-puck, 1000 steps per turn).
    """
    angle = qpos.reshape(*qpos.shape[:-1], -1, _QPOS)[..., 7:]
    return xp.floor(angle / epuck.ENCODER_STEP) * epuck.ENCODER_STEP


def _changes(chassis: Chassis, rows: Rows, robot: RobotConfig, model: mujoco.MjModel) -> Changes:
    """Returns a chassis' changes. Larger wheels raise the axle; the skids keep their height."""
    changes: Changes = {}
    if chassis.mass is not None:
        changes |= scale_mass(chassis.mass / robot.mass, rows, model)
    if chassis.friction is not None:
        grip = chassis.friction[:, None, None].repeat(2, axis=1).repeat(2, axis=2)
        changes["pair_friction"] = ((rows.grips[..., None], [0, 1]), grip)
    if chassis.wheel_radius is not None:
        changes["geom_size"] = ((rows.wheel_geoms, 0), chassis.wheel_radius)
        changes["body_pos"] = ((rows.wheel_bodies, 2), chassis.wheel_radius)
    if chassis.track is not None:
        beyond = 0.5 * chassis.track[:, None] - _inner_edge(robot)
        changes["geom_pos"] = ((rows.wheel_geoms, 1), beyond * _SIDES)
    return changes


WHEELED = Body(
    gravity=True,
    # The pyramidal cone is MuJoCo's default, and the grip of the wheels was measured with it. All
    # contacts of a model share one kind of cone, and MJX does not support an elliptic cone together
    # with the condim 1 of skids.
    cone=mujoco.mjtCone.mjCONE_PYRAMIDAL,
    add=_add,
    qpos=_qpos,
    pose=_pose,
    ctrl=_ctrl,
    changes=_changes,
)
