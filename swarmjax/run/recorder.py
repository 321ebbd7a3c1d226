"""What a run writes while it trains: metrics, decisions, episodes (all JSONL), and to loggers."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax.run import directory
from swarmjax.run.directory import DECISIONS, EPISODES, METRICS, Log, Row
from swarmjax.run.loggers import Guarded, Logger
from swarmjax.run.tensorboard import Boards
from swarmjax.sim import gaps

_READ = (METRICS, DECISIONS)


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
        loggers: Sequence[Logger] = (),
    ) -> None:
        """Opens the logs, dropping what a stopped run wrote after the checkpoint `update`.

        `logs` has the bytes of each log that the checkpoint counts; without them, as in a
        checkpoint of an older version, rows are dropped by their update. `arena_steps` is where
        that checkpoint stands, on TensorBoard's axis. `episodes` opens a log for them. `loggers`
        are told the rows besides, and closed at the end.
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
        boards = [Boards(run, seeds, purge)] if tensorboard else []
        self._loggers = [Guarded(each) for each in (*boards, *loggers)]

    def write(self, found: Sequence[Row], decisions: Iterable[Row], speeds: Row) -> None:
        """Writes the rows of a call, and tells the loggers of its speeds as well."""
        self._logs[METRICS].write(found)
        self._logs[DECISIONS].write(decisions)
        for logger in self._loggers:
            logger.write(found, speeds)

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
        for logger in self._loggers:
            logger.close()


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
