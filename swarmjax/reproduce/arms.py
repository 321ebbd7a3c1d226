"""Configures the arms of a reproduction and trains them with the ordinary trainer.

Each arm has its own run directory inside the directory of the reproduction, and continues where it
stopped.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from swarmjax.config import ConfigError
from swarmjax.report import rows as report_rows
from swarmjax.reproduce.config import ARMS, Arm, ReproduceConfig
from swarmjax.run import compile_cache, lifecycle, memory
from swarmjax.run.display import Display
from swarmjax.run.load_settings import from_stored, load_train, read_config
from swarmjax.run.settings import TrainConfig
from swarmjax.run.signals import Stop

_EXPANDED, _MODERN = "_expanded", "modern_"
_STAGES = {"curriculum": "paper_curriculum", "baseline": "paper6"}
# A million control steps are 244 updates with the default 128 arenas x 32 steps, and 1,953 with
# these 16 x 32.
_FEW = ("arenas=16", "algo.rollout_length=32")


def settings(given: ReproduceConfig, arm: Arm, out: Path) -> TrainConfig:
    """Makes the config of an arm.

    Args:
      given: settings of the reproduction.
      arm: the arm.
      out: directory of the reproduction.

    Returns:
      The config of a new run.

    Raises:
      ConfigError: if the settings contradict each other.
    """
    kind = arm.removeprefix(_MODERN).removesuffix(_EXPANDED)
    expanded = arm.endswith(_EXPANDED)
    shared = [
        f"stage={'paper_expanded' if expanded else _STAGES[kind]}",
        f"budget={given.fine_tune if expanded else given.budget}",
        *(f"{key}={getattr(given, key)}" for key in ("robot", "seed", "seeds", "seeds_by")),
        f"sim.impl={given.impl}",
        f"task.step_limit={given.step_limit}",
        f"curriculum.threshold={given.threshold}",
        f"run.dir={out / arm}",
        "run.episodes=true",
        "run.tensorboard=false",
    ]
    paper = load_train(
        [
            "algo=paper",
            *shared,
            *(
                f"algo.{key}={getattr(given, key)}"
                for key in ("rollout_length", "epochs", "time_out")
            ),
            *([f"init_from={out / kind}"] if expanded else []),
        ]
    )
    if not arm.startswith(_MODERN):
        return paper
    modern = load_train(["realism=webots", *shared, *_FEW])
    return replace(modern, task=paper.task)


def run(made: TrainConfig, stop: Stop) -> bool:
    """Trains an arm until it is done or a stop is requested.

    Args:
      made: the arm's config, from `settings`.
      stop: watches signals and the time limit.

    Returns:
      Whether the arm's budget is spent.

    Raises:
      ConfigError: if the directory holds another run, or memory is short.
      TrainingError: if a loss is no longer finite.
    """
    directory = Path(made.run.dir or "")
    made = _go_on(made, directory)
    with (
        compile_cache.use(made.run.compile_cache),
        memory.refusal(made),
        Display(made.updates) as display,
    ):
        tally = lifecycle.carry_out(made, directory, stop, display)
    return tally.update >= made.updates


def _go_on(made: TrainConfig, directory: Path) -> TrainConfig:
    """Resumes an arm that has begun; without a checkpoint it begins from its seed."""
    if not (directory / "config.json").exists():
        return made
    stored = from_stored(read_config(directory), "stored ")
    run = replace(made.run, dir=stored.run.dir, id=stored.run.id)
    kept = replace(made, run=run, init_from=stored.init_from)
    if kept != stored:
        raise ConfigError(
            f"{directory} holds a run whose config differs from the one that this version makes: "
            "give another out."
        )
    return replace(made, run=run, resume=str(directory))


def summaries(out: Path) -> dict[Arm, dict[str, Any]]:
    """Reads the summaries of the arms that are done.

    Args:
      out: directory of the reproduction.

    Returns:
      The `summary.json` of each arm, in the order of `ARMS`.
    """
    found = {}
    for arm in ARMS:
        path = out / arm / "summary.json"
        if path.exists():
            summary = report_rows.read_object(path)
            if summary.get("budget_spent"):
                found[arm] = summary
    return found
