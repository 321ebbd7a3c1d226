"""Realistic motors: wheels follow commands inexactly.

The functions take the array module as an argument, since training (JAX) and evaluation without JAX
(NumPy) share them.
"""

import math
from typing import Any, Literal

from swarmjax.sim import noise
from swarmjax.sim.noise import Stream
from swarmjax.sim.realism_config import RealismConfig

Array = Any

# Motor steps in one turn of the wheel: the motor makes 20 steps per turn of its own, and the gear
# is 50:1. Source: the e-puck guide. e-puck 1 and e-puck 2 have the same number.
STEPS_PER_TURN = 1000
_STEPS_PER_RADIAN = STEPS_PER_TURN / (2.0 * math.pi)
# Timer ticks per second. The time between two steps is a whole number of ticks. e-puck 1 has ticks
# of 0.1 ms (`e_motors.c` of e-puck-library). e-puck 2 has ticks of 0.01 ms and uses two for each
# step (`motors.c` of e-puck2_main-processor).
_TICKS = {"epuck1": 10_000, "epuck2": 50_000}


def disturb(wheels: Array, realism: RealismConfig, seed: Array, clock: Array, xp: Any) -> Array:
    """Converts requested wheel speeds to actual ones.

    First the firmware rounds the requested speed. Then the rounded speed is multiplied by 1 + N(0,
    sd), the effect of grip and load, drawn for each wheel and control step. The noise comes last
    because the firmware does not know it, so the result need not be a speed that the firmware can
    set. ARGoS' `epuck_wheels` has the same factor (sd 0.05 in IRIDIA's experiments).

    Args:
      wheels: [..., R, 2] requested speeds of the left and right wheel, rad/s.
      realism: provides `speed_quantisation` and `speed_noise`; constant within a compiled program.
      seed: [...] uint32, seed of the episode.
      clock: [...] or [] control steps since the start of the episode.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., R, 2] actual wheel speeds, rad/s; `wheels` itself if both settings are null.
    """
    if realism.speed_quantisation is not None:
        wheels = quantise(wheels, realism.speed_quantisation, xp)
    if realism.speed_noise is not None:
        drawn = noise.normal(seed, clock, Stream.SPEED_NOISE, wheels.shape[-2:], xp)
        wheels = wheels * (1.0 + realism.speed_noise * drawn)
    return wheels


def quantise(speed: Array, version: Literal["epuck1", "epuck2"], xp: Any) -> Array:
    """Rounds wheel speeds to those that the firmware's timer can make.

    A command is truncated to a whole number of motor steps per second, so below one step per second
    the wheel stands still. The time between two motor steps is truncated to a whole number of
    ticks, which makes the wheel faster. Up to 1000 steps per second, the error is less than 10 % on
    e-puck 1 and less than 2 % on e-puck 2. Sources: `e_motors.c` of e-puck-library, `motors.c` of
    e-puck2_main-processor.

    Args:
      speed: [...] rad/s.
      version: the robot whose firmware rounds.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [...] rad/s, with the same sign and type.
    """
    ticks = _TICKS[version]
    # The shortest time between two steps is one tick. The minimum also keeps the value within an
    # int32.
    steps = xp.minimum(xp.floor(xp.abs(speed) * _STEPS_PER_RADIAN), ticks).astype(xp.int32)
    interval = (ticks // xp.maximum(steps, 1)).astype(speed.dtype)
    made = xp.sign(speed) * (ticks / _STEPS_PER_RADIAN) / interval
    return xp.where(steps > 0, made, 0.0)
