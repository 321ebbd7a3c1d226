"""What a run writes while it trains: metrics, decisions, episodes (all JSONL) and TensorBoard."""

import contextlib
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax.run import directory
from swarmjax.run.directory import DECISIONS, EPISODES, METRICS, Log, Row
from swarmjax.sim import gaps

_READ = (METRICS, DECISIONS)
BOARDS = 16  # seeds that TensorBoard is written for: a board holds three files open
MOST_PENDING = 100  # calls whose rows TensorBoard may be behind


def rows(
    metrics: dict[str, np.ndarray],
    n: int,
    stages: Sequence[str],
    seeds: Sequence[int],
    control_steps: int,
) -> list[Row]:
    """Turns the metrics of a call into a row an update and seed.

    Args:
      metrics: [N, rows, ...] as `seeds.train_chunk` returns them; of each seed the first n entries
        hold an update each.
      n: updates of the call.
      stages: names.
      seeds: [N], the run's.
      control_steps: arena control steps of one update and seed, over all arenas.

    Returns:
      Rows of plain numbers, those of an update together and in the order of the seeds: counts as
      they are, shares and means over the episodes that ended in the update on its stage (None
      where none did).
    """
    # [n, N] flattened: an update's seeds stand together.
    columns = {
        name: np.swapaxes(np.asarray(column)[:, :n], 0, 1).reshape(-1, *column.shape[2:]).tolist()
        for name, column in metrics.items()
    }
    columns["seed"] = [*seeds] * n
    found = [
        dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)
    ]
    return [_row(raw, stages, control_steps) for raw in found]


def _row(raw: Row, stages: Sequence[str], control_steps: int) -> Row:
    """Adds shares, means and names to the numbers of one update."""
    episodes, targets = raw["episodes"], raw["targets"]
    contacts = sum(raw[f"contacts_{kind}"] for kind in gaps.KINDS)
    named = {
        "contacts": contacts,
        "stage": stages[raw["stage"]],
        "arena_steps": (raw["update"] + 1) * control_steps,
        "targets_reached": _share(raw["reached"], targets),
        "all_reached": _share(raw["complete"], episodes),
        "return": _share(raw["reward"], targets),
        "episode_steps": _share(raw["steps"], episodes),
        "contacts_per_robot": _share(contacts, targets),
        "ir_steps_share": _share(raw["sensed"], raw["robot_steps"]),
    }
    return {name: _finite(value) for name, value in raw.items()} | named


def _finite(value: Any) -> Any:
    """Puts None, which JSON has, in the place of numbers that are not finite."""
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None


class Recorder:
    """Appends to the logs of a run directory. Use it with `with`."""

    def __init__(
        self,
        run: Path,
        *,
        seeds: Sequence[int],
        tensorboard: bool,
        update: int,
        arena_steps: int = 0,
        episodes: bool = False,
        logs: Mapping[str, int] | None = None,
    ) -> None:
        """Opens the logs, dropping what a stopped run wrote after the checkpoint `update`.

        `logs` has the bytes of each log that the checkpoint counts; without them, as in a
        checkpoint of an older version, rows are dropped by their update. `arena_steps` is where
        that checkpoint stands, on TensorBoard's axis. Of several seeds the first `BOARDS` have a
        folder of TensorBoard each. `episodes` opens a log for them.
        """
        run.mkdir(parents=True, exist_ok=True)
        for name in directory.LOGS:
            if not logs:
                directory.cut_rows(run / name, update)
            else:
                directory.cut(run / name, logs.get(name, 0))
        names = [METRICS, DECISIONS, *([EPISODES] if episodes else [])]
        self._logs = {name: Log(run / name) for name in names}
        # A log that this process does not write still belongs to the run.
        self._closed = {k: length for k, length in (logs or {}).items() if k not in names}
        purge = arena_steps + 1 if update else None  # TensorBoard hides what it has from here on
        folder = run / "tensorboard"
        folders = {k: folder / f"seed{k}" if len(seeds) > 1 else folder for k in seeds[:BOARDS]}
        self._boards = Boards(folders, purge) if tensorboard else None

    def write(self, found: Sequence[Row], decisions: Iterable[Row], speeds: Row) -> None:
        """Writes the rows of a call; the speeds, of all seeds together, to TensorBoard's first."""
        self._logs[METRICS].write(found)
        self._logs[DECISIONS].write(decisions)
        if self._boards is not None:
            self._boards.write(found, speeds)

    def write_episodes(self, found: Iterable[Row]) -> None:
        """Writes the episodes of a call, where there is a log for them."""
        if EPISODES in self._logs:
            self._logs[EPISODES].write(found)

    def sync(self) -> dict[str, int]:
        """Makes sure that the disk has all rows; returns the bytes of each log, by name."""
        return self._closed | {name: log.sync() for name, log in self._logs.items()}

    def __enter__(self) -> "Recorder":
        """Returns itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Closes the files."""
        for log in self._logs.values():
            log.close()
        if self._boards is not None:
            self._boards.close()


