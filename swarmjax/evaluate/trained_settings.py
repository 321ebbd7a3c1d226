"""Reads from a policy's file the robot and the task that it was trained with.

Commands that run a policy take hull, sensors, speeds, task, realism and stage from its file, unless
the command line sets them. They do not take body and hull friction from the file: by default the
body has wheels and hulls rub as in Webots, so that all policies are judged alike.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

from swarmjax import policy_file
from swarmjax.config import ConfigError, Section, build, files, inherit
from swarmjax.config.section import build_stored
from swarmjax.evaluate.config import JUDGED
from swarmjax.evaluate.evaluation import list_files
from swarmjax.evaluate.trials import Entrant
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task import stage_files
from swarmjax.task.config import TaskConfig, describe

# Keys of the task that an evaluation needs too; rewards and step limit matter only in training.
_TASK = ("control_step", "target_radius", "goal", "target_speed", "arrival", "observations")
# Keys of the robot that a policy file holds in `meta.sensors`.
_SENSORS = {
    "poses": "sensor_poses",
    "range": "sensor_range",
    "height": "sensor_height",
    "tilt": "sensor_tilt",
    "table": "sensor_response",
}
_SHOWN = ("robot", "task", "realism")  # sections whose typed keys the printed line repeats


class Trained(NamedTuple):
    """The conditions of a policy's training.

    Attributes:
      robot: Settings of the robot.
      task: Settings of the task that a judge needs too.
      realism: Settings of realism.
      stages: Plain data of the stages of training, in order; empty if the file names none.
    """

    robot: RobotConfig
    task: TaskConfig
    realism: RealismConfig
    stages: list[dict[str, Any]]


def trained(meta: Mapping[str, Any], path: str) -> Trained:
    """Reads the conditions of training from a policy file.

    Args:
      meta: Contents of the file's `meta`.
      path: Path of the file.

    Raises:
      ConfigError: A number is invalid.
    """
    names = {item.name for item in fields(RobotConfig)}
    robot = {key: value for key, value in meta["robot"].items() if key in names}
    robot["max_speed"], robot["max_turn_rate"] = meta["action"]["high"][:2]
    if robot["max_speed"] > robot["wheel_radius"] * robot["max_wheel_speed"]:
        robot.setdefault("wheel_limit", "clip")  # as in files that are older than this key
    robot |= {
        name: meta["sensors"][key] for key, name in _SENSORS.items() if key in meta["sensors"]
    }
    task = {key: meta["task"][key] for key in _TASK if key in meta["task"]}
    return Trained(
        robot=build(RobotConfig, robot, f"{path}: meta.robot."),
        task=build(TaskConfig, task, f"{path}: meta.task."),
        realism=build_stored(RealismConfig, meta["realism"], f"{path}: meta.realism."),
        stages=meta["stages"],
    )


def load[C: Section](
    cls: type[C],
    typed: Sequence[str],
    entrants: Sequence[Entrant] | None = None,
    stage: dict[str, Any] | None = None,
) -> tuple[C, str]:
    """Makes the settings of a command that runs policies: as in training, unless set otherwise.

    Args:
      cls: The command's dataclass, with `policy` and perhaps `compare`.
      typed: `key=value` arguments.
      entrants: The policies, if they have been read already. None means the policies that `typed`
        names.
      stage: Plain data of the stage, used if `typed` names no stage. None means the policies' last
        stage.

    Returns:
      The settings, and a line that says what comes from the policies.

    Raises:
      ConfigError: An argument is invalid or not read here, or policies were trained with different
        settings and no argument sets them.
      PolicyError: A policy is invalid.
    """
    if "task.step_limit" in files.parse(cls, typed):
        raise ConfigError("task.step_limit works only in training: give steps=NUMBER instead.")
    if entrants is None:
        metas = {path: policy_file.read_meta(path) for path in _paths(cls, typed)}
    else:
        metas = {each.path: each.policy.meta for each in entrants}
        typed = [f"policy={','.join(metas)}", *typed]
    trainings = [trained(meta, path) for path, meta in metas.items()]
    limits = {meta["task"].get("step_limit") for meta in metas.values()} - {None}
    words = [_words(cls, each, typed) for each in trainings]
    _check_alike(cls, list(metas), words, typed)
    if stage is None and trainings and trainings[0].stages:
        stage = trainings[0].stages[-1]
    settings = stage_files.load_levels(cls, [*(words[0] if words else ()), *typed], stage)
    return settings, _say(settings, typed, limits)


def _paths(cls: type[Section], typed: Sequence[str]) -> list[str]:
    """Lists the policy files that the arguments name."""
    given = files.parse(cls, typed)
    policy, compare = (given.get(key) or "" for key in ("policy", "compare"))
    sides = [("policy", policy), *(("compare", part) for part in str(compare).split(","))]
    paths = [path for key, text in sides if text for path in list_files(key, str(text))]
    return list(dict.fromkeys(paths))


def _words(cls: type[Section], training: Trained, typed: Sequence[str]) -> list[str]:
    """Converts the training's settings to arguments."""
    choice = files.parse(cls, typed).get("robot")
    own = {} if choice is None else files.read_choice("robot", choice)
    judged = JUDGED.keys() - own.get("robot", own).keys()
    return [
        *(f"robot.{key}={JUDGED[key]}" for key in sorted(judged)),
        *inherit.group_words(cls, "robot", training.robot, typed, skip=JUDGED),
        *inherit.group_words(cls, "task", training.task, typed),
        *inherit.preset_words(cls, "realism", training.realism, typed),
    ]


def _check_alike(
    cls: type[Section], paths: list[str], words: list[list[str]], typed: Sequence[str]
) -> None:
    """Refuses policies that were trained with different settings, unless an argument sets them."""
    given = files.parse(cls, typed)
    for path, mine in zip(paths[1:], words[1:], strict=True):
        for word in sorted(set(mine) ^ set(words[0])):
            key = word.partition("=")[0]
            if key not in given:
                raise ConfigError(
                    f"{paths[0]} and {path} were trained with different values of {key}: give one "
                    f"value for all policies, as in {word}."
                )


def _say(settings: Any, typed: Sequence[str], limits: Collection[int]) -> str:
    """Describes in one line the robot and task that the policies run with."""
    given = [word for word in typed if word.partition("=")[0].partition(".")[0] in _SHOWN]
    levels = f"suite {settings.suite}" if settings.suite else f"stage {settings.stage.name}"
    what = describe(settings.robot, settings.task, settings.realism)
    friction = settings.robot.hull_friction
    rubs = f" with hulls of friction {friction:g}" if friction else ""
    but = f" but for {' '.join(given)}" if given else ""
    steps = "" if settings.suite else f", {settings.step_limit:,} control steps an episode"
    if steps and {*limits} - {settings.step_limit}:
        steps += f" (in training {', '.join(f'{each:,}' for each in sorted(limits))})"
    return f"as trained{but}: {what}; {settings.robot.body} body{rubs}, {levels}{steps}"
