"""Where a run's figures go besides its own files: TensorBoard, W&B and functions.

`metrics.jsonl` is the run's own record: it is written first, checkpoints count it, and a run that
cannot write it ends. A logger holds nothing that the record does not, so that none ends a run.
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

MOST_PENDING = 100  # calls of the program that a logger may be behind
PATIENCE_S = 60.0  # s, that a run waits for a logger which is so far behind, and at its end


@runtime_checkable
class Logger(Protocol):
    """A place for a run's figures.

    What is guaranteed, where the run calls it (`Guarded`):

    - All calls come from one thread of the logger's own, one after the other; `close` is the last.
    - Rows are those of `metrics.jsonl`, value by value. They come in the order of the updates, the
      seeds of an update together, and each comes once.
    - A run that goes on from a checkpoint, or goes back to one after it diverged, writes the rows
      after the checkpoint again: `update` falls, and what came later counts. Without divergence
      they are the same numbers as before, but for seconds.
    - What raises is not called again, but for `close`. A sentence says so, and the run goes on.
    - A run waits for a logger that is `MOST_PENDING` calls behind, and at its end, but never longer
      than `PATIENCE_S`; then it goes on without.

    Attributes:
      name: what sentences call it.
    """

    name: str

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Takes the rows of a call of the program, which others read too.

        Args:
          rows: an update and seed each, as `recorder.rows` makes them.
          speeds: of the call, all seeds together: `arena_steps_per_s` and so on.
        """
        ...

    def attach(self, name: str, path: Path, arena_steps: int) -> None:
        """Takes a figure, or the place of a page.

        Args:
          name: of the figure or page.
          path: of a file; a figure is a PNG.
          arena_steps: of a seed, which the run had done.
        """
        ...

    def close(self) -> None:
        """Ends; nothing comes after it."""
        ...


class Calls:
    """Calls a function of Python's with each row."""

    name = "log"

    def __init__(self, call: Callable[[Row], object]) -> None:
        """Keeps the function, whose answers count for nothing."""
        self._call = call

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Hands on a copy of each row: the function may keep or change it."""
        del speeds
        for row in rows:
            self._call(copy.deepcopy(row))

    def attach(self, name: str, path: Path, arena_steps: int) -> None:
        """Takes nothing: a function of rows has no place for it."""

    def close(self) -> None:
        """Does nothing."""


class Guarded:
    """Calls a logger in a thread, so that neither its pace nor its failure is the run's."""

    def __init__(self, logger: Logger) -> None:
        """Calls nothing yet."""
        self._logger = logger
        self._jobs: queue.Queue[tuple[Callable[..., None], tuple] | None] = queue.Queue(
            MOST_PENDING
        )
        # Python does not wait for a daemon at its end, which could be for ever.
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._lost = False

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Has the rows of a call written."""
        self._put((self._logger.write, (rows, speeds)))

    def attach(self, name: str, path: Path, arena_steps: int) -> None:
        """Has a figure or the place of a page written."""
        self._put((self._logger.attach, (name, path, arena_steps)))

    def close(self) -> None:
        """Waits until everything is written, at most `PATIENCE_S`."""
        if not self._thread.ident:  # nothing was written
            return
        self._put(None)
        self._thread.join(0.0 if self._lost and self._jobs.full() else PATIENCE_S)
        if self._thread.is_alive():
            self._lose(f"it has not taken everything after {PATIENCE_S:g} s")

    def _put(self, job: tuple[Callable[..., None], tuple] | None) -> None:
        """Hands a job over; None is the last."""
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
        except BaseException as error:  # of a library or a user's function
            self._lose(_why(error))

    def _lose(self, why: str) -> None:
        """Calls the logger no more, and says so once."""
        if self._lost:
            return
        self._lost = True
        with contextlib.suppress(OSError, ValueError):  # a terminal that is gone
            sys.stderr.write(f"swarmjax: {self._logger.name} is not written from here on: {why}.\n")


def _why(error: BaseException) -> str:
    """Says in one line what went wrong."""
    text = (str(error).strip().splitlines() or [""])[0][:200].rstrip(".")
    if text and isinstance(error, OSError | ImportError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
