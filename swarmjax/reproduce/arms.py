"""Configures the arms of a reproduction and trains them with the ordinary trainer.

Each arm has its own run directory inside the directory of the reproduction. An arm that was stopped
continues where it stopped.
"""

from pathlib import Path

from swarmjax.config import files, to_dict
from swarmjax.reproduce.config import Arm, ReproduceConfig
from swarmjax.run.display import Display
from swarmjax.run.load_settings import load_run, load_train
from swarmjax.run.run import Run
from swarmjax.run.settings import TrainConfig
from swarmjax.run.signals import Stop

PAPER = ("algo=paper",)
# A million control steps are 244 updates with the default of 128 arenas x 32 steps, and 1,953
# updates with these 16 arenas x 32 steps.
MODERN = ("realism=webots", "arenas=16", "algo.rollout_length=32")
_STAGES = {"curriculum": "paper_curriculum", "baseline": "paper6"}


def settings(given: ReproduceConfig, arm: Arm, out: Path) -> TrainConfig:
    """Makes the config of an arm, for a new run or for the run that has begun in its directory.

    Args:
      given: settings of the reproduction.
      arm: the arm.
      out: directory of the reproduction.

    Raises:
      ConfigError: if the directory holds a run with other settings.
    """
    first, kind = arm.removesuffix("_expanded"), arm.removeprefix("modern_")
    trainer = [*PAPER]
    if arm.startswith("modern_"):
        task = files.flatten(to_dict(load_train(PAPER).task), "task.")
        trainer = [*MODERN, *(f"{key}={files.write(value)}" for key, value in task.items())]
    if arm == first:
        trainer += [f"stage={_STAGES[kind]}", f"budget={given.budget}"]
    else:
        trainer += ["stage=paper_expanded", f"budget={given.fine_tune}", f"init_from={out / first}"]
    return load_run(
        [
            *trainer,
            "robot=paper",
            f"seeds={given.seeds}",
            "seeds_by=cores",
            f"run.dir={out / arm}",
            "run.episodes=true",
            "run.tensorboard=false",
            "resume=auto",
        ]
    )


def run(made: TrainConfig, stop: Stop) -> None:
    """Trains an arm until it is done.

    Args:
      made: the arm's config, from `settings`.
      stop: watches signals and the time limit.

    Raises:
      ConfigError: if there is too little memory.
      StoppedError: if a stop was requested before the arm began.
      TrainingError: if a loss is no longer finite.
    """
    Run(made, stop=stop, display=Display()).train()
