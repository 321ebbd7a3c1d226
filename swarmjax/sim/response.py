"""What an infrared sensor reports: from the ray that it casts to counts, and back.

A ray is the horizontal distance from the sensor's origin to the nearest thing, in metres; the
real one rises by `epuck.SENSOR_TILT`, so against an upright face it is longer by 1 / cos(tilt).

`webots` is the lookup table of Webots' E-puck: (length of the ray) / reflectance -> counts, with
multiplicative noise; free space reads 67.19. `real` is a curve fitted to a measured robot, each
sensor its own: reflectance * A / (gap + d)^2 counts above free space, with additive noise, and
free space zeroed as the firmware does. NumPy or JAX.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from swarmjax import epuck

Array = Any
Response = Literal["webots", "real"]

_RISE = math.cos(epuck.SENSOR_TILT)
_LENGTH, _COUNTS, _SHARE = zip(*epuck.INFRARED_TABLE, strict=True)
# m; further away nothing is seen, so rays need not be cast any further. Webots' table ends there,
# for things of reflectance 1 at most. The measured curve would still read 13 to 22 counts; the
# longest that any simulator of the e-puck lets its sensors see is 0.10 to 0.12 m (ARGoS, Enki).
REACH = {"webots": _LENGTH[-1] * _RISE, "real": 0.10}
_STRENGTH, _DEPTH, _FREE, _SD, _SATURATION = np.array(epuck.INFRARED_FIT, np.float32).T
_SPAN = _SATURATION - _FREE


def _distance_to_hull() -> np.ndarray:
    """Returns [K] m from the origins of the sensors along their rays to the hull's surface."""
    x, y, yaw = np.array(epuck.SENSOR_POSES).T
    outward = x * np.cos(yaw) + y * np.sin(yaw)
    spare = epuck.HULL_RADIUS**2 - x**2 - y**2
    return (np.sqrt(outward**2 + spare) - outward).astype(np.float32)


TO_HULL = _distance_to_hull()


class Wear(NamedTuple):
    """How each sensor differs from a nominal one, [..., R, K] each; None where it does not.

    Attributes:
      noise: times the response's own noise; None is no noise at all.
      gain: times what a reflection adds to the reading of free space.
      offset: counts that the reading is always off by.
      dead: bool, whether the sensor never sees anything.
    """

    noise: Array | None = None
    gain: Array | None = None
    offset: Array | None = None
    dead: Array | None = None


def read(
    response: Response,
    ray: Array,
    reflectance: Array | None,
    wear: Wear,
    normal: Array | None,
    xp: Any,
) -> Array:
    """Reads the sensors.

    Args:
      response: of which robot.
      ray: [..., R, K] horizontal distance from the sensor's origin to the nearest thing, m.
      reflectance: [..., R, K] of that thing, above 0 and at most 1; None is 1.
      wear: of the sensors.
      normal: [..., R, K] standard normal, fresh for each sample; None is no noise.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., R, K] counts, not clamped: noise takes a `real` reading below 0.
    """
    if wear.dead is not None:
        ray = xp.where(wear.dead, xp.inf, ray)
    bright = 1.0 if reflectance is None else reflectance
    gain = 1.0 if wear.gain is None else wear.gain
    if response == "webots":
        counts, sd = _webots(ray, bright, gain, xp)
    else:
        counts, sd = _real(ray, bright, gain, xp)
    if wear.offset is not None:
        counts = counts + wear.offset
    if wear.noise is None or normal is None:
        return counts
    return counts + wear.noise * sd * normal


def expected(response: Response, ray: Array, xp: Any) -> Array:
    """Counts [..., R, K] of nominal sensors, free of noise, for rays [..., R, K] (m)."""
    return read(response, ray, None, Wear(), None, xp)


def distance(response: Response, counts: Array, xp: Any) -> Array:
    """The ray at which a nominal sensor reads so: the inverse of `expected`.

    Args:
      response: of which robot.
      counts: [..., R, K].
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., R, K] m, falling as counts rise, 0..`REACH[response]`. A saturated `real` sensor is
      as far away as one can be that saturates.
    """
    reach = REACH[response]
    if response == "webots":
        return xp.clip(_RISE * _interpolate(counts, _COUNTS[::-1], _LENGTH[::-1], xp), 0.0, reach)
    # Any reading that is below what is seen at the reach will do as the least.
    echo = xp.clip(counts, 1.0, _SPAN)
    return xp.clip(xp.sqrt(_STRENGTH / echo) - _DEPTH + TO_HULL, 0.0, reach)


def _webots(ray: Array, bright: Array, gain: Array, xp: Any) -> tuple[Array, Array]:
    """Returns counts and their sd by the table of Webots' E-puck.

    Webots divides the length by the reflectance before it looks it up, and multiplies the counts
    by 1 + share * normal (DistanceSensor, section "Sensor noise").
    """
    length = ray / (_RISE * bright)
    above = [counts - _COUNTS[-1] for counts in _COUNTS]
    counts = _COUNTS[-1] + gain * _interpolate(length, _LENGTH, above, xp)
    return counts, counts * _interpolate(length, _LENGTH, _SHARE, xp)


def _real(ray: Array, bright: Array, gain: Array, xp: Any) -> tuple[Array, Array]:
    """Returns counts above free space, and their sd, by the curve fitted to a measured robot."""
    gap = xp.maximum(ray - TO_HULL, 0.0)
    echo = bright * gain * _STRENGTH / (gap + _DEPTH) ** 2
    return xp.where(ray < REACH["real"], xp.minimum(echo, _SPAN), 0.0), _SD


def _interpolate(x: Array, knots: Sequence[float], values: Sequence[float], xp: Any) -> Array:
    """Interpolates linearly between rising knots, with the end values beyond them.

    A sum of ramps, one a segment: cheaper on an accelerator than a search, and exact where the
    last value is small, for it is built up from there.
    """
    result = values[-1]
    for i, start in enumerate(knots[:-1]):
        width = knots[i + 1] - start
        slope = (values[i] - values[i + 1]) / width
        result = result + slope * xp.clip(knots[i + 1] - x, 0.0, width)
    return result
