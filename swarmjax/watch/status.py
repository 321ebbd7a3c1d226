"""Finds out from its directory whether a run trains, has ended or has stopped early."""

import json
import os
import time
from pathlib import Path
from typing import Any, Literal, NamedTuple

from swarmjax import command, words
from swarmjax.run import directory
from swarmjax.run.settings import TrainConfig

# s. The process of a run on another machine cannot be seen, so the run counts as training until it
# has written nothing for this long.
SILENT_S = 120.0
_TAIL = 2**22  # bytes that hold the newest rows of all seeds


class RunStatus(NamedTuple):
    """State of a run, also as a sentence for a person to read."""

    state: Literal["trains", "ended", "stopped"]
    sentence: str


class Progress(NamedTuple):
    """Progress of a run.

    Attributes:
      done: updates that all seeds have logged.
      seconds: training time for these updates; None if it was not logged.
      age: seconds since the newest update was written; None if there is none.
    """

    done: int = 0
    seconds: float | None = None
    age: float | None = None


def progress(run: Path, seeds: int) -> Progress:
    """Reads the progress of a run from the end of its metrics, and ignores an unfinished line.

    Args:
      run: its directory.
      seeds: number of seeds. Each seed logs each update.
    """
    path = run / directory.METRICS
    try:
        with path.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL))
            *lines, _ = file.read().split(b"\n")
        newest: list[Any] = [json.loads(line) for line in lines[-seeds:]]
        if len(newest) < seeds:
            return Progress()
        done = min(int(row["update"]) for row in newest) + 1
        age = max(0.0, time.time() - path.stat().st_mtime)
        return Progress(done, newest[-1].get("train_s"), age)
    # A damaged line; the report of the run names it.
    except (OSError, ValueError, TypeError, LookupError, OverflowError, RecursionError):
        return Progress()


def read(run: Path, trained: TrainConfig) -> RunStatus:
    """Returns the current state of a run.

    Args:
      run: its directory.
      trained: its config.
    """
    logged = progress(run, trained.seeds)
    so_far = f"{logged.done:,} of {words.count(trained.updates, 'update')}"
    if _trains(run, logged):
        return RunStatus("trains", f"It trains: {so_far} done{_left(trained, logged)}.")
    if logged.done >= trained.updates:
        return RunStatus("ended", f"It has ended: {so_far} done.")
    resume = command.line("train", f"resume={run}")
    return RunStatus("stopped", f"It has stopped after {so_far}. Go on with: {resume}")


def _trains(run: Path, logged: Progress) -> bool:
    is_written = directory.is_written(run)
    if is_written is None:
        return logged.age is not None and logged.age < SILENT_S
    return is_written


def _left(trained: TrainConfig, logged: Progress) -> str:
    """Describes the time that a run has left, from its mean time per update."""
    if not logged.done or logged.seconds is None:
        return ""
    seconds = logged.seconds / logged.done * (trained.updates - logged.done)
    return f", about {words.duration(round(seconds))} left"
