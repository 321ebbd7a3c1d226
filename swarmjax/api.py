"""swarmjax from Python: environments, training, evaluation and policies.

These functions are available as `swarmjax.make_env` and so on. Settings have the same names as on
the command line. If a setting would be refused on the command line, these functions raise
`SwarmjaxError` with the same message.
"""

import functools
import json
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from swarmjax import command, extension, policy_file
from swarmjax.config import Section, files, to_dict
from swarmjax.policy import Policy
from swarmjax.run.errors import CheckpointError, TrainingError

if TYPE_CHECKING:
    from swarmjax.environment import Swarm
    from swarmjax.run.loggers import Logger
    from swarmjax.run.settings import TrainConfig

Row = dict[str, Any]


class SwarmjaxError(ValueError):
    """A mistake in the arguments, or a run that broke, described in one sentence."""


class TrainResult(NamedTuple):
    """Result of a training run.

    Attributes:
      policy: policy of the first seed.
      policies: policies of all seeds.
      metrics: one row per update and seed, as in `metrics.jsonl`.
      run: the run directory.
    """

    policy: Policy
    policies: list[Policy]
    metrics: list[Row]
    run: Path


def _one_error[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Converts the package's errors to `SwarmjaxError`."""

    @functools.wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return function(*args, **kwargs)
        except OSError:  # may come from a function of the caller
            raise
        except Exception as error:
            found = command.explain(error, (CheckpointError, TrainingError))
            if found is None:
                raise
            raise SwarmjaxError(found[0]) from None

    return wrapped


@_one_error
def make_env(
    stage: Any = "s6",
    robot: Any = None,
    task: Any = None,
    realism: Any = None,
    sim: Any = None,
    *,
    arenas: int = 64,
    extensions: Any = None,
) -> "Swarm":
    """Builds many arenas that are stepped together by pure functions.

        env = swarmjax.make_env("s6", arenas=64)
        state = jax.jit(env.reset)(jax.random.key(0))
        state, step = jax.jit(env.step)(state, action)  # action [64, 5, 2], -1..1

    `state.observation` [A, R, O] is the policy's input. Arenas start new episodes by themselves.

    Args:
      stage: a name of `configs/stage/`, the path of a .yaml file, a `StageConfig`, or a list of
        such stages. Arena i plays stage i modulo the number of stages.
      robot: `planar`, `wheeled` or another name of `configs/robot/`, or settings by name, as in
        `{"hull_radius": 0.04}`.
      task: settings by name, as in `{"step_limit": 300, "reward": {"contact": -0.1}}`.
      realism: `ideal`, `webots`, `real`, or settings by name.
      sim: settings by name, as in `{"solver": "mjx"}`.
      arenas: number of arenas stepped together, A.
      extensions: your own extension pieces: a file, a module, or a list of them.

    Returns:
      The environment: `reset(key)`, `step(state, action)`, `observation_space`, `action_space`.

    Raises:
      SwarmjaxError: an argument is invalid.
    """
    from swarmjax import environment
    from swarmjax.run.load_settings import load_train

    given = {"robot": robot, "task": task, "realism": realism, "sim": sim, "extensions": extensions}
    named = {key: value for key, value in given.items() if value is not None}
    words, stages = _given({"stage": stage, **named, "arenas": arenas, **_NOT_LEARNING})
    config = load_train(words, stages=stages)
    most = {key: max(getattr(each, key) for each in config.stage) for key in _ROOM}
    typed = files.flatten(named)
    left = {f"max_{key}": value for key, value in most.items() if f"sim.max_{key}" not in typed}
    return environment.load(replace(config, sim=replace(config.sim, **left)))


_ROOM = ("robots", "obstacles")
# Learner settings that allow any number of arenas. An environment does not read them.
_NOT_LEARNING = {"budget": 2**20, "algo.num_minibatches": 1, "algo.rollout_length": 1}


@_one_error
def train_policy(
    settings: "Mapping[str, Any] | TrainConfig" = MappingProxyType({}),
    *,
    on_update: Callable[[Row], object] | None = None,
    log: "Sequence[Logger]" = (),
    extensions: Any = None,
) -> TrainResult:
    """Trains a swarm, as `python -m swarmjax.train` does, and writes a run directory.

        result = swarmjax.train_policy({"stage": "s3", "arenas": 64, "budget": 500_000})

    Args:
      settings: keys of the command and their values, as in `{"algo.discount": 0.995}`. The value
        of `stage` may also be a `StageConfig` or a list of them.
      on_update: called with each row of `metrics.jsonl`. If it returns True, the run saves and
        stops, as it does on Ctrl-C.
      log: a list of `Logger`s of `swarmjax.run.loggers`. Each logger is called in its own thread,
        so the run does not wait for it. If a logger raises an error, a warning is printed to
        standard error and the run continues without this logger.
      extensions: your own extension pieces: a file, a module, or a list of them.

    Returns:
      The policies, the metrics and the run directory.

    Raises:
      SwarmjaxError: a setting is invalid, or the run broke.
    """
    from swarmjax.run.load_settings import load_run
    from swarmjax.run.run import Run
    from swarmjax.run.settings import TrainConfig
    from swarmjax.run.signals import Stop

    if isinstance(settings, TrainConfig):
        config = settings
    else:
        more = {} if extensions is None else {"extensions": extensions}
        config = load_run(*_given({**settings, **more}))
    stop = Stop()
    run = Run(config, stop=stop, loggers=log, on_update=on_update)
    # Only the main thread can handle signals.
    in_main = threading.current_thread() is threading.main_thread()
    with stop if in_main else nullcontext():
        run.train()
    policies = [policy_file.read(file, config.extensions) for file in run.policies]
    lines = (run.path / "metrics.jsonl").read_text().splitlines()
    return TrainResult(policies[0], policies, [json.loads(line) for line in lines], run.path)


@_one_error
def evaluate_policy(
    policy: Any,
    suite: str | None = None,
    stage: Any = None,
    *,
    extensions: Any = None,
    workers: int = 1,
    **settings: Any,
) -> dict[str, Any]:
    """Evaluates a policy in MuJoCo's C engine, as `python -m swarmjax.evaluate` does.

        found = swarmjax.evaluate_policy(result.policy, stage="s6", episodes=100)
        found["cells"][0]["measures"]["targets_reached"]["mean"]

    The evaluation uses the robot, task and realism that the policy was trained with, but the robot
    has the wheeled body.

    Args:
      policy: a `Policy`, the path of a policy file, or a list of policies or paths from the same
        training settings.
      suite: a name of `configs/suites/`, or the path of a file. Give either `suite` or `stage`.
      stage: a name, a path or a `StageConfig`. Without `suite`, None means the last stage that the
        policy was trained on.
      extensions: pieces that the policy needs: a file, a module, or a list of them.
      workers: number of processes. Each additional process imports the calling script again, so
        that script needs `if __name__ == "__main__":`.
      settings: further keys of the command and their values, as in `episodes=100` or
        `realism="real"`.

    Returns:
      The contents of `result.json` (docs/interface.md).

    Raises:
      SwarmjaxError: an argument is invalid, or does not fit the policy.
    """
    from swarmjax.evaluate import evaluation, trained_settings
    from swarmjax.evaluate.config import EvaluateConfig
    from swarmjax.evaluate.trials import Entrant

    word = extension.hand_over(extensions)
    # A policy is itself a tuple, so a tuple need not hold several policies.
    several = [policy] if isinstance(policy, str | Path | Policy) else list(policy)
    entrants = [
        Entrant(each.digest, each)
        if isinstance(each, Policy)
        else Entrant(str(each), policy_file.read(each, word))
        for each in several
    ]
    named = {"stage": stage, "suite": suite, "workers": workers, "extensions": word}
    given: dict[str, Any] = {**named, **settings}
    words, stages = _given({key: value for key, value in given.items() if value is not None})
    config, _ = trained_settings.load(
        EvaluateConfig, words, entrants, stages[0] if stages else None
    )
    return evaluation.evaluate(config, entrants).result


@_one_error
def load_policy(path: str | Path, extensions: Any = None) -> Policy:
    """Reads and checks a policy file; `swarmjax.policy.act` runs the policy.

    Args:
      path: path of the file.
      extensions: a file, a module or a list of pieces with the policy's own network, if the policy
        has one.

    Raises:
      SwarmjaxError: the file is missing, damaged or inconsistent.
    """
    return policy_file.read(path, extension.hand_over(extensions))


def _given(settings: Mapping[str, Any]) -> tuple[list[str], list[dict[str, Any]] | None]:
    """Returns settings as command-line words, and separately the stages that no word can name."""
    rest = dict(settings)
    stage = rest.get("stage")
    stages = None if stage is None or isinstance(stage, str | Path) else _stages(rest.pop("stage"))
    if "extensions" in rest:
        rest["extensions"] = extension.hand_over(rest["extensions"])
    return [f"{key}={_typed(value)}" for key, value in files.flatten(rest).items()], stages


def _stages(given: Any) -> list[dict[str, Any]]:
    """Converts stages to plain data. Stages may be settings, mappings, or names in a list."""
    from swarmjax.task import stage_files

    def plain(stage: Any) -> dict[str, Any]:
        if isinstance(stage, Section):
            return to_dict(stage)
        return dict(stage) if isinstance(stage, Mapping) else stage_files.read_stage(str(stage))

    return [plain(each) for each in ([given] if isinstance(given, Section | Mapping) else given)]


def _typed(value: Any) -> str:
    """Writes a value as on a command line. Names, paths and words stay as they are."""
    return str(value) if isinstance(value, str | Path) else files.write(value)
