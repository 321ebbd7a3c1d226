"""Hands the figures of a report to the loggers of its run."""

from collections.abc import Sequence
from pathlib import Path

from swarmjax.config import ConfigError
from swarmjax.report.rows import History
from swarmjax.run import weights_and_biases
from swarmjax.run.loggers import Guarded, Logger
from swarmjax.run.tensorboard import Boards
from swarmjax.run.weights_and_biases import WandbRuns


def of_run(run: Path, history: History) -> list[Logger]:
    """Makes the loggers that a run's config names.

    Raises:
      ConfigError: if the config names no logger, or one that cannot be used.
    """
    asked = history.config.run
    weights_and_biases.check(history.config)
    boards = Boards(run, history.config.numbers, history.names)
    loggers: list[Logger] = [boards] if asked.tensorboard else []
    loggers += [WandbRuns(history.config, run)] if asked.wandb else []
    if not loggers:
        raise ConfigError(
            "send is true, but the run has no logger for figures: its run.tensorboard is false and "
            "its run.wandb is null."
        )
    return loggers


def send(history: History, files: Sequence[Path], loggers: Sequence[Logger]) -> None:
    """Hands files to loggers and closes the loggers. A logger that fails only prints a message.

    Args:
      history: the run's history.
      files: figures, each a PNG, and pages.
      loggers: the loggers that get the files.
    """
    steps = int(history.arena_steps[-1])
    for guarded in map(Guarded, loggers):
        for path in files:
            kind = "report" if path.suffix == ".png" else "page"
            guarded.attach(f"{kind}/{path.stem}", path, steps)
        guarded.close()
