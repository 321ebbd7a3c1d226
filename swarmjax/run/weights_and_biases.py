"""Logs to Weights & Biases, one W&B run per seed. With WANDB_MODE=offline, W&B writes files."""

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from swarmjax.config import ConfigError, show, to_dict
from swarmjax.run.directory import Row
from swarmjax.run.settings import TrainConfig
from swarmjax.run.tensorboard import BOARDS, numbers


def check(settings: TrainConfig) -> None:
    """Refuses a run that asks for W&B if W&B is not installed.

    Raises:
      ConfigError: if the library `wandb` is missing.
    """
    # Python imports W&B's data folder `wandb` as a package without code.
    if settings.run.wandb is not None and not hasattr(_wandb(), "init"):
        raise ConfigError(
            f"run.wandb is {show(settings.run.wandb)}, but W&B is not installed: install the "
            "extra wandb, as in `uv sync --extra wandb`, or give run.wandb=null."
        )


class WandbRuns:
    """A `Logger` that writes one W&B run for each of the first `BOARDS` seeds, in one group."""

    name = "W&B"

    def __init__(self, settings: TrainConfig, run: Path) -> None:
        """Opens nothing yet, because W&B takes seconds to start."""
        self._settings, self._run = settings, run
        self._open: dict[int, Any] = {}

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Writes the numbers of each row, together with the speeds of the call."""
        self._open = self._open or {k: self._start(k) for k in self._settings.numbers[:BOARDS]}
        for row in rows:
            if row["seed"] in self._open:
                found = numbers(row | speeds, self._settings.stage_names)
                self._open[row["seed"]].log(found)

    def close(self) -> None:
        """Waits until everything is written and sent."""
        for each in self._open.values():
            each.finish()

    def _start(self, seed: int) -> Any:
        """Starts the W&B run of a seed, or continues it if the run is resumed."""
        wandb, asked = _wandb(), self._settings.run
        run = wandb.init(
            project=asked.wandb,
            dir=str(self._run),
            group=asked.id,
            name=f"{self._run.name}-seed{seed}",
            id=f"{asked.id}-seed{seed}",
            resume="allow",
            config=to_dict(self._settings),
            reinit="create_new",
            settings=wandb.Settings(silent=True, console="off"),
        )
        run.define_metric("*", step_metric="arena_steps")
        return run


def _wandb() -> Any:
    """Imports the library, which is an optional extra and takes seconds; None if it is missing."""
    try:
        return importlib.import_module("wandb")
    except ImportError:
        return None
