"""Finds out from its directory whether a run trains, has ended, was stopped or was killed."""

import json
import os
import time
from pathlib import Path
from typing import Literal, NamedTuple

from swarmjax import command, words
from swarmjax.config import ConfigError
from swarmjax.report import rows
from swarmjax.run import directory
from swarmjax.run.hosts import CHECKPOINTS
from swarmjax.run.settings import TrainConfig

# s. The process of a run on another machine cannot be seen. If the run has written nothing for
# this long, it counts as silent.
SILENT_S = 120.0
_TAIL = 2**22  # bytes that hold the newest rows of all seeds


class RunStatus(NamedTuple):
    """State of a run.

    Attributes:
      state: one of these. `trains`: on this machine. `elsewhere`: trains on another machine.
        `ended`: its budget is spent. `stopped`: it saved everything before it stopped. `killed`:
        killed or crashed. `silent`: its directory is gone, or it is on another machine and has
        written nothing for a while.
      sentence: the same for a person to read.
    """

    state: Literal["trains", "elsewhere", "ended", "stopped", "killed", "silent"]
    sentence: str


class Progress(NamedTuple):
    """Progress of a run.

    Attributes:
      done: updates that all seeds have logged.
      seconds: training time for these updates; None if it was not logged.
    """

    done: int = 0
    seconds: float | None = None


def progress(run: Path, seeds: int) -> Progress:
    """Reads the progress of a run from the end of its metrics, and ignores an unfinished line.

    Args:
      run: its directory.
      seeds: number of seeds. Each seed logs each update.
    """
    try:
        with (run / directory.METRICS).open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL))
            *lines, _ = file.read().split(b"\n")
        newest = [json.loads(line) for line in lines[-seeds:]]
        done = min(int(row["update"]) for row in newest) + 1 if len(newest) == seeds else 0
        seconds = newest[-1].get("train_s") if newest else None
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        ArithmeticError,
        RecursionError,
    ):
        return Progress()
    return Progress(done, seconds if isinstance(seconds, int | float) else None)


def read(run: Path, trained: TrainConfig) -> RunStatus:
    """Returns the current state of a run.

    Args:
      run: its directory.
      trained: its config.
    """
    if not (run / directory.CONFIG).exists():
        return RunStatus("silent", f"{run} is gone.")
    try:
        directory.check_regular(run)
    except ConfigError as error:
        return RunStatus("silent", str(error))
    logged, writer, age = progress(run, trained.seeds), directory.writer(run), _age(run)
    so_far = f"{logged.done:,} of {words.count(trained.updates, 'update')}"
    if writer is not None and writer.is_here and directory.is_writing(writer):
        left = _left(trained, logged)
        return RunStatus("trains", f"It trains: {so_far} done{left}; {_written(age)}.")
    if logged.done >= trained.updates:
        return RunStatus(
            "ended", f"It has ended: all {words.count(logged.done, 'update')} are done."
        )
    on = f"Go on with: {command.line('train', f'resume={run}')}"
    if logged.done and _summed_up(run) == logged.done:
        return RunStatus("stopped", f"It was stopped after {so_far}, with all saved. {on}")
    if writer is not None and not writer.is_here:
        return _elsewhere(f"{so_far} done on {writer.host}", age)
    saved = "" if (run / CHECKPOINTS).exists() else " It had saved nothing."
    return RunStatus(
        "killed", f"It was killed, or broke, after {so_far}; {_written(age)}.{saved} {on}"
    )


def _elsewhere(so_far: str, age: float | None) -> RunStatus:
    """Returns the state of a run whose process is on another machine."""
    if age is not None and age < SILENT_S:
        return RunStatus("elsewhere", f"It trains: {so_far}; {_written(age)}.")
    return RunStatus(
        "silent",
        f"It was killed or is still training, and this machine cannot tell which: {so_far}; "
        f"{_written(age)}.",
    )


def _age(run: Path) -> float | None:
    """Returns the seconds since the run last logged an update; None if it has logged none."""
    try:
        file = (run / directory.METRICS).stat()
    except OSError:
        return None
    return max(0.0, time.time() - file.st_mtime) if file.st_size else None


def _written(age: float | None) -> str:
    if age is None:
        return "no update is written yet"
    return f"the newest update was written {words.duration(round(age))} ago"


def _left(trained: TrainConfig, logged: Progress) -> str:
    """Describes the time that a run has left, from its mean time per update."""
    if not logged.done or logged.seconds is None or logged.done >= trained.updates:
        return ""
    seconds = logged.seconds / logged.done * (trained.updates - logged.done)
    return f", about {words.duration(round(seconds))} left"


def _summed_up(run: Path) -> int | None:
    """Returns the updates in the summary, the last file that a run writes; None without one."""
    try:
        updates = rows.read_object(run / directory.SUMMARY).get("updates")
    except (ConfigError, OSError):
        return None
    return updates if isinstance(updates, int) else None
