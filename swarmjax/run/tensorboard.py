"""Writes TensorBoard events with tensorboardX, into one folder for each seed of a run."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from swarmjax.run.directory import Row

FOLDER = "tensorboard"
BOARDS = 16  # most seeds with a folder, because each folder keeps three files open


class Boards:
    """A `Logger` that writes one TensorBoard folder for each of the first `BOARDS` seeds.

    If PyTorch is installed, tensorboardX imports it, which takes seconds. So this
    class imports tensorboardX only at the first rows, in the logger's thread.
    """

    name = "TensorBoard"

    def __init__(
        self, run: Path, seeds: Sequence[int], stages: Sequence[str], purge: int | None = None
    ) -> None:
        """Prepares a folder for each of the first `BOARDS` seeds, but opens nothing yet.

        Args:
          run: the run directory.
          seeds: seeds of the run.
          stages: names of the stages of the run's curriculum.
          purge: arena step from which on TensorBoard hides events that were written earlier; None
            hides nothing.
        """
        folder = run / FOLDER
        several = len(seeds) > 1
        self._folders = {k: folder / f"seed{k}" if several else folder for k in seeds[:BOARDS]}
        self._stages, self._purge = stages, purge
        self._writers: dict[int, Any] = {}

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Writes each row to the folder of its seed, and the speeds to the first folder.

        Writing a row takes a millisecond, as long as an update of a few arenas. So with N folders,
        each folder receives only every N-th update. All folders together then take no more time
        than one.
        """
        if not self._writers:
            self._open()
        for row in rows:
            if row["seed"] in self._writers and row["update"] % len(self._writers) == 0:
                self._add(row["seed"], numbers(row, self._stages), row["arena_steps"])
        self._add(next(iter(self._writers)), numbers(speeds), rows[-1]["arena_steps"])

    def close(self) -> None:
        """Writes the remaining events."""
        for writer in self._writers.values():
            writer.close()

    def _open(self) -> None:
        """Makes the folders and their files.

        The `EventsWriter` of tensorboardX can write a whole row as one event. Its `SummaryWriter`
        writes one event for each number.
        """
        from tensorboardX.event_file_writer import EventsWriter

        for seed, folder in self._folders.items():
            folder.mkdir(parents=True, exist_ok=True)
            self._writers[seed] = EventsWriter(str(folder / "events"), f".{time.time_ns()}")
            if self._purge is not None:
                event = _event(self._purge)
                event.session_log.status = event.session_log.START
                self._writers[seed].write_event(event)

    def _add(self, seed: int, values: Mapping[str, float], arena_steps: int) -> None:
        event = _event(arena_steps)
        for name, value in values.items():
            event.summary.value.add(tag=name, simple_value=value)
        self._writers[seed].write_event(event)


def numbers(row: Row, stages: Sequence[str] = ()) -> dict[str, float]:
    """Lists the numbers of a row by name; leaves out all other values.

    Args:
      row: a row of `metrics.jsonl`. A list in the row has one number for each stage. The name of
        such a number is the name of the list, a slash and the name of the stage.
      stages: names of the stages.
    """
    flat: dict[str, Any] = {}
    for name, value in row.items():
        if isinstance(value, list):
            flat |= {f"{name}/{stage}": x for stage, x in zip(stages, value, strict=True)}
        else:
            flat[name] = value
    return {name: value for name, value in flat.items() if isinstance(value, int | float)}


def _event(arena_steps: int) -> Any:
    """Makes an empty TensorBoard event."""
    from tensorboardX.proto import event_pb2

    # The module's classes are created at import, so pyright does not see them.
    made: Any = event_pb2
    return made.Event(wall_time=time.time(), step=arena_steps)
