"""Settings of the task and its reward."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from swarmjax import epuck
from swarmjax.config import ConfigError, Section, about, inherit, setting, show
from swarmjax.config.section import MAX_COUNT, ByName, check_options
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.realism_config import RealismConfig

# The value loss squares returns. With larger weights the squares could overflow float32.
_MOST_WEIGHT = 1e6
# By option: the key `goal`, and the goals that read the option.
_READ_BY: dict[str, tuple[str, Sequence[str]]] = dict.fromkeys(
    ("arrival", "target_speed"), ("goal", ("navigate",))
)

Arrival = Literal["latch", "hold"]


def _weight(default: float, meaning: str) -> Any:
    """Makes the setting of a reward weight."""
    return setting(default, meaning, -_MOST_WEIGHT, _MOST_WEIGHT)


@dataclass(frozen=True, kw_only=True)
class RewardConfig(Section):
    """Weights of the reward terms: equation 3 of the paper, and penalties."""

    progress: float = _weight(1.0, "per metre that the robot comes nearer to its target")
    path_progress: float = _weight(
        0.0, "per metre by which the shortest path around walls and boxes gets shorter"
    )
    proximity: float = _weight(
        0.0, "per control step before arrival in which an object is in infrared range"
    )
    arrival: float = _weight(
        0.0,
        "once, on arrival; arrival=hold or goal=gather: when all robots have arrived; "
        "goal=lifelong: at each target; goal=cover: in each step in which the robot sees new floor",
    )
    contact: float = _weight(-0.2, "per contact that begins, of any kind")
    touching: float = _weight(0.0, "per control step in which the robot touches something")
    step_penalty: float = _weight(-0.002, "per control step that begins before arrival")
    extra: dict[str, float] = field(
        default_factory=ByName,
        metadata=about("weights of an extension's terms; 0: off", -_MOST_WEIGHT, _MOST_WEIGHT),
    )


@dataclass(frozen=True, kw_only=True)
class TaskConfig(Section):
    """What a robot is asked to do, and what it observes."""

    control_step: float = setting(0.032, "length of a control step, s", 0.001, 0.2)
    step_limit: int = setting(500, "control steps of a training episode", 1, MAX_COUNT)
    target_radius: float = setting(
        0.05,
        "distance between the centres of robot and target that counts as arrival, m",
        above=0.0,
        high=0.1,
    )
    goal: str = setting(
        "navigate",
        "navigate: each robot drives to its own target; lifelong: to one target after another; "
        "gather: all robots come together; cover: together they see the whole floor; or the name "
        "of an extension's goal",
    )
    target_speed: float = setting(
        0.0, "speed of the targets, which bounce off walls, m/s [goal=navigate]", 0.0, 0.2
    )
    arrival: Arrival = setting(
        "latch",
        "latch: a robot that reaches its target stops for good; hold: it keeps driving, and the "
        "episode ends when all robots are at their targets at once [goal=navigate]",
    )
    encoding: Literal["auto", "metric", "webots"] = setting(
        "auto",
        "units of observations; metric: m and rad; webots: scaled as in Webots' find_and_avoid; "
        "auto: webots with realism.infrared=webots, else metric",
    )
    observations: tuple[str, ...] | None = setting(
        None, "names of the extension's observations to use, in order; null: all of them"
    )
    reward: RewardConfig = field(default_factory=RewardConfig)

    def _check(self) -> None:
        check_options(self, _READ_BY)
        if self.reward.path_progress and (self.goal != "navigate" or self.target_speed):
            raise ConfigError(
                f"reward.path_progress is {show(self.reward.path_progress)}, but targets move: "
                "give 0, or goal=navigate with target_speed=0."
            )


def describe(robot: RobotConfig, task: TaskConfig, realism: RealismConfig) -> str:
    """Returns part of a sentence that describes the robot, its sensors and the task."""
    own = robot.sensor_poses != epuck.SENSOR_POSES
    sensors = f" of {len(robot.sensor_poses)} sensors" if own else ""
    return (
        f"hull {robot.hull_radius:g} m, infrared{sensors} to {robot.sensor_range:g} m, at "
        f"most {robot.max_speed:g} m/s and {robot.max_turn_rate:g} rad/s, control step "
        f"{task.control_step:g} s, {_describe_goal(task)}, realism "
        f"{inherit.preset_of('realism', realism)}"
    )


def _describe_goal(task: TaskConfig) -> str:
    if task.goal != "navigate":
        return f"goal {task.goal}"
    moves = f", targets that move at {task.target_speed:g} m/s" if task.target_speed else ""
    return f"arrival {task.arrival}{moves}"


def check_realism(realism: RealismConfig, robot: RobotConfig, task: TaskConfig, steps: int) -> None:
    """Refuses realism settings that contradict the robot or the episode length.

    Args:
      realism: settings, already checked against their own bounds.
      robot: the robot that the settings apply to.
      task: provides the length of a control step.
      steps: number of control steps in an episode.

    Raises:
      ConfigError: a setting contradicts them; the message names the full key.
    """
    if realism.infrared == "real" and robot.sensor_poses != epuck.SENSOR_POSES:
        raise ConfigError(
            "realism.infrared is real, which uses the measured sensors of the e-puck, but "
            "robot.sensor_poses has other sensors: give realism.infrared=webots with "
            "robot.sensor_response, or realism.infrared=ideal."
        )
    hull, seconds = robot.hull_radius, steps * task.control_step
    for key, value, most in (
        ("track", realism.track, 2 * hull),
        ("wheel_radius", realism.wheel_radius, hull),
    ):
        if value is not None and value[1] >= most:
            raise ConfigError(
                f"realism.{key} is {show(value)}, but robot.hull_radius is {show(hull)} and the "
                f"wheels must lie inside the hull: give less than {show(most)}."
            )
    for key, value, length, unit in (
        ("action_latency", realism.action_latency, steps, "control steps"),
        ("observation_latency", realism.observation_latency, steps, "control steps"),
        ("infrared_period", realism.infrared_period, seconds, "s"),
    ):
        if value is not None and value[1] >= length:
            raise ConfigError(
                f"realism.{key} is {show(value)}, but an episode takes {show(length)} {unit}: "
                f"give less than {show(length)}."
            )


def resolve_encoding(task: TaskConfig, realism: RealismConfig) -> Literal["metric", "webots"]:
    """Returns the encoding of observations.

    `metric` observes metres and radians. `INPUTS` of observation.py has the scales of `webots`.
    """
    if task.encoding != "auto":
        return task.encoding
    return "webots" if realism.infrared == "webots" else "metric"
