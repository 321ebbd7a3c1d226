"""A robot's electronics: from commands to wheel speeds, and from sensors to observations.

This module applies the realism factors to motors and sensors, both in training and in evaluation. A
factor that is off has no effect. With all factors off, a policy observes the exact ray lengths, and
the wheels turn as commanded.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from swarmjax.extension import Observation
from swarmjax.sim import drive as sim_drive
from swarmjax.sim import infrared, motor, noise, response
from swarmjax.sim.body import Chassis
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.drive import Drive
from swarmjax.sim.noise import Stream
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task import observation
from swarmjax.task.config import TaskConfig, resolve_encoding
from swarmjax.task.factors import Factors
from swarmjax.task.level import Level
from swarmjax.task.observation import Encoding, Layout, Readings, View

Array = Any
EPUCK = RobotConfig()
_SLACK = 1e-4  # share of a period; with it, rounding does not delay a sample that is due now


@dataclass(frozen=True, kw_only=True)
class Electronics:
    """Settings of the electronics, fixed in a compiled program.

    Attributes:
      realism: which factors are on.
      encoding: how observations are encoded.
      robot: the robot, for its sensors.
      control_step: length of a control step, s.
      own: observations of an extension, placed after the built-in ones.
    """

    realism: RealismConfig
    encoding: Encoding
    robot: RobotConfig
    control_step: float
    own: tuple[Observation, ...] = ()

    @cached_property
    def layout(self) -> Layout:
        """Names, units and scales of the observation's entries."""
        return observation.layout(self.encoding, self.own, len(self.robot.sensor_poses))

    @cached_property
    def table(self) -> response.Table:
        """Response of the sensors with `realism.infrared=webots`."""
        return response.table(self.robot.sensor_response, self.robot.sensor_tilt)

    @property
    def reach(self) -> float:
        """Largest distance to which rays are cast, m."""
        curves, known = {self.realism.infrared, self.encoding}, dict(response.REACH)
        known["webots"] = self.table.reach
        return max([self.robot.sensor_range, *(known.get(name, 0.0) for name in curves)])


class Memory(NamedTuple):
    """State that the electronics keep between control steps; an unused part is None.

    Attributes:
      commands: [..., D, R, 2] delayed commands, newest first.
      infrared: [..., R, K] the last infrared sample, not yet scaled.
      seen: [..., D, R, O] delayed observations, newest first.
    """

    commands: Array | None
    infrared: Array | None
    seen: Array | None


class Sight(NamedTuple):
    """Exact quantities that the sensors measure.

    Attributes:
      ray: [..., R, K] ray lengths, m, 0 to `Electronics.reach`.
      reflectance: [..., R, K] reflectance of the surface that each ray hits; None for 1.
      distance: [..., R] distance to the target, m.
      bearing: [..., R] bearing of the target, rad.
      own: [..., R, E] observations of an extension; None without any.
    """

    ray: Array
    reflectance: Array | None
    distance: Array
    bearing: Array
    own: Array | None = None


def view(sight: Sight, pose: Array, level: Level, arrived: Array, clock: Array) -> View:
    """Assembles the `View` that observations of an extension receive.

    Args:
      sight: exact sensor quantities.
      pose: [..., R, 3] x (m), y (m), yaw (rad).
      level: the level that the episode started from.
      arrived: [..., R] whether the robot has arrived.
      clock: [...] or [] control steps since the start.

    Returns:
      The view of one arena, or of many.
    """
    return View(
        pose=pose,
        target=level.target,
        distance=sight.distance,
        bearing=sight.bearing,
        infrared=sight.ray,
        present=level.present,
        arrived=arrived,
        side=level.side,
        obstacle=level.obstacle,
        obstacle_present=level.obstacle_present,
        clock=clock,
    )


