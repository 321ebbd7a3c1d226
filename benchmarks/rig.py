"""Provides a test rig: one robot in a square arena of MuJoCo's C engine, at given wheel speeds.

The rig measures the robot's motion and the forces of walls on it. It uses the model that training
and the judge share. No code in this file uses the expected results.
"""

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from swarmjax.sim import drive as sim_drive
from swarmjax.sim import model as sim_model
from swarmjax.sim.body import AS_BUILT, Body
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.geometry import FLOOR_GROUP, HULL_GROUP

CONTROL_STEP = 0.032  # s; Webots basicTimeStep
# Physics steps per control step, as in swarmjax.evaluate.
SUBSTEPS = {"planar": 1, "wheeled": 4}
SIDE = 2.0  # m; side of the arena; the walls are far away unless a test needs them
# Geom groups that rays can hit. Rays ignore contact spheres, wheels, skids and the floor.
SEEN = np.array([group not in (HULL_GROUP, FLOOR_GROUP) for group in range(6)], np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """A robot to measure.

    Attributes:
      robot: the robot's settings.
      model: the compiled model.
      control_step: time for which a command holds, s.
      substeps: physics steps per control step.
    """

    robot: RobotConfig
    model: mujoco.MjModel
    control_step: float
    substeps: int

    @property
    def body(self) -> Body:
        """The kind of the robot's body."""
        return sim_model.BODIES[self.robot.body]


class Track(NamedTuple):
    """The motion of a robot: its state before the first control step and after each control step.

    Attributes:
      pose: [T + 1, 3] x (m), y (m), yaw (rad, unwrapped).
      qpos: [T + 1, Q] MuJoCo's generalised positions.
      qvel: [T + 1, V] MuJoCo's generalised velocities.
      force: [T + 1] normal force of the walls on the hull, N, as the mean over the physics steps of
        a control step.
    """

    pose: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    force: np.ndarray


def load(robot: RobotConfig, timestep: float | None = None) -> Rig:
    """Builds a rig.

    Args:
      robot: settings of the robot.
      timestep: physics step, s; a control step is then a single physics step. None: the judge's
        control step and number of physics steps.

    Returns:
      The rig.
    """
    control_step = CONTROL_STEP if timestep is None else timestep
    substeps = SUBSTEPS[robot.body] if timestep is None else 1
    size = sim_model.ArenaSize(robots=1, obstacles=0, largest_half=0.05)
    spec = sim_model.build(robot, size, control_step / substeps, ray_geoms=True)
    return Rig(robot=robot, model=spec.compile(), control_step=control_step, substeps=substeps)


def place(rig: Rig, x: float = 0.0, yaw: float = 0.0) -> mujoco.MjData:
    """Places the robot in the arena, at rest.

    Args:
      rig: the rig.
      x: position, m; y is 0.
      yaw: heading, rad.

    Returns:
      MuJoCo's data of the arena, with up-to-date positions.
    """
    data = mujoco.MjData(rig.model)
    ids = sim_model.ids(rig.model, sim_model.ArenaSize(1, 0, 0.05))
    where, turn = sim_model.fixture_poses(np.float64(SIDE), np.zeros((0, 5)), np)
    data.mocap_pos[ids.fixture_mocap], data.mocap_quat[ids.fixture_mocap] = where, turn
    data.qpos = rig.body.qpos(np.array([[x, 0.0, yaw]]), np)
    mujoco.mj_forward(rig.model, data)
    return data


def run(rig: Rig, data: mujoco.MjData, wheels: np.ndarray, steps: int) -> Track:
    """Turns the wheels at constant speeds, and records the motion.

    Args:
      rig: the rig.
      data: MuJoCo's data of the arena, which is changed.
      wheels: [2] speeds of the left and the right wheel, rad/s.
      steps: number of control steps.

    Returns:
      The robot's motion.
    """
    data.ctrl = rig.body.ctrl(np.asarray(wheels, np.float64)[None], AS_BUILT, rig.robot, np)
    qpos, qvel, force = [data.qpos.copy()], [data.qvel.copy()], [0.0]
    for _ in range(steps):
        pushes = []
        for _ in range(rig.substeps):
            mujoco.mj_step(rig.model, data)
            pushes.append(_push(rig, data))
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        force.append(float(np.mean(pushes)))
    pose = rig.body.pose(np.array(qpos), np)[:, 0]
    pose[:, 2] = np.unwrap(pose[:, 2])
    return Track(pose, np.array(qpos), np.array(qvel), np.array(force))


def command(rig: Rig, speed: float, turn_rate: float) -> np.ndarray:
    """Converts a command (m/s, rad/s) to wheel speeds [2] (rad/s) with the robot's drive."""
    drive = sim_drive.from_config(rig.robot)
    return sim_drive.wheel_speeds(np.array([speed, turn_rate]), drive, np)


def velocity(rig: Rig, track: Track) -> tuple[float, float]:
    """Returns the mean speed along the arcs of a track (m/s) and its mean turn rate (rad/s)."""
    start, end = track.pose[:-1], track.pose[1:]
    half = 0.5 * (end[:, 2] - start[:, 2])
    middle = start[:, 2] + half
    chord = np.sum((end - start)[:, :2] * np.stack([np.cos(middle), np.sin(middle)], -1), -1)
    arc = chord / np.sinc(half / np.pi)
    return float(arc.mean() / rig.control_step), float(2.0 * half.mean() / rig.control_step)


def steady(rig: Rig, speed: float, turn_rate: float, steps: int = 50) -> tuple[float, float]:
    """Returns speed (m/s) and turn rate (rad/s) once a command has held for 10 control steps."""
    data, wheels = place(rig), command(rig, speed, turn_rate)
    run(rig, data, wheels, 10)
    return velocity(rig, run(rig, data, wheels, steps))


def _push(rig: Rig, data: mujoco.MjData) -> float:
    """Returns the sum of the normal forces of the walls on the hull, N."""
    hull, total, force = rig.model.geom("robot0_hull").id, 0.0, np.zeros(6)
    for i, pair in enumerate(data.contact.geom):
        if hull in pair:
            mujoco.mj_contactForce(rig.model, data, i, force)
            total += force[0]
    return total
