"""Realism factors of one episode: the properties of its robots, sensors and surfaces.

All factors follow from the episode's seed, so they are part of the level. The code takes the array
module as an argument, so NumPy and JAX draw the same factors.
"""

from dataclasses import replace
from typing import Any, NamedTuple

from swarmjax import epuck
from swarmjax.sim import noise
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.noise import Stream
from swarmjax.sim.realism_config import RealismConfig

Array = Any

# Settings that draw random numbers at every control step. These settings need the seed as well.
_PER_STEP = (
    "speed_noise",
    "stall",
    "target_distance_noise",
    "target_bearing_noise",
    "packet_loss",
    "neighbour_distance_noise",
    "neighbour_bearing_noise",
)


class Factors(NamedTuple):
    """The factors of an episode; a factor that is off is None.

    Attributes:
      seed: [...] uint32 seed of everything drawn at each control step; None without randomness.
      wheel_radius: [..., R, 2] radius of the left and the right wheel, m.
      track: [..., R] effective track, m.
      max_wheel_speed: [..., R] rad/s.
      mass: [..., R] kg.
      friction: [..., R] friction between wheels and floor.
      infrared_noise: [..., R, K] factor on the noise of the response.
      infrared_gain: [..., R, K] factor on the reflected part of the response.
      infrared_offset: [..., R, K] constant error of the reading, counts.
      infrared_yaw: [..., R, K] rad.
      infrared_position: [..., R, K, 2] m, in the robot's frame.
      infrared_period: [..., R] s between samples.
      dead_sensor: [..., R, K] whether the sensor never detects anything.
      reflectance_wall: [...] reflectance of all walls.
      reflectance_obstacle: [..., M].
      reflectance_robot: [..., R].
      action_latency: [..., R] control steps, int32.
      observation_latency: [..., R] control steps, int32.
    """

    seed: Array | None = None
    wheel_radius: Array | None = None
    track: Array | None = None
    max_wheel_speed: Array | None = None
    mass: Array | None = None
    friction: Array | None = None
    infrared_noise: Array | None = None
    infrared_gain: Array | None = None
    infrared_offset: Array | None = None
    infrared_yaw: Array | None = None
    infrared_position: Array | None = None
    infrared_period: Array | None = None
    dead_sensor: Array | None = None
    reflectance_wall: Array | None = None
    reflectance_obstacle: Array | None = None
    reflectance_robot: Array | None = None
    action_latency: Array | None = None
    observation_latency: Array | None = None


def _uniform(bounds: Any, share: Array, xp: Any) -> Array:
    """Returns numbers from low..high, within the rounding of float32."""
    low, high = bounds
    return low + share * (high - low)


def _whole(bounds: Any, share: Array, xp: Any) -> Array:
    """Returns whole numbers from low..high, int32."""
    low, high = bounds
    return low + xp.floor(share * (high - low + 1)).astype(xp.int32)


def _chance(probability: Any, share: Array, xp: Any) -> Array:
    """Returns booleans that are true with a probability."""
    return share < probability


def _normal(deviation: Any, drawn: Array, xp: Any) -> Array:
    """Returns numbers from N(0, deviation)."""
    return deviation * drawn


# How the factor of each setting is drawn, and its axes: R robots, K sensors, M obstacles, 2 axes.
# Each has the random stream of its name.
_DRAWN = {
    "wheel_radius": (_uniform, "R"),
    "wheel_mismatch": (_normal, "R"),
    "track": (_uniform, "R"),
    "max_wheel_speed": (_uniform, "R"),
    "mass": (_uniform, "R"),
    "friction": (_uniform, "R"),
    "infrared_noise": (_uniform, "RK"),
    "infrared_gain": (_uniform, "RK"),
    "infrared_offset": (_normal, "RK"),
    "infrared_yaw": (_normal, "RK"),
    "infrared_position": (_normal, "RK2"),
    "infrared_period": (_uniform, "R"),
    "dead_sensor": (_chance, "RK"),
    "reflectance_wall": (_uniform, ""),
    "reflectance_obstacle": (_uniform, "M"),
    "reflectance_robot": (_uniform, "R"),
    "action_latency": (_whole, "R"),
    "observation_latency": (_whole, "R"),
}


def draw(
    seed: Array, realism: RealismConfig, robot: RobotConfig, robots: int, obstacles: int, xp: Any
) -> Factors:
    """Draws the factors of an episode.

    Each factor has its own random numbers, so switching one off leaves the others unchanged.
    Adding robots leaves the factors of the existing robots unchanged. `configs/realism/` holds the
    ranges and their sources.

    The factors are drawn per robot, per sensor or per surface, according to their cause:

    - Wheel radius: each robot draws one radius, and a small difference between its wheels. Wheels
      wear, but both tyres of a robot have nearly the same thickness.
    - Track: each robot draws its effective track, since tyres grip somewhere across their width.
    - Latency and sampling period: each robot draws its own, since radio link and firmware determine
      them.
    - Gain, offset, yaw and position: each sensor draws its own.
    - Reflectance: each obstacle and each robot draws its own. All walls of the arena share one
      reflectance.
    - Friction: each robot draws the friction of its wheels on the floor.

    Args:
      seed: [...] uint32, one per episode.
      realism: which factors are drawn, and their ranges; fixed for a program.
      robot: the nominal robot. Its wheel radius is used if only the mismatch of wheels is drawn.
      robots: largest number of robots, R.
      obstacles: largest number of obstacles, M.
      xp: `numpy` or `jax.numpy`; both draw the same.

    Returns:
      The factors, with the leading axes of `seed`.
    """
    seed, sizes = xp.asarray(seed, xp.uint32), {"R": robots, "K": epuck.SENSORS, "M": obstacles}
    found: dict[str, Array] = {}
    for name, (function, axes) in _DRAWN.items():
        setting = getattr(realism, name)
        if setting is not None:
            source = noise.normal if function is _normal else noise.uniform
            shape = tuple(sizes.get(axis, 2) for axis in axes)
            drawn = source(seed, 0, Stream[name.upper()], shape, xp)
            found[name] = function(setting, drawn, xp)
    mismatch = found.pop("wheel_mismatch", None)
    if "wheel_radius" in found or mismatch is not None:
        radius = found.get("wheel_radius", robot.wheel_radius)
        found["wheel_radius"] = _wheel_radius(radius, mismatch, xp)
    is_random = bool(found) or any(getattr(realism, name) is not None for name in _PER_STEP)
    return Factors(seed=seed if is_random else None, **found)


def _wheel_radius(radius: Any, mismatch: Array | None, xp: Any) -> Array:
    """Returns the radii [..., R, 2] of left and right wheels, m.

    The mismatch is (right - left) / mean, and each wheel takes half of it. A robot commanded to
    drive straight then turns by mismatch / track radians per metre.
    """
    half = 0.5 * mismatch if mismatch is not None else xp.zeros_like(radius)
    return xp.stack([radius * (1.0 - half), radius * (1.0 + half)], axis=-1)


def largest(robot: RobotConfig, realism: RealismConfig) -> RobotConfig:
    """Returns the robot to compile the model for, with the largest values of any episode.

    Args:
      robot: the nominal robot.
      realism: which factors are drawn.

    Returns:
      The robot, with a wheel radius that no draw exceeds.
    """
    most = realism.wheel_radius[1] if realism.wheel_radius else robot.wheel_radius
    half = 0.5 * (realism.wheel_mismatch or 0.0)
    return replace(robot, wheel_radius=most * (1.0 + half * noise.MOST))
