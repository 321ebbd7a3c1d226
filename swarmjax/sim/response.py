"""Infrared sensor models, which convert ray lengths to counts and counts to ray lengths.

A ray is the horizontal distance from the sensor's origin to the nearest object, in metres. A
robot's ray is tilted upwards by `robot.sensor_tilt`, so its length to an upright face is this
distance divided by cos(tilt).

`webots` is a lookup table; the default is the table of Webots' E-puck. The table maps (length of
the ray) / reflectance to counts, with multiplicative noise. With the default table, a sensor that
sees nothing (free space) reads 67.19 counts. `real` has a curve for each sensor, fitted to a
measured robot. The curve gives reflectance * A / (gap + d)^2 counts, with additive noise; the
counts in free space are subtracted, as in the firmware. The code runs on NumPy or JAX.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from swarmjax import epuck

Array = Any
Response = Literal["webots", "real"]


class Table(NamedTuple):
    """The lookup table of a `webots` sensor.

    Attributes:
      length: increasing ray lengths along the tilted ray, m.
      counts: counts at each length, decreasing.
      share: standard deviation of the noise at each length, relative to the counts.
      rise: cosine of a ray's tilt: its horizontal length divided by its length.
    """

    length: tuple[float, ...]
    counts: tuple[float, ...]
    share: tuple[float, ...]
    rise: float

    @property
    def reach(self) -> float:
        """Horizontal length of the longest ray, m."""
        return self.length[-1] * self.rise


def table(points: Sequence[Sequence[float]], tilt: float) -> Table:
    """Makes a table from rows of `robot.sensor_response`, for rays tilted upwards by `tilt` rad."""
    length, counts, share = zip(*points, strict=True)
    return Table(length, counts, share, math.cos(tilt))


EPUCK = table(epuck.INFRARED_TABLE, epuck.SENSOR_TILT)
# m; horizontal length at which rays end, because sensors see nothing beyond it. For `webots`, this
# is where the table ends; reflectances below 1 only shorten the range. For `real`, the fitted curve
# would still give 13 to 22 counts at this length. The longest ranges in e-puck simulators are 0.10
# to 0.12 m (ARGoS, Enki).
REACH = {"webots": EPUCK.reach, "real": 0.10}
_STRENGTH, _DEPTH, _FREE, _SD, _SATURATION = np.array(epuck.INFRARED_FIT, np.float32).T
_SPAN = _SATURATION - _FREE


def _distance_to_hull() -> np.ndarray:
    """Returns distances [K] from the sensors' origins along their rays to the hull's surface, m."""
    x, y, yaw = np.array(epuck.SENSOR_POSES).T
    outward = x * np.cos(yaw) + y * np.sin(yaw)
    spare = epuck.HULL_RADIUS**2 - x**2 - y**2
    return (np.sqrt(outward**2 + spare) - outward).astype(np.float32)


TO_HULL = _distance_to_hull()


class Wear(NamedTuple):
    """How each sensor differs from a nominal sensor, in arrays [..., R, K]; None for no difference.

    Attributes:
      noise: factor on the sensor model's own noise; None for no noise at all.
      gain: factor on the reflected part of the reading.
      dead: whether the sensor never detects anything, bool.
    """

    noise: Array | None = None
    gain: Array | None = None
    dead: Array | None = None


def read(
    response: Response,
    ray: Array,
    reflectance: Array | None,
    wear: Wear,
    normal: Array | None,
    xp: Any,
    table: Table = EPUCK,
) -> Array:
    """Simulates the readings of the sensors.

    Args:
      response: sensor model.
      ray: [..., R, K] horizontal distance from the sensor's origin to the nearest object, m.
      reflectance: [..., R, K] reflectance of that object, above 0 and at most 1; None if all are 1.
      wear: how each sensor differs from a nominal sensor.
      normal: [..., R, K] standard normal numbers, newly drawn for each sample; None for no noise.
      xp: `numpy` or `jax.numpy`.
      table: the response `webots`.

    Returns:
      [..., R, K] counts. Counts are not clamped: noise can make a `real` reading negative.
    """
    if wear.dead is not None:
        ray = xp.where(wear.dead, xp.inf, ray)
    bright = 1.0 if reflectance is None else reflectance
    gain = 1.0 if wear.gain is None else wear.gain
    if response == "webots":
        counts, sd = _webots(ray, bright, gain, table, xp)
    else:
        counts, sd = _real(ray, bright, gain, xp)
    if wear.noise is None or normal is None:
        return counts
    return counts + wear.noise * sd * normal


def expected(response: Response, ray: Array, xp: Any, table: Table = EPUCK) -> Array:
    """Returns noise-free counts [..., R, K] of nominal sensors for rays [..., R, K] (m)."""
    return read(response, ray, None, Wear(), None, xp, table)


def distance(response: Response, counts: Array, xp: Any, table: Table = EPUCK) -> Array:
    """Returns the ray length that corresponds to a nominal sensor's counts: inverts `expected`.

    Args:
      response: sensor model.
      counts: [..., R, K].
      xp: `numpy` or `jax.numpy`.
      table: the response `webots`.

    Returns:
      [..., R, K] horizontal ray lengths, m, from 0 to the reach of the sensor model; the more
      counts, the shorter. For the counts of a saturated `real` sensor, the result is the largest
      distance at which the sensor saturates.
    """
    if response == "webots":
        length = _interpolate(counts, table.counts[::-1], table.length[::-1], xp)
        return xp.clip(table.rise * length, 0.0, table.reach)
    # The lower limit of 1 avoids a division by 0. Any value below the reading at the largest
    # distance gives the same result.
    echo = xp.clip(counts, 1.0, _SPAN)
    return xp.clip(xp.sqrt(_STRENGTH / echo) - _DEPTH + TO_HULL, 0.0, REACH[response])


def _webots(ray: Array, bright: Array, gain: Array, table: Table, xp: Any) -> tuple[Array, Array]:
    """Returns counts and their standard deviation, from the lookup table of `webots`.

    Webots divides the length by the reflectance before the lookup, and multiplies the counts by
    1 + share * normal (DistanceSensor, section "Sensor noise").
    """
    length, free = ray / (table.rise * bright), table.counts[-1]
    above = [counts - free for counts in table.counts]
    counts = free + gain * _interpolate(length, table.length, above, xp)
    return counts, counts * _interpolate(length, table.length, table.share, xp)


def _real(ray: Array, bright: Array, gain: Array, xp: Any) -> tuple[Array, Array]:
    """Returns counts above free space and their standard deviation, from the curve of `real`."""
    gap = xp.maximum(ray - TO_HULL, 0.0)
    echo = bright * gain * _STRENGTH / (gap + _DEPTH) ** 2
    return xp.where(ray < REACH["real"], xp.minimum(echo, _SPAN), 0.0), _SD


def _interpolate(x: Array, knots: Sequence[float], values: Sequence[float], xp: Any) -> Array:
    """Interpolates linearly between increasing knots; outside the knots, the end values hold.

    The result is a sum of one ramp per segment. On an accelerator, this is cheaper than a search.
    The sum starts from the last value, so the result has no rounding error beyond the last knot.
    """
    result = values[-1]
    for i, start in enumerate(knots[:-1]):
        width = knots[i + 1] - start
        slope = (values[i] - values[i + 1]) / width
        result = result + slope * xp.clip(knots[i + 1] - x, 0.0, width)
    return result