def load(
    task: TaskConfig,
    realism: RealismConfig,
    encoding: Encoding | None = None,
    own: Sequence[Observation] = (),
    robot: RobotConfig = EPUCK,
) -> Electronics:
    """Creates the electronics from the settings.

    Args:
      task: the task.
      realism: the factors.
      encoding: encoding that the policy was trained with; None for the encoding of the task.
      own: observations of an extension.
      robot: the robot.

    Returns:
      The electronics.
    """
    return Electronics(
        realism=realism,
        encoding=resolve_encoding(task, realism) if encoding is None else encoding,
        robot=robot,
        control_step=task.control_step,
        own=tuple(own),
    )


def chassis(factors: Factors) -> Chassis:
    """Returns the chassis of the robots in an episode."""
    return Chassis(factors.wheel_radius, factors.track, factors.mass, factors.friction)


def reflectance(factors: Factors) -> infrared.Reflectance | None:
    """Returns the reflectances in an episode; None if all are 1."""
    shades = infrared.Reflectance(factors.reflectance, factors.reflectance_robot)
    return None if all(part is None for part in shades) else shades


def begin(
    electronics: Electronics, factors: Factors, sight: Sight, clock: Array, xp: Any
) -> tuple[Memory, Array]:
    """Starts an episode; delayed commands are zero, and delayed observations equal the first one.

    Args:
      electronics: electronics of the program.
      factors: factors of the episode.
      sight: exact sensor quantities at the start.
      clock: [...] or [] zero.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The memory, and the first observation [..., R, O].
    """
    readings, realism = _read(electronics, factors, sight, clock, xp), electronics.realism
    fresh = observation.observe(readings, electronics.layout, xp)
    still = xp.zeros((*sight.distance.shape, sim_drive.ACTION_SIZE), xp.float32)
    memory = Memory(
        commands=_fill(realism.action_latency, still, xp),
        infrared=None if factors.infrared_period is None else readings.infrared,
        seen=_fill(realism.observation_latency, fresh, xp),
    )
    return memory, fresh


def _fill(latency: tuple[int, int] | None, first: Array, xp: Any) -> Array | None:
    """Makes a queue as long as the largest latency, full of the first value; None without one."""
    depth = latency[1] if latency else 0
    return xp.stack([first] * depth, axis=-3) if depth else None


def _delay(
    queue: Array | None, newest: Array, latency: Array | None, xp: Any
) -> tuple[Array | None, Array]:
    """Puts the newest values [..., R, n] into the queue; returns the queue and the values due."""
    if queue is None or latency is None:
        return queue, newest
    values = xp.concatenate([newest[..., None, :, :], queue], axis=-3)
    due = xp.take_along_axis(values, latency[..., None, :, None], axis=-3)[..., 0, :, :]
    return values[..., :-1, :, :], due


def drive(
    electronics: Electronics,
    memory: Memory,
    factors: Factors,
    command: Array,
    motors: Drive,
    clock: Array,
    xp: Any,
) -> tuple[Memory, Array]:
    """Turns commands into wheel speeds.

    Args:
      electronics: electronics of the program.
      memory: state before the control step.
      factors: factors of the episode.
      command: [..., R, 2] forward speed (m/s) and turn rate (rad/s).
      motors: the drive, with the nominal sizes and limits that the firmware uses.
      clock: [...] or [] control steps since the start.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The new memory, and the driven wheel speeds [..., R, 2] (rad/s).
    """
    commands, command = _delay(memory.commands, command, factors.action_latency, xp)
    if factors.max_wheel_speed is not None:
        motors = motors._replace(max_wheel_speed=factors.max_wheel_speed[..., None])
    wheels = sim_drive.wheel_speeds(command, motors, xp)
    wheels = motor.disturb(wheels, electronics.realism, factors.seed, clock, xp)
    return memory._replace(commands=commands), wheels


