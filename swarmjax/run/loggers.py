"""Sends a run's metrics to loggers: TensorBoard, W&B and your own.

`metrics.jsonl` is the run's own record. `metrics.jsonl` is written first, checkpoints record its
length, and a run that cannot write it ends. A logger holds nothing beyond this record, so a failure
of a logger does not end the run.
"""

import queue
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from swarmjax.run.directory import Row

PATIENCE_S = 60.0  # seconds that a run waits at its end for a logger


@runtime_checkable
class Logger(Protocol):
    """A destination for a run's metrics.

    - Each logger has its own thread, which makes all calls one after the other. `close` is the last
      call.
    - The rows are those of `metrics.jsonl`, sorted by update, then by seed. The first row of a
      resumed run is that of the update after its checkpoint.
    - If a call raises an error, or the calls have not ended `PATIENCE_S` seconds after the run's
      last one, the run prints a message and goes on without the logger.

    Attributes:
      name: name of the logger in messages.
    """

    name: str

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Receives the rows of a call. Do not change the rows: other loggers read them too.

        Args:
          rows: one for each update and seed, as `recorder.rows` makes them.
          speeds: speeds of the call, summed over all seeds, such as `arena_steps_per_s`.
        """
        ...

    def close(self) -> None:
        """Closes the logger. No call follows."""
        ...


class Guarded:
    """Calls a logger in a thread, so that it can neither slow down nor stop the run."""

    def __init__(self, logger: Logger) -> None:
        """Starts the thread, but does not call the logger yet."""
        self._logger, self._is_lost = logger, False
        self._calls: queue.SimpleQueue[tuple[Sequence[Row], Row] | None] = queue.SimpleQueue()
        # A daemon, because at exit Python would wait for other threads, perhaps forever.
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Queues the rows of a call of the program for the thread."""
        self._calls.put((rows, speeds))

    def close(self) -> None:
        """Waits until everything is written, for at most `PATIENCE_S` seconds."""
        self._calls.put(None)
        self._thread.join(PATIENCE_S)
        if self._thread.is_alive():
            self._lose(f"it has not finished all calls after {PATIENCE_S:g} s")

    def _work(self) -> None:
        while (call := self._calls.get()) is not None:
            if not self._is_lost:
                self._try(self._logger.write, *call)
        self._try(self._logger.close)

    def _try(self, method: Callable[..., None], *arguments: object) -> None:
        try:
            method(*arguments)
        except BaseException as error:  # anything that a library or a user's function raises
            first = (str(error).splitlines() or [""])[0][:200].rstrip(".")
            self._lose(f"{type(error).__name__}: {first}")

    def _lose(self, why: str) -> None:
        """Stops calling the logger; the first time, also reports why."""
        if not self._is_lost:
            self._is_lost = True
            sys.stderr.write(f"swarmjax: {self._logger.name} gets no more data: {why}.\n")
