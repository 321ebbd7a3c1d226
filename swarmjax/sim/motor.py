"""Realistic motors: commands arrive late or get lost, and wheels follow them inexactly.

The code takes the array module as an argument, since training and JAX-free evaluation share it.
"""

import math
from typing import Any, Literal, NamedTuple

from swarmjax.sim import noise
from swarmjax.sim.noise import Stream
from swarmjax.sim.realism_config import RealismConfig

Array = Any

# Motor steps in one turn of the wheel: the motor makes 20 steps per turn, and the gear is 50:1.
# Source: the e-puck guide; both versions have the same number.
STEPS_PER_TURN = 1000
_STEPS_PER_RADIAN = STEPS_PER_TURN / (2.0 * math.pi)
# Timer ticks per second. The time between two steps is a whole number of ticks. e-puck 1: ticks of
# 0.1 ms, `e_motors.c` of e-puck-library. e-puck 2: ticks of 0.01 ms, two for each step, `motors.c`
# of e-puck2_main-processor.
_TICKS = {"epuck1": 10_000, "epuck2": 50_000}


class Motor(NamedTuple):
    """Commands on their way to the wheels; fields that no factor uses are None.

    Attributes:
      queue: [..., D, R, 2] the last commands sent, newest first; D is the largest latency.
      held: [..., R] remaining control steps of a stall, int32.
      applied: [..., R, 2] the command that the wheels followed last.
    """

    queue: Array | None
    held: Array | None
    applied: Array | None


def init(realism: RealismConfig, robots: int, xp: Any) -> Motor | None:
    """Starts an episode: all previous commands are zero, and the robots are at rest.

    Args:
      realism: determines which fields are used.
      robots: R.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The state of one arena; None if commands always arrive at once.
    """
    depth = 0 if realism.action_latency is None else realism.action_latency[1]
    stalls = realism.stall is not None
    if not depth and not stalls:
        return None
    return Motor(
        queue=xp.zeros((depth, robots, 2), xp.float32) if depth else None,
        held=xp.zeros(robots, xp.int32) if stalls else None,
        applied=xp.zeros((robots, 2), xp.float32) if stalls else None,
    )


def deliver(
    motor: Motor | None,
    command: Array,
    latency: Array | None,
    realism: RealismConfig,
    seed: Array,
    clock: Array,
    control_step: float,
    xp: Any,
) -> tuple[Motor | None, Array]:
    """Sends a command, and returns the one that reaches the wheels in this control step.

    A late command arrives a whole number of control steps later. While the link stalls, the wheels
    keep the last command that arrived, as stepper motors do. After the stall they follow the newest
    command that is due; older ones are lost. On a real robot, the header of a packet took 9.3 ms on
    average and at most 1.95 s (620 packets over WiFi, log of UNIFR_API_EPUCK).

    Args:
      motor: state of the last control step, with the leading axes of `command`.
      command: [..., R, 2] the command sent now, in any unit.
      latency: [..., R] control steps, 0 to the largest latency of `realism`, int32; None means 0.
      realism: provides probability and length of stalls; fixed for a program.
      seed: [...] uint32 of the episode.
      clock: [...] or [] control steps since the start.
      control_step: s.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The new state, and the command [..., R, 2] that the wheels follow now.
    """
    if motor is None:
        return None, command
    queue, held, applied = motor
    if queue is not None and latency is not None:
        sent = xp.concatenate([command[..., None, :, :], queue], axis=-3)
        command = xp.take_along_axis(sent, latency[..., None, :, None], axis=-3)[..., 0, :, :]
        queue = sent[..., :-1, :, :]
    if held is not None and applied is not None:
        held = _stall(held, realism, seed, clock, control_step, xp)
        command = xp.where(held[..., None] > 0, applied, command)
        held, applied = xp.maximum(held - 1, 0), command
    return Motor(queue, held, applied), command


def _stall(
    held: Array, realism: RealismConfig, seed: Array, clock: Array, control_step: float, xp: Any
) -> Array:
    """Starts stalls; returns the number [..., R] of stalled steps left, including this one."""
    robots = held.shape[-1:]
    begins = noise.uniform(seed, clock, Stream.STALL, robots, xp) < realism.stall
    # Convert to control steps first, so that a fixed length rounds the same in NumPy and JAX.
    low, high = (seconds / control_step for seconds in realism.stall_time)
    share = noise.uniform(seed, clock, Stream.STALL_TIME, robots, xp)
    length = xp.round(low + share * (high - low)).astype(xp.int32)
    return xp.where((held == 0) & begins, length, held)


def disturb(wheels: Array, realism: RealismConfig, seed: Array, clock: Array, xp: Any) -> Array:
    """Converts requested wheel speeds to actual ones.

    First the firmware rounds the speed, since it knows only the command. Then grip and load change
    it by a factor 1 + N(0, sd), drawn for each wheel and control step. The result need not be a
    speed that the timer can make. ARGoS' `epuck_wheels` has the same factor (sd 0.05 in IRIDIA's
    experiments).

    Args:
      wheels: [..., R, 2] left and right wheel speed, rad/s.
      realism: provides `speed_quantisation` and `speed_noise`; fixed for a program.
      seed: [...] uint32 of the episode.
      clock: [...] or [] control steps since the start.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., R, 2] rad/s; the argument itself if both factors are off.
    """
    if realism.speed_quantisation is not None:
        wheels = quantise(wheels, realism.speed_quantisation, xp)
    if realism.speed_noise is not None:
        drawn = noise.normal(seed, clock, Stream.SPEED_NOISE, wheels.shape[-2:], xp)
        wheels = wheels * (1.0 + realism.speed_noise * drawn)
    return wheels


def quantise(speed: Array, version: Literal["epuck1", "epuck2"], xp: Any) -> Array:
    """Rounds wheel speeds to those that the firmware's timer can make.

    A command is truncated to a whole number of steps per second, so below one step per second
    nothing moves. The time between two motor steps is truncated to a whole number of ticks, which
    makes the wheel faster. Up to 1000 steps per second, the error is less than 10 % on version 1
    and 2 % on version 2. Sources: `e_motors.c` of e-puck-library, `motors.c` of
    e-puck2_main-processor.

    Args:
      speed: [...] rad/s.
      version: version of the firmware.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] rad/s, with the same sign and type.
    """
    ticks = _TICKS[version]
    # The least time between steps is one tick. This limit also keeps the value within an int32.
    steps = xp.minimum(xp.floor(xp.abs(speed) * _STEPS_PER_RADIAN), ticks).astype(xp.int32)
    interval = (ticks // xp.maximum(steps, 1)).astype(speed.dtype)
    made = xp.sign(speed) * (ticks / _STEPS_PER_RADIAN) / interval
    return xp.where(steps > 0, made, 0.0)
