"""Trains a grid of settings, with one job per cell, and prints a table at the end.

    python launch/sweep.py dir=runs/grid grid.algo.epochs=1,2 grid.arenas=64,128 seeds=5 stage=s3

trains four cells with five seeds each into `runs/grid/algo.epochs=1_arenas=64` and so on. Words
with other keys than this command's go to `python -m swarmjax.train`. A job that saves and ends with
code 75 is submitted again. If the command is started again with the same words, it skips finished
cells and resumes the others. `sweep.json` also has the table. Needs the extra `sweep`: uv sync
--extra gpu --extra sweep.
"""

import importlib.util
import itertools
import math
import os
import re
import shutil
import signal
import sys
import time
import traceback
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from swarmjax import command, words
from swarmjax.config import (
    ConfigError,
    Section,
    about,
    build,
    check_text,
    files,
    reading,
    section,
    show,
)
from swarmjax.exit_codes import FAILED, INTERRUPTED, REQUEUE, USER_ERROR
from swarmjax.policy import PolicyError
from swarmjax.report import table
from swarmjax.run import directory, heap
from swarmjax.run.errors import CheckpointError
from swarmjax.run.load_settings import load_run
from swarmjax.run.settings import TrainConfig

GRID = "grid."
MOST_CELLS = 256
# Keys that the sweep sets for each cell.
_OWN = ("resume", "run.dir", "run.distributed")
_TICK_S = 1.0
_SAVE_S = 180  # s between Slurm's signal and a job's end


@dataclass(frozen=True, kw_only=True)
class SweepConfig(Section):
    """Where and how to train the cells of a grid."""

    command: ClassVar[str] = ""

    dir: str = field(metadata=about("folder of the sweep, visible to all jobs"))
    cluster: Literal["slurm", "local", "debug"] = field(
        default="slurm",
        metadata=about(
            "slurm: jobs of Slurm; local: processes on this machine; debug: this process"
        ),
    )
    minutes: int = field(
        default=240,
        metadata=about("length of a job, after which it saves and is resubmitted", 5, 100_000),
    )
    cpus: int = field(default=8, metadata=about("CPUs of a job [slurm]", 1, 1024))
    gpus: int | None = field(
        default=None, metadata=about("GPUs of a job; null: its number of devices [slurm]", 0, 64)
    )
    tries: int = field(default=10, metadata=about("how often a job may be submitted", 1, 1000))
    at_once: int | None = field(
        default=None,
        metadata=about("most jobs at once; null: all [slurm], one [local, debug]", 1, MOST_CELLS),
    )


@dataclass(frozen=True, kw_only=True)
class GridCell:
    """One combination of a grid's values.

    Attributes:
      label: the values of the combination, as words.
      run: its run directory.
      words: words of the command line of `swarmjax.train` that begin or continue this run.
      settings: the config that these words give.
    """

    label: str
    run: Path
    words: tuple[str, ...]
    settings: TrainConfig

    @property
    def is_done(self) -> bool:
        """Whether the cell's run has spent its budget, or has reached its `run.stop_at`."""
        path = self.run / directory.SUMMARY
        found = reading.read_json(path) if path.exists() else None
        if not isinstance(found, dict):
            return False
        goal = self.settings.run.stop_at
        if goal is not None and found.get("stopped_at") == goal:
            return True
        return found.get("budget_spent") is True and found.get("updates") == self.settings.updates


def parse(arguments: Sequence[str]) -> tuple[SweepConfig, list[GridCell]]:
    """Makes the settings and the cells of a sweep from its `key=value` words.

    Raises:
      ConfigError: if a word is invalid, or jobs cannot be submitted here.
    """
    known = section.names(SweepConfig)
    mine = [word for word in arguments if word.partition("=")[0] in known]
    settings: SweepConfig = build(SweepConfig, files.parse(SweepConfig, mine))
    check_text("dir", settings.dir)
    cells = multiply(Path(settings.dir), [word for word in arguments if word not in mine])
    if importlib.util.find_spec("submitit") is None:
        raise ConfigError("submitit is missing: install it with uv sync --extra sweep.")
    for name in ("sbatch", "srun") if settings.cluster == "slurm" else ():
        if shutil.which(name) is None:
            raise ConfigError(
                f"cluster is slurm, but there is no {name} on the PATH: start the sweep where jobs "
                "are submitted, or give cluster=local."
            )
    return settings, cells


