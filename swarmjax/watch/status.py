"""Finds out from a run's directory whether the run trains, has ended or has stopped early."""

import time
from pathlib import Path
from typing import Literal, NamedTuple

from swarmjax import command, words
from swarmjax.report.rows import History
from swarmjax.run import directory
from swarmjax.run.settings import TrainConfig

# s. The process of a run on another machine cannot be seen, so the run counts as training until it
# has written nothing for this long.
SILENT_S = 120.0


class RunStatus(NamedTuple):
    """State of a run, as a word for programs and as a sentence for people."""

    state: Literal["trains", "ended", "stopped"]
    sentence: str


def read(run: Path, trained: TrainConfig, history: History | None) -> RunStatus:
    """Returns the current state of a run.

    Args:
      run: the run's directory.
      trained: the run's config.
      history: the run's logged results; None before the first update.
    """
    done = 0 if history is None else int(history.updates[-1]) + 1
    so_far = f"{done:,} of {words.count(trained.updates, 'update')}"
    if _trains(run):
        left = ""
        if history is not None and history.seconds is not None:
            seconds = history.seconds / done * (trained.updates - done)
            left = f", about {words.duration(round(seconds))} left"
        return RunStatus("trains", f"It trains: {so_far} done{left}.")
    why = ", run.stop_at is reached" if history is not None and history.has_reached else ""
    if why or done >= trained.updates:
        return RunStatus("ended", f"It has ended: {so_far} done{why}.")
    resume = command.line("train", f"resume={run}")
    return RunStatus("stopped", f"It has stopped after {so_far}. Go on with: {resume}")


def _trains(run: Path) -> bool:
    is_written = directory.is_written(run)
    if is_written is not None:
        return is_written
    try:
        return time.time() - (run / directory.METRICS).stat().st_mtime < SILENT_S
    except OSError:
        return False
