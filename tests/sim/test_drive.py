"""Tests the drive and its inverse against a table of the e-puck's wheel speeds."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmjax import epuck
from swarmjax.sim import drive
from swarmjax.sim.config import RobotConfig

EPUCK = drive.from_config(RobotConfig())
PAPER = EPUCK._replace(max_speed=0.25)  # the speed the paper commands, which no e-puck reaches

# Each row holds a command (m/s, rad/s), the left and right wheel speeds before the clamp (rad/s),
# and the robot's motion (m/s, rad/s). The wheel speeds are (v -+ w * 0.026) / 0.02, each then
# clamped to +-6.28. The motion is v = 0.01 * (L + R) and w = 0.02 * (R - L) / 0.052. Wheel speeds
# and turn rates have two decimals, speeds three (four where the third would be rounded twice).
TABLE = [
    ((0.0, 3.14), (-4.08, 4.08), (0.0, 3.14)),
    ((0.0625, 3.14), (-0.96, 7.21), (0.053, 2.78)),
    ((0.125, 0.0), (6.25, 6.25), (0.125, 0.0)),
    ((0.125, 1.57), (4.21, 8.29), (0.105, 0.80)),
    ((0.125, 3.14), (2.17, 10.33), (0.0845, 1.58)),
    ((0.1875, 3.14), (5.29, 13.46), (0.116, 0.38)),
    ((0.1875, 1.57), (7.33, 11.42), (0.1256, 0.0)),
    ((0.25, 3.14), (8.42, 16.58), (0.1256, 0.0)),
]
SPEED = st.floats(0.0, 0.3, allow_subnormal=False)
TURN_RATE = st.floats(-4.0, 4.0, allow_subnormal=False)
WHEEL = st.floats(-epuck.MAX_WHEEL_SPEED, epuck.MAX_WHEEL_SPEED, allow_subnormal=False)
ANY_ACTION = st.floats(-1e6, 1e6, width=32, allow_subnormal=False)


def _roll(wheels: np.ndarray, robot: drive.Drive, xp: Any) -> np.ndarray:
    return drive.body_velocity(wheels, robot.wheel_radius, robot.track, xp)


@pytest.mark.parametrize(("command", "unclipped", "realised"), TABLE)
def test_wheels_and_motion_of_the_table(
    command: tuple[float, float],
    unclipped: tuple[float, float],
    realised: tuple[float, float],
) -> None:
    wheels = drive.wheel_speeds(np.array(command), EPUCK, np)
    expected = np.clip(unclipped, -epuck.MAX_WHEEL_SPEED, epuck.MAX_WHEEL_SPEED)
    np.testing.assert_allclose(wheels, expected, atol=0.005)  # half of the table's last digit
    speed, turn_rate = _roll(wheels, EPUCK, np)
    assert speed == pytest.approx(realised[0], abs=0.0005)  # as above
    assert turn_rate == pytest.approx(realised[1], abs=0.005)  # as above


@pytest.mark.parametrize(("command", "unclipped", "realised"), TABLE)
def test_wheels_without_a_limit(
    command: tuple[float, float], unclipped: tuple[float, float], realised: tuple[float, float]
) -> None:
    free = EPUCK._replace(max_wheel_speed=np.inf)
    wheels = drive.wheel_speeds(np.array(command), free, np)
    np.testing.assert_allclose(wheels, unclipped, atol=0.005)  # half of the table's last digit


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        ((-1.0, -1.0), (0.0, -3.14)),
        ((1.0, 1.0), (0.1256, 3.14)),
        ((0.0, 0.0), (0.0628, 0.0)),
        ((-0.5, 0.25), (0.0314, 0.785)),
        ((7.0, -7.0), (0.1256, -3.14)),
    ],
)
def test_action_spans_the_command(
    action: tuple[float, float], expected: tuple[float, float]
) -> None:
    # 1e-15 m/s and 1e-15 rad/s are the rounding of float64.
    np.testing.assert_allclose(drive.command(np.array(action), EPUCK, np), expected, atol=1e-15)


def test_robot_config_fixes_the_drive() -> None:
    robot = RobotConfig(
        wheel_radius=0.03, track=0.06, max_wheel_speed=5.0, max_speed=0.1, max_turn_rate=2.0
    )
    assert drive.from_config(robot) == (0.03, 0.06, 5.0, 0.1, 2.0)


@given(SPEED, TURN_RATE)
def test_wheels_keep_within_their_limit(speed: float, turn_rate: float) -> None:
    wheels = drive.wheel_speeds(np.array([speed, turn_rate]), EPUCK, np)
    assert np.all(np.abs(wheels) <= epuck.MAX_WHEEL_SPEED)


@given(WHEEL, WHEEL)
def test_body_velocity_is_the_inverse_where_nothing_is_clamped(left: float, right: float) -> None:
    wheels = np.array([left, right])
    command = _roll(wheels, EPUCK, np)
    again = drive.wheel_speeds(command, EPUCK, np)
    # 1e-14 rad/s is a few roundings of float64 at 6.28.
    np.testing.assert_allclose(again, wheels, atol=1e-14)
    # 1e-15 m/s and 1e-14 rad/s are a few roundings of float64 here.
    np.testing.assert_allclose(_roll(again, EPUCK, np), command, atol=1e-14)


@given(ANY_ACTION, ANY_ACTION)
def test_numpy_and_jax_drive_alike(first: float, second: float) -> None:
    action = np.array([[first, second]], np.float32)
    results = []
    for xp in (np, jnp):
        command = drive.command(xp.asarray(action), PAPER, xp)
        wheels = drive.wheel_speeds(command, PAPER, xp)
        results.append([command, wheels, _roll(wheels, PAPER, xp)])
    for expected, found in zip(*results, strict=True):
        # XLA multiplies by a reciprocal and so rounds float32 differently. 2e-6 is 4 ulp at 6.28.
        np.testing.assert_allclose(found, expected, atol=2e-6)