def multiply(folder: Path, typed: Sequence[str]) -> list[GridCell]:
    """Expands a grid into its cells.

    Args:
      folder: the folder for the run directories.
      typed: words `grid.KEY=VALUE,VALUE`, and words `KEY=VALUE` that all cells share.

    Returns:
      The cells. The values of the last key vary fastest.

    Raises:
      ConfigError: if a word or a cell is invalid, or if there are no cells or too many.
    """
    grid: dict[str, list[str]] = {}
    shared = []
    for word in typed:
        key, equals, value = word.partition("=")
        if not equals:
            raise ConfigError(f"{show(word)} is not a setting: give key=value.")
        if key.removeprefix(GRID) in _OWN:
            raise ConfigError(f"{key} cannot be given: each cell of the grid has its own.")
        _check_once(key, {*grid, *(each.partition("=")[0] for each in shared)})
        if key.startswith(GRID):
            grid[key.removeprefix(GRID)] = _values(key.removeprefix(GRID), value)
        else:
            shared.append(word)
    if not grid:
        raise ConfigError(f"the grid is empty: give values, as in {GRID}algo.epochs=1,2.")
    if math.prod(map(len, grid.values())) > MOST_CELLS:
        raise ConfigError(f"the grid has more than {MOST_CELLS} cells: give fewer values.")
    return _cells(folder, grid, shared)


def _check_once(key: str, given: set[str]) -> None:
    """Refuses a key that an earlier word has given."""
    if key.removeprefix(GRID) in given:
        raise ConfigError(f"{key.removeprefix(GRID)} is given twice: give each key once.")


def _values(key: str, text: str) -> list[str]:
    """Splits the values of a key, which are a list in YAML: `1,2` or `[1,2],[3]`."""
    found = reading.parse_yaml(f"[{text}]", f"{GRID}{key} is {show(text)}, which cannot be read: ")
    words = [each if isinstance(each, str) else files.write(each) for each in found or [""]]
    files.parse(TrainConfig, [f"{key}={word}" for word in words])
    return words


def _cells(folder: Path, grid: dict[str, list[str]], shared: Sequence[str]) -> list[GridCell]:
    """Loads the settings of each combination."""
    cells: dict[Path, GridCell] = {}
    for values in itertools.product(*grid.values()):
        mine = [f"{key}={value}" for key, value in zip(grid, values, strict=True)]
        run = folder / re.sub(r"[^\w.=+-]+", "-", re.sub(r"[][{}'\"]", "", "_".join(mine)))
        if run in cells:
            raise ConfigError(f"two cells of the grid would be {run}: give values that differ.")
        words = (*shared, *mine, "resume=auto", f"run.dir={run}")
        settings = load_run(words)
        cells[run] = GridCell(label=" ".join(mine), run=run, words=words, settings=settings)
    return list(cells.values())


def train(arguments: Sequence[str], visible: str | None) -> int:
    """Trains one cell, inside a job.

    Args:
      arguments: arguments for `python -m swarmjax.train`.
      visible: value to restore in CUDA_VISIBLE_DEVICES, which submitit changes; None: keep it.

    Returns:
      The exit code of that command.
    """
    if visible is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = visible
    heap.share()
    from swarmjax import train as training

    try:
        return training.main(arguments)
    except (ConfigError, PolicyError, CheckpointError) as error:
        sys.stderr.write(f"swarmjax.train: error: {error}\n")
        return USER_ERROR
    except Exception:  # submitit's debug executor would open a debugger
        traceback.print_exc()
        return FAILED


