"""Differential drive: converts a policy's action to wheel speeds, and wheel speeds to motion."""

from typing import Any, NamedTuple

from swarmjax.sim.config import RobotConfig

Array = Any

ACTION_SIZE = 2  # U: forward speed and turn rate


class Drive(NamedTuple):
    """Properties of a differential drive.

    Attributes:
      wheel_radius: m.
      track: distance between the wheels, m.
      max_wheel_speed: speed limit of each wheel, rad/s.
      max_speed: upper limit of the commanded forward speed (the lower limit is 0), m/s.
      max_turn_rate: limit of the commanded turn rate in both directions, rad/s.
    """

    wheel_radius: float
    track: float
    max_wheel_speed: float
    max_speed: float
    max_turn_rate: float


def from_config(robot: RobotConfig) -> Drive:
    """Takes the drive's properties from the robot's config."""
    return Drive(*(getattr(robot, name) for name in Drive._fields))


def command(action: Array, drive: Drive, xp: Any) -> Array:
    """Clips an action to -1..1 and scales it to a command.

    Args:
      action: [..., 2] forward speed and turn rate, any real numbers; -1 and 1 are the ends of the
        command's range.
      drive: the drive.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., 2] forward speed (m/s, 0..max_speed) and turn rate (rad/s, within +-max_turn_rate).
    """
    action = xp.clip(action, -1.0, 1.0)
    speed = (action[..., 0] + 1.0) * (0.5 * drive.max_speed)
    return xp.stack([speed, action[..., 1] * drive.max_turn_rate], axis=-1)


def wheel_speeds(command: Array, drive: Drive, xp: Any) -> Array:
    """Computes the wheel speeds of a command, with each wheel clamped to its own limit.

    The robot clamps each wheel separately, so a turn at high speed becomes wider. Above v = 0.2072
    m/s, an e-puck does not turn at all: both wheels are at their limit.

    Args:
      command: [..., 2] forward speed (m/s) and turn rate (rad/s).
      drive: the drive.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., 2] speeds of the left and right wheel, rad/s, within +-max_wheel_speed.
    """
    half_turn = command[..., 1] * (0.5 * drive.track)
    speeds = xp.stack([command[..., 0] - half_turn, command[..., 0] + half_turn], axis=-1)
    return xp.clip(speeds / drive.wheel_radius, -drive.max_wheel_speed, drive.max_wheel_speed)


def body_velocity(wheels: Array, wheel_radius: Array, track: Array, xp: Any) -> Array:
    """Computes the velocity of a body that rolls without slip on wheels with the given speeds.

    Args:
      wheels: [..., 2] left and right wheel speed, rad/s.
      wheel_radius: [] or [..., 2] left and right, m.
      track: [] or [...] distance between the points where the wheels touch the floor, m.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., 2] forward speed (m/s) and turn rate (rad/s).
    """
    rim = wheels * wheel_radius
    left, right = rim[..., 0], rim[..., 1]
    return xp.stack([0.5 * (left + right), (right - left) / track], axis=-1)