def sense(
    electronics: Electronics,
    memory: Memory,
    factors: Factors,
    sight: Sight,
    clock: Array,
    xp: Any,
) -> tuple[Memory, Array]:
    """Samples the sensors and returns the observation that reaches the policy now.

    Args:
      electronics: electronics of the program.
      memory: state before the control step.
      factors: factors of the episode.
      sight: exact sensor quantities.
      clock: [...] or [] control steps since the start, including the current one.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The new memory, and the observation [..., R, O].
    """
    readings = _read(electronics, factors, sight, clock, xp)
    if memory.infrared is not None:
        due = _is_due(clock, factors.infrared_period, electronics.control_step, xp)
        last = xp.where(due[..., None], readings.infrared, memory.infrared)
        memory, readings = memory._replace(infrared=last), readings._replace(infrared=last)
    fresh = observation.observe(readings, electronics.layout, xp)
    seen, due = _delay(memory.seen, fresh, factors.observation_latency, xp)
    return memory._replace(seen=seen), due


def _read(
    electronics: Electronics, factors: Factors, sight: Sight, clock: Array, xp: Any
) -> Readings:
    """Takes readings of all sensors."""
    sample = _read_infrared(electronics, factors, sight, clock, xp)
    distance, bearing = _find_target(electronics.realism, factors, sight, clock, xp)
    return Readings(sample, distance, bearing, sight.own)


def _is_due(clock: Array, period: Array, control_step: float, xp: Any) -> Array:
    """Returns [..., R] whether a sample was due in the control step that has just ended."""
    clock = xp.asarray(clock, xp.float32)  # so that NumPy and JAX round alike
    ended = clock[..., None] * control_step / period + _SLACK
    return xp.floor(ended) > xp.floor(ended - control_step / period)


def _read_infrared(
    electronics: Electronics, factors: Factors, sight: Sight, clock: Array, xp: Any
) -> Array:
    """Samples the infrared sensors: [..., R, K] metres or counts, depending on the encoding."""
    kind, encoding = electronics.realism.infrared, electronics.encoding
    if kind == "ideal":
        ray = sight.ray
        if factors.dead_sensor is not None:
            ray = xp.where(factors.dead_sensor, electronics.reach, ray)
    else:
        counts = _read_counts(kind, electronics, factors, sight, clock, xp)
        if kind == encoding:
            return counts
        # A calibrated robot converts counts back to a distance.
        ray = response.distance(kind, counts, xp, electronics.table)
    if encoding == "webots":
        return response.expected("webots", ray, xp, electronics.table)
    return xp.minimum(ray, electronics.robot.sensor_range)


def _read_counts(
    kind: response.Response,
    electronics: Electronics,
    factors: Factors,
    sight: Sight,
    clock: Array,
    xp: Any,
) -> Array:
    """Samples the sensor counts [..., R, K] with the response `kind`."""
    wear = response.Wear(factors.infrared_noise, factors.infrared_gain, factors.dead_sensor)
    normal = None
    if factors.infrared_noise is not None:
        shape = sight.ray.shape[-2:]
        normal = noise.normal(factors.seed, clock, Stream.INFRARED, shape, xp)
    return response.read(kind, sight.ray, sight.reflectance, wear, normal, xp, electronics.table)


def _find_target(
    realism: RealismConfig, factors: Factors, sight: Sight, clock: Array, xp: Any
) -> tuple[Array, Array]:
    """Returns distance and bearing [..., R] of the targets, with noise as of a camera."""
    distance, bearing = sight.distance, sight.bearing
    robots = distance.shape[-1:]
    if realism.target_distance_noise is not None:
        drawn = noise.normal(factors.seed, clock, Stream.TARGET_DISTANCE, robots, xp)
        distance = xp.maximum(distance + realism.target_distance_noise * drawn, 0.0)
    if realism.target_bearing_noise is not None:
        drawn = noise.normal(factors.seed, clock, Stream.TARGET_BEARING, robots, xp)
        turned = bearing + realism.target_bearing_noise * drawn
        bearing = xp.arctan2(xp.sin(turned), xp.cos(turned))
    return distance, bearing