def work(cells: Sequence[GridCell], settings: SweepConfig) -> dict[str, int]:
    """Trains cells in jobs, and resubmits jobs that have saved but are not done.

    Returns:
      The last exit code of each cell, by its label.
    """
    waiting, running, codes = deque((cell, 1) for cell in cells), {}, {}
    most = settings.at_once or (MOST_CELLS if settings.cluster == "slurm" else 1)
    try:
        while waiting or running:
            while waiting and len(running) < most:
                cell, attempt = waiting[0]
                job = submit(cell, settings, is_first=not running)
                if job is None:
                    break
                waiting.popleft()
                running[job] = cell, attempt
                _say(f"{cell.label}: job {job.job_id}, try {attempt} of {settings.tries}")
            for job in [job for job in running if job.done()]:
                cell, attempt = running.pop(job)
                codes[cell.label] = _code(job, cell.label)
                if codes[cell.label] == REQUEUE and attempt < settings.tries:
                    waiting.append((cell, attempt + 1))
            time.sleep(_TICK_S if running else 0)
    finally:
        for job in running:
            job.cancel(check=False)
    return codes


def submit(cell: GridCell, settings: SweepConfig, *, is_first: bool = True) -> Any:
    """Submits the job of a cell.

    Args:
      cell: the cell to train.
      settings: settings of the sweep.
      is_first: whether no other job of the sweep is running. If one is, Slurm may accept this job
        after that one ends.

    Returns:
      submitit's handle of the job; None if Slurm accepts no more jobs at present.

    Raises:
      ConfigError: if Slurm accepts no job at all.
    """
    import submitit
    from submitit.core.utils import FailedJobError

    executor = submitit.AutoExecutor(Path(settings.dir) / "jobs", cluster=settings.cluster)
    executor.update_parameters(
        name="swarmjax",
        timeout_min=settings.minutes,
        gpus_per_node=cell.settings.devices if settings.gpus is None else settings.gpus,
        cpus_per_task=settings.cpus,
        slurm_signal_delay_s=_SAVE_S,
    )
    visible = os.environ.get("CUDA_VISIBLE_DEVICES") if settings.cluster == "local" else None
    try:
        return executor.submit(train, cell.words, visible)
    except FailedJobError as error:
        if not is_first:
            return None
        reason = str(error).strip().splitlines()[-1][:200]
        raise ConfigError(f"cluster is slurm, but it takes no job: {reason}.") from None


def _code(job: Any, label: str) -> int:
    """Returns the exit code of a finished job, and prints how it ended."""
    try:
        code = job.result()
    except Exception as error:  # the job was killed
        code, why = FAILED, f"died ({type(error).__name__})"
    else:
        why = {0: "done", REQUEUE: "saved"}.get(code, f"failed with code {code}")
    _say(f"{label}: {why}" + ("" if code in (0, REQUEUE) else f", see {job.paths.stderr}"))
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    return code


def _say(sentence: str) -> None:
    sys.stdout.write(f"{sentence}\n")
    sys.stdout.flush()


def main(arguments: Sequence[str]) -> int:
    """Runs the command and returns its exit code: 75 if some cells have saved but are not done."""
    settings, cells = parse(arguments)
    folder = Path(settings.dir)
    folder.mkdir(parents=True, exist_ok=True)
    left = [cell for cell in cells if not cell.is_done]
    _say(f"{words.count(len(cells), 'cell')}, {len(cells) - len(left)} of them done before")
    codes = dict.fromkeys((cell.label for cell in cells), 0) | work(left, settings)
    lines = table.read_each({cell.run: cell.label for cell in cells})
    found = {"words": list(arguments), "codes": codes, "cells": [line._asdict() for line in lines]}
    directory.write_json(folder / "sweep.json", found)
    if lines:
        _say(table.text(lines))
    failed = [label for label, code in codes.items() if code not in (0, REQUEUE)]
    return FAILED if failed else max(codes.values())


if __name__ == "__main__":
    for number in (signal.SIGTERM, signal.SIGHUP):  # like Ctrl-C, they cancel the jobs
        if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
            signal.signal(number, signal.default_int_handler)
    sys.exit(command.run("sweep", main, SweepConfig))
