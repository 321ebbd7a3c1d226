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
      dead: [..., R, K] whether the sensor never detects anything.
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
    dead: Array | None = None
    reflectance_wall: Array | None = None
    reflectance_obstacle: Array | None = None
    reflectance_robot: Array | None = None
    action_latency: Array | None = None
    observation_latency: Array | None = None


class _Source(NamedTuple):
    """Draws the numbers of an episode, each kind from its own random stream."""

    seed: Array
    xp: Any

    def uniform(
        self, bounds: tuple[float, float] | None, stream: Stream, *shape: int
    ) -> Array | None:
        """Draws [..., *shape] uniformly from low..high, within the rounding of float32."""
        if bounds is None:
            return None
        low, high = bounds
        return low + noise.uniform(self.seed, 0, stream, shape, self.xp) * (high - low)

    def whole(self, bounds: tuple[int, int] | None, stream: Stream, *shape: int) -> Array | None:
        """Draws [..., *shape] integers uniformly from low..high."""
        if bounds is None:
            return None
        low, high = bounds
        share = noise.uniform(self.seed, 0, stream, shape, self.xp) * (high - low + 1)
        return low + self.xp.floor(share).astype(self.xp.int32)

    def normal(self, deviation: float | None, stream: Stream, *shape: int) -> Array | None:
        """Draws [..., *shape] from N(0, deviation)."""
        if deviation is None:
            return None
        return deviation * noise.normal(self.seed, 0, stream, shape, self.xp)

    def chance(self, probability: float | None, stream: Stream, *shape: int) -> Array | None:
        """Draws [..., *shape] booleans that are true with the given probability."""
        if probability is None:
            return None
        return noise.uniform(self.seed, 0, stream, shape, self.xp) < probability


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
    source, sensors = _Source(xp.asarray(seed, xp.uint32), xp), (robots, epuck.SENSORS)
    uniform, whole, normal = source.uniform, source.whole, source.normal
    found = Factors(
        wheel_radius=_wheel_radius(source, realism, robot, robots),
        track=uniform(realism.track, Stream.TRACK, robots),
        max_wheel_speed=uniform(realism.max_wheel_speed, Stream.MAX_WHEEL_SPEED, robots),
        mass=uniform(realism.mass, Stream.MASS, robots),
        friction=uniform(realism.friction, Stream.FRICTION, robots),
        infrared_noise=uniform(realism.infrared_noise, Stream.INFRARED_NOISE, *sensors),
        infrared_gain=uniform(realism.infrared_gain, Stream.INFRARED_GAIN, *sensors),
        infrared_offset=normal(realism.infrared_offset, Stream.INFRARED_OFFSET, *sensors),
        infrared_yaw=normal(realism.infrared_yaw, Stream.INFRARED_YAW, *sensors),
        infrared_position=normal(realism.infrared_position, Stream.INFRARED_POSITION, *sensors, 2),
        infrared_period=uniform(realism.infrared_period, Stream.INFRARED_PERIOD, robots),
        dead=source.chance(realism.dead_sensor, Stream.DEAD_SENSOR, *sensors),
        reflectance_wall=uniform(realism.reflectance_wall, Stream.REFLECTANCE_WALL),
        reflectance_obstacle=uniform(
            realism.reflectance_obstacle, Stream.REFLECTANCE_OBSTACLE, obstacles
        ),
        reflectance_robot=uniform(realism.reflectance_robot, Stream.REFLECTANCE_ROBOT, robots),
        action_latency=whole(realism.action_latency, Stream.ACTION_LATENCY, robots),
        observation_latency=whole(realism.observation_latency, Stream.OBSERVATION_LATENCY, robots),
    )
    return found._replace(seed=source.seed if _is_random(found, realism) else None)


def _wheel_radius(
    source: _Source, realism: RealismConfig, robot: RobotConfig, robots: int
) -> Array | None:
    """Draws the radii [..., R, 2] of left and right wheels, m.

    The mismatch is (right - left) / mean, and each wheel takes half of it. A robot commanded to
    drive straight then turns by mismatch / track radians per metre.
    """
    if realism.wheel_radius is None and realism.wheel_mismatch is None:
        return None
    radius = source.uniform(realism.wheel_radius, Stream.WHEEL_RADIUS, robots)
    mismatch = source.normal(realism.wheel_mismatch, Stream.WHEEL_MISMATCH, robots)
    radius = robot.wheel_radius if radius is None else radius
    half = 0.5 * mismatch if mismatch is not None else source.xp.zeros_like(radius)
    return source.xp.stack([radius * (1.0 - half), radius * (1.0 + half)], axis=-1)


def _is_random(found: Factors, realism: RealismConfig) -> bool:
    """Returns whether anything is random, at the start or at a control step."""
    later = (getattr(realism, name) for name in _PER_STEP)
    return any(value is not None for value in (*found, *later))


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
