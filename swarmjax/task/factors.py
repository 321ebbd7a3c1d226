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

# Settings that draw random numbers at every control step, and therefore need the seed.
_PER_STEP = ("speed_noise", "target_distance_noise", "target_bearing_noise")


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
      infrared_yaw: [..., R, K] yaw error, rad.
      infrared_period: [..., R] time between samples, s.
      dead_sensor: [..., R, K] whether the sensor never detects anything.
      reflectance: [..., 1 + M] reflectance of all walls, then of each obstacle.
      reflectance_robot: [..., R] reflectance of each robot.
      action_latency: [..., R] latency of commands, control steps, int32.
      observation_latency: [..., R] latency of observations, control steps, int32.
    """

    seed: Array | None = None
    wheel_radius: Array | None = None
    track: Array | None = None
    max_wheel_speed: Array | None = None
    mass: Array | None = None
    friction: Array | None = None
    infrared_noise: Array | None = None
    infrared_gain: Array | None = None
    infrared_yaw: Array | None = None
    infrared_period: Array | None = None
    dead_sensor: Array | None = None
    reflectance: Array | None = None
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


# How the factor of each setting is drawn, and its axes: R robots, K sensors, F walls and obstacles.
# Each has the random stream of its name.
_DRAWN = {
    "wheel_radius": (_uniform, "R"),
    "track": (_uniform, "R"),
    "max_wheel_speed": (_uniform, "R"),
    "mass": (_uniform, "R"),
    "friction": (_uniform, "R"),
    "infrared_noise": (_uniform, "RK"),
    "infrared_gain": (_uniform, "RK"),
    "infrared_yaw": (_normal, "RK"),
    "infrared_period": (_uniform, "R"),
    "dead_sensor": (_chance, "RK"),
    "reflectance": (_uniform, "F"),
    "reflectance_robot": (_uniform, "R"),
    "action_latency": (_whole, "R"),
    "observation_latency": (_whole, "R"),
}


def draw(
    seed: Array,
    realism: RealismConfig,
    robots: int,
    obstacles: int,
    xp: Any,
    sensors: int = epuck.SENSORS,
) -> Factors:
    """Draws the factors of an episode.

    Each factor has its own random numbers, so switching one off leaves the others unchanged.
    Adding robots leaves the factors of the existing robots unchanged.

    The factors are drawn per robot, per sensor or per surface, according to their cause:

    - Wheel radius: each robot draws one radius for both wheels.
    - Track: each robot draws its effective track, since tyres grip somewhere across their width.
    - Latency and sampling period: each robot draws its own, since radio link and firmware determine
      them.
    - Gain and yaw: each sensor draws its own.
    - Reflectance: each obstacle and each robot draws its own. All walls of the arena share one
      reflectance.

    Args:
      seed: [...] uint32, one per episode.
      realism: which factors are drawn, and their ranges; fixed for a program.
      robots: largest number of robots, R.
      obstacles: largest number of obstacles, M.
      xp: `numpy` or `jax.numpy`; both draw the same.
      sensors: infrared sensors of a robot, K.

    Returns:
      The factors, with the leading axes of `seed`.
    """
    seed, sizes = xp.asarray(seed, xp.uint32), {"R": robots, "K": sensors, "F": 1 + obstacles}
    found: dict[str, Array] = {}
    for name, (function, axes) in _DRAWN.items():
        setting = getattr(realism, name)
        if setting is not None:
            source = noise.normal if function is _normal else noise.uniform
            shape = tuple(sizes[axis] for axis in axes)
            drawn = source(seed, 0, Stream[name.upper()], shape, xp)
            found[name] = function(setting, drawn, xp)
    if "wheel_radius" in found:
        found["wheel_radius"] = xp.stack([found["wheel_radius"]] * 2, axis=-1)
    is_random = bool(found) or any(getattr(realism, name) is not None for name in _PER_STEP)
    return Factors(seed=seed if is_random else None, **found)


def largest(robot: RobotConfig, realism: RealismConfig) -> RobotConfig:
    """Returns the robot to compile the model for, with the largest wheels of any episode.

    Args:
      robot: the nominal robot.
      realism: which factors are drawn.

    Returns:
      The robot, with a wheel radius that no draw exceeds. Ignore its speeds.
    """
    most = realism.wheel_radius[1] if realism.wheel_radius else robot.wheel_radius
    return replace(robot, wheel_radius=most, wheel_limit="clip")
