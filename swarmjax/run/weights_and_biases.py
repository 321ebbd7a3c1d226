"""Logs to Weights & Biases: one W&B run for each seed, on their server or only in files."""

import importlib
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from swarmjax.config import ConfigError, show, to_dict
from swarmjax.run.directory import Row
from swarmjax.run.settings import TrainConfig
from swarmjax.run.tensorboard import BOARDS, numbers

EXTRA = "wandb"


def check(settings: TrainConfig) -> None:
    """Refuses a run that asks for W&B where it cannot be used.

    Raises:
      ConfigError: if the library is missing, or if it has no key in online mode.
    """
    if settings.run.wandb is None:
        return
    found = importlib.util.find_spec("wandb")
    # Python would find W&B's data folder `wandb` as a package without code.
    if found is None or found.origin is None:
        raise ConfigError(
            f"run.wandb is {show(settings.run.wandb)}, but W&B is not installed: install the "
            f"extra {EXTRA}, as in `uv sync --extra {EXTRA}`, or give run.wandb=null."
        )
    if settings.run.wandb_mode == "online":
        _sign_in()


def _sign_in() -> None:
    try:
        signed = _wandb().login(verify=False, prompt=False)
    except Exception:  # W&B raises errors of its own types
        signed = False
    if not signed:
        raise ConfigError(
            "run.wandb_mode is online, but W&B has no key: run `wandb login` first, or give "
            "run.wandb_mode=offline."
        )


class WandbRuns:
    """A `Logger` that writes one W&B run for each seed.

    Each of the first `BOARDS` seeds has a W&B run. All these W&B runs are in one group. Online, a
    resumed run continues them on the server. Offline, each process writes new W&B runs in the same
    group. W&B receives nothing about the machine: not its name, load, source code or console
    output.
    """

    name = "W&B"

    def __init__(self, settings: TrainConfig, run: Path) -> None:
        """Opens nothing yet, because W&B takes seconds to start."""
        self._settings, self._run = settings, run
        self._seeds = settings.numbers[:BOARDS]
        self._open: dict[int, Any] = {}

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Writes the numbers of each row. The first seed's last row also gets the speeds."""
        mine = [row for row in rows if row["seed"] in self._seeds]
        last = [row for row in mine if row["seed"] == self._seeds[0]][-1]
        for row in mine:
            told = row | speeds if row is last else row
            self._of(row["seed"]).log(numbers(told, self._settings.stage_names))

    def attach(self, name: str, path: Path, arena_steps: int) -> None:
        """Writes a PNG as an image, or a page as HTML, to the first seed's run."""
        wandb = _wandb()
        made = wandb.Image(str(path)) if path.suffix == ".png" else wandb.Html(path.read_text())
        self._of(self._seeds[0]).log({name: made, "arena_steps": arena_steps})

    def close(self) -> None:
        """Waits until everything is written and sent."""
        for each in self._open.values():
            each.finish()

    def _of(self, seed: int) -> Any:
        """Returns the W&B run of a seed, and starts it if necessary."""
        if seed not in self._open:
            self._open[seed] = self._start(seed)
        return self._open[seed]

    def _start(self, seed: int) -> Any:
        """Starts or continues the W&B run of a seed."""
        wandb = _wandb()
        asked, online = self._settings.run, self._settings.run.wandb_mode == "online"
        run = wandb.init(
            project=asked.wandb,
            dir=str(self._run),
            mode=asked.wandb_mode,
            group=asked.id,
            name=f"{self._run.name}-seed{seed}",
            id=f"{asked.id}-seed{seed}" if online else None,
            resume="allow" if online else None,
            config=to_dict(self._settings),
            reinit="create_new",
            settings=wandb.Settings(
                silent=True,
                console="off",
                disable_git=True,
                disable_code=True,
                host="",
                x_disable_meta=True,
                x_save_requirements=False,
                x_disable_stats=True,
            ),
        )
        run.define_metric("*", step_metric="arena_steps")
        return run


def _wandb() -> Any:
    """Imports the library, which is an optional extra and takes seconds to import."""
    return importlib.import_module("wandb")