class Boards:
    """Folders of TensorBoard, by seed, which a thread opens and writes.

    TensorBoardX takes seconds to import where there is PyTorch, which it brings along; a run that
    waits for a GPU meanwhile has them to spare. Where they cannot be written, a sentence says so
    and the run goes on: they hold nothing that the metrics do not.
    """

    def __init__(self, folders: Mapping[int, Path], purge: int | None) -> None:
        """Opens nothing yet; what lies at arena step `purge` and after is to be hidden."""
        self._folders, self._purge = folders, purge
        self._open: dict[int, Board] = {}
        self._thread = ThreadPoolExecutor(1)
        self._pending: deque[Future] = deque()
        self._lost = False

    def write(self, found: Sequence[Row], speeds: Row) -> None:
        """Writes rows, and the speeds to the first board.

        Of N boards each is given every N-th update, so that they cost no more time than one:
        a row takes it a millisecond, as much as an update of a few arenas.
        """
        while self._pending and (self._pending[0].done() or len(self._pending) > MOST_PENDING):
            self._pending.popleft().result()
        self._pending.append(self._thread.submit(self._try, self._add, found, speeds))

    def close(self) -> None:
        """Waits until everything is written."""
        self._thread.shutdown()
        for write in self._pending:
            write.result()
        for board in self._open.values():
            with contextlib.suppress(OSError):  # which was said when it was lost
                board.close()

    def _try(self, what: Callable[..., None], *arguments: Any) -> None:
        """Does something with the boards, unless they were lost; loses them if it fails."""
        if self._lost:
            return
        try:
            what(*arguments)
        except (ImportError, OSError) as error:
            self._lost = True
            sys.stderr.write(f"swarmjax: TensorBoard is not written from here on: {error}.\n")

    def _add(self, found: Sequence[Row], speeds: Row) -> None:
        if not self._open:
            self._open = {seed: Board(path, self._purge) for seed, path in self._folders.items()}
        for row in found:
            if row["seed"] in self._open and row["update"] % len(self._open) == 0:
                self._open[row["seed"]].add(row, row["arena_steps"])
        next(iter(self._open.values())).add(speeds, found[-1]["arena_steps"])


class Board:
    """One folder of TensorBoard.

    TensorBoardX's own `SummaryWriter` has a thread that dies on a full disk and leaves its queue
    full, so that whoever writes next waits for ever. Its writer of events has none.
    """

    def __init__(self, folder: Path, purge: int | None) -> None:
        """Makes the folder and its file; TensorBoard hides what it has from step `purge` on."""
        from tensorboardX.event_file_writer import EventsWriter

        folder.mkdir(parents=True, exist_ok=True)
        self._writer = EventsWriter(str(folder / "events"), f".{time.time_ns()}")
        if purge is not None:
            event = _event(purge)
            event.session_log.status = event.session_log.START
            self._writer.write_event(event)

    def add(self, row: Row, arena_steps: int) -> None:
        """Writes the numbers of a row."""
        event = _event(arena_steps)
        for name, value in row.items():
            if isinstance(value, int | float):
                event.summary.value.add(tag=name, simple_value=value)
        self._writer.write_event(event)

    def close(self) -> None:
        """Writes what is left."""
        self._writer.close()


def _event(arena_steps: int) -> Any:
    """Makes an event of TensorBoard's that holds nothing yet."""
    from tensorboardX.proto import event_pb2

    made: Any = event_pb2  # whose messages are made when it is imported
    return made.Event(wall_time=time.time(), step=arena_steps)


def history(
    run: Path, update: int, logs: Mapping[str, int] | None = None
) -> tuple[list[Row], list[Row]]:
    """Reads what a run had written down before a checkpoint: its metrics and its decisions.

    Args:
      run: The run directory.
      update: Of the checkpoint.
      logs: Bytes of each log that it counts; without them rows are taken by their update.

    Raises:
      CheckpointError: If a log is damaged.
    """
    if logs:
        metrics, decisions = (directory.read_rows(run / k, logs.get(k, 0)) for k in _READ)
        return metrics, decisions
    metrics, decisions = (directory.read_rows(run / k, None, whole=False) for k in _READ)
    return _earlier(metrics, update), _earlier(decisions, update)


def _earlier(rows: Sequence[Row], update: int) -> list[Row]:
    """Takes the rows before `update`."""
    return [row for row in rows if directory.is_before(row, update)]
