"""Realistic motors: wheels follow commands inexactly.

The code takes the array module as an argument, since training and JAX-free evaluation share it.
"""

import math
from typing import Any, Literal

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
