"""From a command to the wheels of a real robot: it comes late or not at all, and inexactly.

Code takes the array module, as all that training and the judge without JAX share.
"""

import math
from typing import Any, Literal, NamedTuple

from swarmjax.sim import noise
from swarmjax.sim.noise import Stream
from swarmjax.sim.realism_config import RealismConfig

Array = Any

# Steps of the motor in one turn of the wheel: 20 in a turn of the motor, geared down by 50; the
# guide of the e-puck, and the same for both versions.
STEPS_PER_TURN = 1000
_STEPS_PER_RADIAN = STEPS_PER_TURN / (2.0 * math.pi)
# Ticks of the timer in a second; between two steps lies a whole number of them. e-puck 1: 0.1 ms,
# `e_motors.c` of e-puck-library. e-puck 2: 0.01 ms and two to each step, `motors.c` of
# e-puck2_main-processor.
_TICKS = {"epuck1": 10_000, "epuck2": 50_000}


class Motor(NamedTuple):
    """Commands on their way to the wheels; what no factor needs is None.

    Attributes:
      queue: [..., D, R, 2] the last commands sent, newest first; D is the largest latency.
      held: [..., R] control steps of a stall that are left, int32.
      applied: [..., R, 2] the command that the wheels had last.
    """

    queue: Array | None
    held: Array | None
    applied: Array | None


def init(realism: RealismConfig, robots: int, xp: Any) -> Motor | None:
    """Starts an episode: all commands so far were zero, the robots at rest.

    Args:
      realism: says which parts there are.
      robots: R.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The state of one arena, or None where commands come at once and always.
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
    """Sends a command off, and returns the one that reaches the wheels in this control step.

    A late command arrives whole control steps later. While the link stalls, the wheels keep the
    last command that arrived, as stepper motors do. After it they follow the newest one that is
    due by then; those before it are lost. On a real robot a packet's header took 9.3 ms in the
    mean and 1.95 s at worst (620 of them over WiFi, log of UNIFR_API_EPUCK).

    Args:
      motor: as of the last control step, with the leading axes of `command`.
      command: [..., R, 2] sent now, of any unit.
      latency: [..., R] control steps, 0 to the largest of `realism`, int32; None is 0.
      realism: for the stalls' probability and length; fixes the program.
      seed: [...] uint32 of the episode.
      clock: [...] or [] control steps since the start.
      control_step: s.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The new state, and [..., R, 2] the command that the wheels follow now.
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
    """Lets stalls begin where none runs; returns the control steps left with this one, [..., R]."""
    robots = held.shape[-1:]
    begins = noise.uniform(seed, clock, Stream.STALL, robots, xp) < realism.stall
    # In control steps first, so that a fixed length rounds the same in NumPy and JAX.
    low, high = (seconds / control_step for seconds in realism.stall_time)
    share = noise.uniform(seed, clock, Stream.STALL_TIME, robots, xp)
    length = xp.round(low + share * (high - low)).astype(xp.int32)
    return xp.where((held == 0) & begins, length, held)


def disturb(wheels: Array, realism: RealismConfig, seed: Array, clock: Array, xp: Any) -> Array:
    """Turns the wheel speeds that are asked for into those that the floor sees.

    The firmware rounds first, because all that it knows is the command. What grip and load do to
    the wheel comes on top and need not be a speed that the timer can make: a factor 1 + N(0, sd),
    fresh for each wheel and control step, as in ARGoS' `epuck_wheels` (sd 0.05 in IRIDIA's
    experiments).

    Args:
      wheels: [..., R, 2] left and right wheel speed, rad/s.
      realism: `speed_quantisation` and `speed_noise`; fixes the program.
      seed: [...] uint32 of the episode.
      clock: [...] or [] control steps since the start.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., R, 2] rad/s; the argument itself where both factors are off.
    """
    if realism.speed_quantisation is not None:
        wheels = quantise(wheels, realism.speed_quantisation, xp)
    if realism.speed_noise is not None:
        drawn = noise.normal(seed, clock, Stream.SPEED_NOISE, wheels.shape[-2:], xp)
        wheels = wheels * (1.0 + realism.speed_noise * drawn)
    return wheels


def quantise(speed: Array, version: Literal["epuck1", "epuck2"], xp: Any) -> Array:
    """Rounds wheel speeds to those that the firmware's timer can make.

    A command is a whole number of steps per second, its fraction cut off, so that below one step
    per second nothing moves. The time between steps is a whole number of ticks, cut off again,
    which makes the wheel faster: up to 1000 steps per second by less than 10 % on version 1 and
    2 % on version 2. `e_motors.c` of e-puck-library, `motors.c` of e-puck2_main-processor.

    Args:
      speed: [...] rad/s.
      version: whose firmware.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] rad/s, of the same sign and type.
    """
    ticks = _TICKS[version]
    # One tick between steps is the least; cutting off there also keeps to what an int32 holds.
    steps = xp.minimum(xp.floor(xp.abs(speed) * _STEPS_PER_RADIAN), ticks).astype(xp.int32)
    interval = (ticks // xp.maximum(steps, 1)).astype(speed.dtype)
    made = xp.sign(speed) * (ticks / _STEPS_PER_RADIAN) / interval
    return xp.where(steps > 0, made, 0.0)
