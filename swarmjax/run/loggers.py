"""Sends a run's figures to loggers: TensorBoard, W&B and Python functions.

`metrics.jsonl` is the run's own record. This file is written first, checkpoints record its length,
and a run that cannot write it ends. A logger holds nothing beyond this record, so its failure does
not end a run.
"""

import contextlib
import copy
import queue
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from swarmjax.run.directory import Row

MOST_PENDING = 100  # how many calls of the program a logger may lag behind
# Seconds that a run waits for a logger that lags further behind. At its end, the run waits as long
# for each logger.
PATIENCE_S = 60.0


@runtime_checkable
class Logger(Protocol):
    """A destination for a run's figures.

    The run calls it through `Guarded`, which guarantees:

    - All calls come from one dedicated thread, one after the other. `close` is the last.
    - The rows are those of `metrics.jsonl`, value by value. Each row comes once, in the order of
      the updates, with the seeds of an update together.
    - If a run resumes from a checkpoint, or goes back to one after it diverged, the rows after the
      checkpoint come again. Then `update` drops, and the later rows are the valid ones. If the run
      did not diverge, the later rows equal the earlier rows, except for times in seconds.
    - A logger that raises an error is not called again, except for `close`. The run prints a
      message and continues.
    - A run waits for a logger that lags `MOST_PENDING` calls behind. At its end, the run waits for
      every logger. After `PATIENCE_S` it continues without that logger.

    Attributes:
      name: name of the logger in messages.
    """

    name: str

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Receives the rows of a call. Other loggers read the same rows, so do not change them.

        Args:
          rows: one for each update and seed, as `recorder.rows` makes them.
          speeds: speeds of the call over all seeds, such as `arena_steps_per_s`.
        """
        ...

    def attach(self, name: str, path: Path, arena_steps: int) -> None:
        """Receives a figure or the path of a page.

        Args:
          name: name of the figure or page.
          path: path of the file; a figure is a PNG.
          arena_steps: arena steps per seed that the run has done so far.
        """
        ...

    def close(self) -> None:
        """Closes the logger. No call follows."""
        ...


class Calls:
    """Calls a Python function with each row."""

    name = "log"

    def __init__(self, call: Callable[[Row], object]) -> None:
        """Stores the function. What the function returns is ignored."""
        self._call = call

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Passes a copy of each row, since the function may keep or change it."""
        del speeds
        for row in rows:
            self._call(copy.deepcopy(row))

    def attach(self, name: str, path: Path, arena_steps: int) -> None:
        """Does nothing, since the function accepts only rows."""

    def close(self) -> None:
        """Does nothing."""


class Guarded:
    """Calls a logger in a thread, so that it can neither slow down nor stop the run."""

    def __init__(self, logger: Logger) -> None:
        """Prepares the thread, but calls nothing yet."""
        self._logger = logger
        self._jobs: queue.Queue[tuple[Callable[..., None], tuple] | None] = queue.Queue(
            MOST_PENDING
        )
        # A daemon, because at exit Python would wait for other threads, perhaps forever.
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._lost = False

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Queues the rows of a call."""
        self._put((self._logger.write, (rows, speeds)))

    def attach(self, name: str, path: Path, arena_steps: int) -> None:
        """Queues a figure or the path of a page."""
        self._put((self._logger.attach, (name, path, arena_steps)))

    def close(self) -> None:
        """Waits until everything is written, for at most `PATIENCE_S`."""
        if not self._thread.ident:  # nothing was written
            return
        self._put(None)
        self._thread.join(0.0 if self._lost and self._jobs.full() else PATIENCE_S)
        if self._thread.is_alive():
            self._lose(f"it has not finished all calls after {PATIENCE_S:g} s")

    def _put(self, job: tuple[Callable[..., None], tuple] | None) -> None:
        """Queues a job. None ends the thread."""
        if not self._thread.ident:
            self._thread.start()
        try:
            self._jobs.put(job, timeout=0.0 if self._lost else PATIENCE_S)
        except queue.Full:
            self._lose(f"it has been {MOST_PENDING} calls behind for {PATIENCE_S:g} s")

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            what, arguments = job
            if not self._lost:
                self._try(what, *arguments)
        self._try(self._logger.close)

    def _try(self, what: Callable[..., None], *arguments: Any) -> None:
        try:
            what(*arguments)
        except BaseException as error:  # anything that a library or a user's function raises
            self._lose(_why(error))

    def _lose(self, why: str) -> None:
        """Stops calling the logger, and reports this once."""
        if self._lost:
            return
        self._lost = True
        with contextlib.suppress(OSError, ValueError):  # the terminal may be gone
            sys.stderr.write(f"swarmjax: {self._logger.name} is not written from here on: {why}.\n")


def _why(error: BaseException) -> str:
    """Describes an error in one line."""
    text = (str(error).strip().splitlines() or [""])[0][:200].rstrip(".")
    if text and isinstance(error, OSError | ImportError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
