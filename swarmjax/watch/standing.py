"""Says whether a run trains, has ended, was stopped or was killed, from its directory alone."""

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

# s; a run elsewhere, whose process cannot be seen, that has written nothing for so long is silent.
SILENT_S = 120.0
_TAIL = 2**22  # bytes that hold the newest rows of all seeds


class Standing(NamedTuple):
    """How a run stands.

    Attributes:
      state: `trains` or `elsewhere` while it goes on; `ended`, with its budget spent; `stopped`,
        with all saved; `killed`, or broken, with the rest of its budget open; `silent`: gone,
        or on another machine and not heard of.
      sentence: says so to a person.
    """

    state: Literal["trains", "elsewhere", "ended", "stopped", "killed", "silent"]
    sentence: str


class Progress(NamedTuple):
    """How far a run is.

    Attributes:
      done: updates that all seeds have written down.
      seconds: that training took them; None if it was not written down.
    """

    done: int = 0
    seconds: float | None = None


def progress(run: Path, seeds: int) -> Progress:
    """Reads how far a run is from the end of its metrics; a line without an end counts for nothing.

    Args:
      run: its directory.
      seeds: how many write an update down.
    """
    try:
        with (run / directory.METRICS).open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL))
            *lines, _ = file.read().split(b"\n")
        newest = [json.loads(line) for line in lines[-seeds:]]
        done = min(int(row["update"]) for row in newest) + 1 if len(newest) == seeds else 0
        seconds = newest[-1].get("train_s") if newest else None
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return Progress()
    return Progress(done, seconds if isinstance(seconds, int | float) else None)


def stand(run: Path, trained: TrainConfig) -> Standing:
    """Says how a run stands now.

    Args:
      run: its directory.
      trained: its config.
    """
    if not (run / directory.CONFIG).exists():
        return Standing("silent", f"{run} is gone.")
    found, writer, age = progress(run, trained.seeds), directory.writer(run), _age(run)
    so_far = f"{found.done:,} of {words.count(trained.updates, 'update')}"
    if writer is not None and writer.is_here and directory.is_writing(writer):
        left = _left(trained, found)
        return Standing("trains", f"It trains: {so_far} done{left}; {_written(age)}.")
    if found.done >= trained.updates:
        return Standing("ended", f"It has ended: all {words.count(found.done, 'update')} are done.")
    on = f"Go on with: {command.line('train', f'resume={run}')}"
    if found.done and _summed_up(run) == found.done:
        return Standing("stopped", f"It was stopped after {so_far}, with all saved. {on}")
    if writer is not None and not writer.is_here:
        return _elsewhere(f"{so_far} done on {writer.host}", age)
    saved = "" if (run / CHECKPOINTS).exists() else " It had saved nothing."
    return Standing(
        "killed", f"It was killed, or broke, after {so_far}; {_written(age)}.{saved} {on}"
    )


def _elsewhere(so_far: str, age: float | None) -> Standing:
    """Says how a run stands whose process another machine has."""
    if age is not None and age < SILENT_S:
        return Standing("elsewhere", f"It trains: {so_far}; {_written(age)}.")
    return Standing(
        "silent", f"It was killed or still trains: {so_far}, which cannot be seen; {_written(age)}."
    )


def _age(run: Path) -> float | None:
    """Returns the seconds since the run wrote down an update; None if it has none."""
    try:
        found = (run / directory.METRICS).stat()
    except OSError:
        return None
    return max(0.0, time.time() - found.st_mtime) if found.st_size else None


def _written(age: float | None) -> str:
    if age is None:
        return "no update is written yet"
    return f"the newest was written {words.duration(round(age))} ago"


def _left(trained: TrainConfig, found: Progress) -> str:
    """Says how long a run will take, by the mean of its updates so far."""
    if not found.done or found.seconds is None or found.done >= trained.updates:
        return ""
    seconds = found.seconds / found.done * (trained.updates - found.done)
    return f", about {words.duration(round(seconds))} left"


def _summed_up(run: Path) -> int | None:
    """Returns the updates of the summary, the last file that a run writes; None without one."""
    try:
        found = rows.read_object(run / directory.SUMMARY).get("updates")
    except (ConfigError, OSError):
        return None
    return found if isinstance(found, int) else None
