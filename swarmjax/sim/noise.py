"""Counter-based random numbers: each is a hash of its seed, time and purpose; there is no state.

The same seed, clock, stream and index give the same number in NumPy and in JAX. A level with all
its randomness therefore replays exactly. These numbers are not secure: do not use them for secrets.
"""

import enum
import math
from typing import Any

import numpy as np

Array = Any


class Stream(enum.IntEnum):
    """Purpose of a random number; values must never change, so that old levels still replay.

    Numbers of the streams up to `TARGET_COURSE` are drawn once per episode, at clock 0. Numbers of
    the other streams are drawn at each control step.
    """

    WHEEL_RADIUS = 0
    TRACK = 2
    MAX_WHEEL_SPEED = 3
    MASS = 4
    FRICTION = 5
    INFRARED_NOISE = 6
    INFRARED_GAIN = 7
    INFRARED_YAW = 9
    INFRARED_PERIOD = 11
    DEAD_SENSOR = 12
    REFLECTANCE = 14
    REFLECTANCE_ROBOT = 15
    ACTION_LATENCY = 16
    OBSERVATION_LATENCY = 17
    ARENA_SIDE = 18
    LAYOUT = 19
    WAY = 20
    TARGET_COURSE = 21
    INFRARED = 32
    SPEED_NOISE = 33
    TARGET_DISTANCE = 36
    TARGET_BEARING = 37
    ACTION = 38
    NEXT_TARGET = 39


def bits(seed: Array, clock: Array, stream: int, shape: tuple[int, ...], xp: Any) -> Array:
    """Hashes (seed, clock, stream, index) to integers with unbiased bits.

    The four words are combined one after the other. Each word is mixed before it is combined, and
    the result is mixed again. So the numbers of one seed are not the shifted numbers of another
    seed, and swapping seed and clock changes the result. The number at an index does not depend on
    the shape, so adding robots does not change the numbers of the existing robots.

    Args:
      seed: [...] uint32.
      clock: [...] or [] control steps since the start, 0 or more.
      stream: purpose of the numbers, one of `Stream`.
      shape: shape of the numbers for one seed. The index of a number is its place in this array in
        row-major order.
      xp: `numpy` or `jax.numpy`; both give the same numbers.

    Returns:
      [..., *shape] uint32.
    """
    # Use arrays with at least one axis throughout, because NumPy warns about overflow of scalars.
    # If the seed were mixed only once, seed and clock would be interchangeable.
    key = _mix(_mix(xp.asarray(seed, xp.uint32)[..., None]))
    index = np.arange(math.prod(shape), dtype=np.uint32)
    for word in (xp.asarray(clock, xp.uint32)[..., None], np.full(1, stream, np.uint32), index):
        key = _mix(key ^ _mix(word))
    return key.reshape((*key.shape[:-1], *shape))


def uniform(seed: Array, clock: Array, stream: int, shape: tuple[int, ...], xp: Any) -> Array:
    """Draws uniform random numbers, multiples of 2**-24.

    Args:
      seed: [...] uint32.
      clock: [...] or [] control steps since the start, 0 or more.
      stream: purpose of the numbers, one of `Stream`.
      shape: shape of the numbers for one seed.
      xp: `numpy` or `jax.numpy`; both give the same numbers.

    Returns:
      [..., *shape] float32 in [0, 1).
    """
    # A float32 holds 24 bits. With more bits, rounding would make some values equal, or equal to 1.
    whole = bits(seed, clock, stream, shape, xp) >> 8
    return whole.astype(xp.float32) * np.float32(2.0**-24)


def normal(seed: Array, clock: Array, stream: int, shape: tuple[int, ...], xp: Any) -> Array:
    """Draws standard normal numbers; each pair of them is computed from two uniform numbers.

    Method: Box and Muller, "A Note on the Generation of Random Normal Deviates", Annals of
    Mathematical Statistics 29 (1958), pages 610-611, equation 1. The logarithm's argument is at
    least 2**-24, so the magnitude of a result is at most 5.77.

    Args:
      seed: [...] uint32.
      clock: [...] or [] control steps since the start, 0 or more.
      stream: purpose of the numbers, one of `Stream`.
      shape: shape of the numbers for one seed.
      xp: `numpy` or `jax.numpy`; both give the same numbers up to rounding of log and cos.

    Returns:
      [..., *shape] float32.
    """
    count = math.prod(shape)
    drawn = uniform(seed, clock, stream, ((count + 1) // 2, 2), xp)
    radius = xp.sqrt(-2.0 * xp.log(1.0 - drawn[..., 0]))
    angle = drawn[..., 1] * np.float32(2.0 * math.pi)
    pairs = xp.stack([radius * xp.cos(angle), radius * xp.sin(angle)], axis=-1)
    leading = pairs.shape[:-2]
    return pairs.reshape((*leading, -1))[..., :count].reshape((*leading, *shape))


def _mix(word: Array) -> Array:
    """Scrambles uint32 one to one: flipping any input bit flips each output bit half of the time.

    The function is `triple32inc` from Chris Wellons, "Prospecting for Hash Functions" (2018) and
    the tables of github.com/skeeto/hash-prospector. The tables give the function a bias of 0.0208;
    a perfect hash has a measured bias of 0.021.
    """
    word = word + np.uint32(1)
    word = (word ^ (word >> 17)) * np.uint32(0xED5AD4BB)
    word = (word ^ (word >> 11)) * np.uint32(0xAC4C1B51)
    word = (word ^ (word >> 15)) * np.uint32(0x31848BAB)
    return word ^ (word >> 14)
