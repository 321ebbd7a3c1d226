"""Tests the planar body's servo forces against MuJoCo C's actuators, in float64."""

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from engines import ROBOTS, STEP

from swarmjax.sim import model, planar
from swarmjax.sim.body import AS_BUILT, Chassis
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.planar import PLANAR

SIZE = model.ArenaSize(1, 0, 0.05)
COUNT = 200  # Random states of each robot.
ROUNDING = 1e-12  # Of the largest force; float64 of gain * set point - gain * velocity.


class State(NamedTuple):
    """Random robots [N, R * 3]: positions, velocities and set points of the joints."""

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray


def _states(wheel_radius: np.ndarray, track: np.ndarray) -> State:
    """Returns random states: half are close to their set point, half are far from it and saturated.

    Checks the set points against v = r (L + R) / 2 and w = r (R - L) / track, with each wheel's own
    radius r.
    """
    random = np.random.default_rng(3)
    pose = random.uniform(-4.0, 4.0, (COUNT, ROBOTS, 3))
    wheels = random.uniform(-6.0, 6.0, (COUNT, ROBOTS, 2))  # rad/s
    left, right = np.moveaxis(wheels * wheel_radius, -1, 0)
    ahead, turn = 0.5 * (left + right), (right - left) / track
    yaw = pose[..., 2]
    rate = np.stack([ahead * np.cos(yaw), ahead * np.sin(yaw), turn], axis=-1)
    far = np.where(np.arange(COUNT) % 2, 3.0, 0.03)[:, None, None]
    rate += far * random.normal(size=rate.shape) * [1.0, 1.0, 20.0]  # m/s, m/s, rad/s
    chassis = Chassis(wheel_radius=wheel_radius, track=track)
    ctrl = PLANAR.ctrl(wheels, chassis, RobotConfig(), np)
    told = ctrl.reshape(COUNT, ROBOTS, 3)
    np.testing.assert_allclose(told, np.stack([ahead, 0.0 * ahead, turn], axis=-1), atol=1e-14)
    return State(pose.reshape(COUNT, -1), rate.reshape(COUNT, -1), ctrl)


def _in_c(built: mujoco.MjModel, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Returns the actuators' forces [N, V] on the joints, and which actuators [N, U] saturate."""
    data, force, full = mujoco.MjData(built), [], []
    for qpos, qvel, ctrl in zip(*state, strict=True):
        data.qpos, data.qvel, data.ctrl = qpos, qvel, ctrl
        mujoco.mj_forward(built, data)
        force.append(data.qfrc_actuator.copy())
        full.append(np.abs(data.actuator_force) == built.actuator_forcerange[:, 1])
    return np.array(force), np.array(full)


def _check(force: np.ndarray, expected: np.ndarray, full: np.ndarray) -> None:
    """Compares forces [N, R * 3], in N and N m, and checks that 20 to 80 % of servos saturate."""
    largest = np.tile(np.abs(expected).reshape(-1, 3).max(axis=0), ROBOTS)
    assert np.all(np.abs(force - expected) <= ROUNDING * largest)
    share = full.reshape(-1, 3).mean(axis=0)
    assert np.all((share > 0.2) & (share < 0.8)), f"saturated: {share}"


@pytest.mark.parametrize("lag", [0.0, 0.1])
@pytest.mark.parametrize("steps", [1, 4])
def test_forces_are_those_of_the_actuators(lag: float, steps: int) -> None:
    robot = RobotConfig(motor_lag=lag)
    spec = model.build(robot, SIZE._replace(robots=ROBOTS), STEP / steps)
    state = _states(np.full((ROBOTS, 2), robot.wheel_radius), np.full(ROBOTS, 0.052))
    expected, full = _in_c(spec.compile(), state)
    assert PLANAR.servos is not None
    force = PLANAR.servos.force(*state, AS_BUILT, robot, STEP / steps, np)
    _check(force, expected, full)


WHEEL_RADIUS = np.array([[0.0198, 0.0201], [0.0203, 0.0199], [0.02, 0.0196]])
TRACK, MASS = np.array([0.052, 0.057, 0.055]), np.array([0.13, 0.16, 0.21])
FRICTION = np.array([0.6, 1.1, 0.8])
DRAWN = Chassis(wheel_radius=WHEEL_RADIUS, track=TRACK, mass=MASS, friction=FRICTION)


def _as_drawn(robot: RobotConfig, i: int) -> RobotConfig:
    """Returns the config of robot i of `DRAWN`, whose yaw inertia grows with its mass."""
    return dataclasses.replace(
        robot,
        mass=float(MASS[i]),
        yaw_inertia=robot.yaw_inertia * float(MASS[i]) / robot.mass,
        friction=float(FRICTION[i]),
        effective_track=float(TRACK[i]),
    )


def test_forces_follow_the_chassis() -> None:
    """Compares the forces with those of each robot compiled alone with its own chassis."""
    robot, state = RobotConfig(motor_lag=0.1), _states(WHEEL_RADIUS, TRACK)
    force, full = [], []
    for i in range(ROBOTS):
        mine = State(*(part[:, 3 * i : 3 * i + 3] for part in state))
        came = _in_c(model.build(_as_drawn(robot, i), SIZE, STEP).compile(), mine)
        force.append(came[0])
        full.append(came[1])
    assert PLANAR.servos is not None
    found = PLANAR.servos.force(*state, DRAWN, robot, STEP, np)
    _check(found, np.concatenate(force, axis=1), np.concatenate(full, axis=1))
    nominal = PLANAR.servos.force(*state, AS_BUILT, robot, STEP, np)
    assert np.abs(found - nominal).max() > 0.1  # N; the chassis matters


def test_actuators_follow_the_chassis() -> None:
    """Compares a model changed after compilation with robots compiled with the same chassis."""
    robot = RobotConfig(motor_lag=0.1)
    size = SIZE._replace(robots=ROBOTS)
    built = model.build(robot, size, STEP).compile()
    for name, (rows, values) in PLANAR.changes(
        DRAWN, model.ids(built, size).robots, robot, built
    ).items():
        getattr(built, name)[rows] = values
    for i in range(ROBOTS):
        alone = model.build(_as_drawn(robot, i), SIZE, STEP).compile()
        for field in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange"):
            found = getattr(built, field)[3 * i : 3 * i + 3]
            np.testing.assert_allclose(found, getattr(alone, field), rtol=ROUNDING, err_msg=field)


def test_a_blocked_robot_turns_with_the_grip_of_its_wheels_times_half_the_track() -> None:
    robot = RobotConfig()
    forward, _, torque = planar._servos(robot, 0.001)[1]
    assert torque == pytest.approx(0.5 * robot.grip_track * forward)
