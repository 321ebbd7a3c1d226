"""Writes TensorBoard events with tensorboardX, into one folder for each seed of a run."""

import contextlib
import struct
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from swarmjax.run.directory import Row

FOLDER = "tensorboard"
BOARDS = 16  # most seeds with a folder, because each one keeps three files open


class Boards:
    """A `Logger` that writes one TensorBoard folder for each seed.

    If PyTorch is installed, tensorboardX imports it, which takes seconds. So the import waits for
    the first rows and happens in the logger's thread.
    """

    name = "TensorBoard"

    def __init__(
        self, run: Path, seeds: Sequence[int], stages: Sequence[str], purge: int | None = None
    ) -> None:
        """Prepares a folder for each of the first `BOARDS` seeds, but opens nothing yet.

        Args:
          run: the run directory.
          seeds: of the run.
          stages: names of the stages of its curriculum.
          purge: arena step from which on TensorBoard hides older events; None: it hides none.
        """
        self._stages = stages
        folder = run / FOLDER
        several = len(seeds) > 1
        self._folders = {k: folder / f"seed{k}" if several else folder for k in seeds[:BOARDS]}
        self._purge = purge
        self._open: dict[int, Board] = {}

    def write(self, rows: Sequence[Row], speeds: Row) -> None:
        """Writes rows, and the speeds to the first folder.

        Writing a row takes a millisecond, as long as an update of a few arenas. So with N folders,
        each folder receives only every N-th update. All folders together then take no more time
        than one.
        """
        boards = self._boards()
        for row in rows:
            if row["seed"] in boards and row["update"] % len(boards) == 0:
                boards[row["seed"]].add(numbers(row, self._stages), row["arena_steps"])
        next(iter(boards.values())).add(numbers(speeds), rows[-1]["arena_steps"])

    def attach(self, name: str, path: Path, arena_steps: int) -> None:
        """Writes a PNG as an image, or the path of any other file, to the first folder."""
        board = next(iter(self._boards().values()))
        if path.suffix == ".png":
            board.add_picture(name, path.read_bytes(), arena_steps)
        else:
            board.add_text(name, f"`{path.resolve()}`", arena_steps)

    def close(self) -> None:
        """Writes the remaining events."""
        for board in self._open.values():
            with contextlib.suppress(OSError):  # already reported when the logger was lost
                board.close()

    def _boards(self) -> "dict[int, Board]":
        if not self._open:
            self._open = {seed: Board(path, self._purge) for seed, path in self._folders.items()}
        return self._open


class Board:
    """One TensorBoard folder.

    The `SummaryWriter` of tensorboardX has a thread that dies on a full disk. The thread's queue
    then stays full, and the next write waits forever. The `EventsWriter` of tensorboardX has no
    thread.
    """

    def __init__(self, folder: Path, purge: int | None) -> None:
        """Makes the folder and its file. TensorBoard hides older events from step `purge` on."""
        from tensorboardX.event_file_writer import EventsWriter

        folder.mkdir(parents=True, exist_ok=True)
        self._writer = EventsWriter(str(folder / "events"), f".{time.time_ns()}")
        if purge is not None:
            event = _event(purge)
            event.session_log.status = event.session_log.START
            self._writer.write_event(event)

    def add(self, values: Mapping[str, float], arena_steps: int) -> None:
        """Writes numbers by name."""
        event = _event(arena_steps)
        for name, value in values.items():
            event.summary.value.add(tag=name, simple_value=value)
        self._writer.write_event(event)

    def add_picture(self, name: str, png: bytes, arena_steps: int) -> None:
        """Writes a PNG. The first chunk of a PNG holds its size (PNG specification, 11.2.1)."""
        event = _event(arena_steps)
        image = event.summary.value.add(tag=name).image
        image.width, image.height = struct.unpack(">II", png[16:24])
        image.colorspace, image.encoded_image_string = 4, png  # red, green, blue, alpha
        self._writer.write_event(event)

    def add_text(self, name: str, text: str, arena_steps: int) -> None:
        """Writes Markdown for TensorBoard's text page."""
        from tensorboardX.proto import types_pb2

        event = _event(arena_steps)
        value = event.summary.value.add(tag=name)
        value.metadata.plugin_data.plugin_name = "text"
        types: Any = types_pb2
        value.tensor.dtype = types.DT_STRING
        value.tensor.string_val.append(text.encode())
        self._writer.write_event(event)

    def close(self) -> None:
        """Writes the remaining events."""
        self._writer.close()


def numbers(row: Row, stages: Sequence[str] = ()) -> dict[str, float]:
    """Lists the numbers of a row by name.

    A list has a number for each stage of the curriculum. This number gets the name of the list, a
    slash and the name of the stage. Entries without a number are left out.

    Args:
      row: row of `metrics.jsonl`.
      stages: names of the stages.

    Returns:
      The numbers.
    """
    found = {}
    for name, value in row.items():
        if isinstance(value, list):
            parts = {f"{name}/{stage}": x for stage, x in zip(stages, value, strict=True)}
        else:
            parts = {name: value}
        found |= {key: part for key, part in parts.items() if isinstance(part, int | float)}
    return found


def _event(arena_steps: int) -> Any:
    """Makes an empty TensorBoard event."""
    from tensorboardX.proto import event_pb2

    # The module's classes are created at import, so pyright does not see them.
    made: Any = event_pb2
    return made.Event(wall_time=time.time(), step=arena_steps)
