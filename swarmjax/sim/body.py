"""Interface of a robot body: every body takes the same commands and returns the same poses.

A body converts the speeds of its two wheels to controls, and its joint positions to x, y and yaw.
There are two bodies, `planar.py` and `wheeled.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np

from swarmjax.sim.config import RobotConfig

Array = Any
Changes = dict[str, tuple[Any, Array]]  # by name of a changed field of the model: rows, new values


class Chassis(NamedTuple):
    """Properties of the robots' chassis in an episode; None keeps the config's value.

    Attributes:
      wheel_radius: [R, 2] radii of the left and right wheel, m, or None.
      track: [R] distance between the points where the wheels grip the floor, m, or None.
      mass: [R] mass of the whole robot, kg, or None.
      friction: [R] friction between wheels and floor, or None.
    """

    wheel_radius: Array | None = None
    track: Array | None = None
    mass: Array | None = None
    friction: Array | None = None


AS_BUILT = Chassis()


class Rows(NamedTuple):
    """The rows of the model's arrays that belong to each robot.

    Attributes:
      bodies: [R, B] rows of the bodies; the hull comes first.
      dofs: [R, D] rows of the degrees of freedom.
      actuators: [R, U] rows of the actuators; [R, 0] for a model without actuators, where servos
        are forces on joints.
      wheel_geoms: [R, 2] rows of the geoms of the left and right wheel; [R, 0] for a body without
        wheels.
      wheel_bodies: [R, 2] rows of the bodies of the left and right wheel; [R, 0] for a body without
        wheels.
      grips: [R, 2] rows of the contact pairs of left wheel and floor, and of right wheel and floor;
        [R, 0] for a body without wheels.
    """

    bodies: np.ndarray
    dofs: np.ndarray
    actuators: np.ndarray
    wheel_geoms: np.ndarray
    wheel_bodies: np.ndarray
    grips: np.ndarray


class Servos(NamedTuple):
    """Servos in two forms: actuators for MuJoCo C, and joint forces for MJX (faster there).

    Attributes:
      add: adds actuators to a spec, for the robots with the given names. The last argument is the
        physics step (s).
      force: returns the servo forces on the joints at the beginning of a physics step, [..., R * V]
        N or N m. Takes qpos [..., R * Q], qvel [..., R * V], ctrl [..., R * U], a chassis, the
        settings of the robot, the physics step (s) and the array module.
    """

    add: Callable[[mujoco.MjSpec, list[str], RobotConfig, float], None]
    force: Callable[[Array, Array, Array, Chassis, RobotConfig, float, Any], Array]


@dataclass(frozen=True, kw_only=True)
class Body:
    """The functions of one kind of body.

    Attributes:
      gravity: whether gravity acts along any of the body's joints.
      cone: friction cone of the body's contacts.
      add: adds a robot with the given name to a spec, and returns the name of the geom that makes
        contact. The last argument is the physics step (s).
      qpos: returns the joint positions [..., R * Q] of robots at rest at the poses [..., R, 3]: x
        (m), y (m), yaw (rad).
      pose: returns the poses [..., R, 3] of robots with joint positions [..., R * Q]; the inverse
        of `qpos`.
      ctrl: returns the controls [..., R * U] that make the wheels of a chassis turn at the speeds
        [..., R, 2] (rad/s).
      changes: returns the changes that a chassis makes to the compiled model, which is the last
        argument.
      servos: the servos that follow `ctrl`, for a body whose `add` does not add them; None if `add`
        adds the servos.
    """

    gravity: bool
    cone: mujoco.mjtCone
    add: Callable[[mujoco.MjSpec, str, RobotConfig, float], str]
    qpos: Callable[[Array, Any], Array]
    pose: Callable[[Array, Any], Array]
    ctrl: Callable[[Array, Chassis, RobotConfig, Any], Array]
    changes: Callable[[Chassis, Rows, RobotConfig, mujoco.MjModel], Changes]
    servos: Servos | None = None


def find_rows(model: mujoco.MjModel, robots: int) -> Rows:
    """Looks up by name which rows of the model's arrays belong to each robot.

    Args:
      model: compiled.
      robots: R.

    Returns:
      The rows.
    """
    hulls = np.array([model.body(f"robot{i}").id for i in range(robots)], np.int32)
    bodies = [np.flatnonzero(model.body_rootid == hull) for hull in hulls]
    dofs = [np.flatnonzero(np.isin(model.dof_bodyid, mine)) for mine in bodies]
    acts = [np.arange(model.nu).reshape(robots, -1)[i] for i in range(robots)]
    wheels = [[f"robot{i}_{side}" for side in ("left", "right")] for i in range(robots)]
    has_wheels = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, wheels[0][0]) >= 0
    geoms = [[model.geom(name).id for name in pair if has_wheels] for pair in wheels]
    return Rows(
        bodies=np.array(bodies, np.int32),
        dofs=np.array(dofs, np.int32),
        actuators=np.array(acts, np.int32),
        wheel_geoms=np.array(geoms, np.int32),
        wheel_bodies=np.array(model.geom_bodyid)[np.array(geoms, np.int32)],
        grips=np.array([[_pair(model, geom) for geom in pair] for pair in geoms], np.int32),
    )


def scale_mass(ratio: Array, rows: Rows, model: mujoco.MjModel) -> Changes:
    """Changes a robot's mass, and its inertia in proportion.

    Args:
      ratio: [R] ratio of the new mass to the compiled mass.
      rows: rows of the robots.
      model: compiled.

    Returns:
      The changed rows of the bodies and degrees of freedom. They include MuJoCo's inverse weights,
      which set how soft contacts are and which MJX does not recompute. The inverse weights are
      divided by `ratio`. The division is exact except for the part of the weights that stems from
      the wheel motors.
    """
    bodies, dofs = rows.bodies, rows.dofs
    return {
        "body_mass": (bodies, ratio[:, None] * model.body_mass[bodies]),
        "body_subtreemass": (bodies, ratio[:, None] * model.body_subtreemass[bodies]),
        "body_inertia": (bodies, ratio[:, None, None] * model.body_inertia[bodies]),
        "body_invweight0": (bodies, model.body_invweight0[bodies] / ratio[:, None, None]),
        "dof_invweight0": (dofs, model.dof_invweight0[dofs] / ratio[:, None]),
    }


def _pair(model: mujoco.MjModel, geom: int) -> int:
    """Returns the row of the only contact pair that contains a wheel's geom."""
    return int(np.flatnonzero((model.pair_geom1 == geom) | (model.pair_geom2 == geom))[0])
