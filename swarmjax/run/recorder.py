"""Writes a run's metrics, decisions and episodes to JSONL files and loggers while it trains."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax.run import directory
from swarmjax.run.directory import DECISIONS, EPISODES, METRICS, Log, Row
from swarmjax.run.loggers import Guarded, Logger
from swarmjax.sim import gaps

_READ = (METRICS, DECISIONS)


def rows(
    metrics: dict[str, np.ndarray],
    n: int,
    stages: Sequence[str],
    seeds: Sequence[int],
    control_steps: int,
) -> list[Row]:
    """Turns the metrics of a call into one row for each update and seed.

    Args:
      metrics: [N, rows, ...] as `seeds.chunk` returns them. The first n entries of each seed
        hold one update each.
      n: updates of the call.
      stages: names of the stages.
      seeds: [N] seeds of the run.
      control_steps: control steps of one update and seed, over all arenas.

    Returns:
      Rows of plain numbers, ordered by update, then by seed. Counts are unchanged. Shares and means
      are over the episodes that ended on the row's stage in the update; None if none ended.
    """
    # [n, N] flattened, so that the seeds of an update are adjacent.
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
    """Adds shares, means and names to the metrics of one update."""
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
    """Replaces numbers that are not finite by None, since JSON has no such numbers."""
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None


class Recorder:
    """Appends to the logs of a run directory, in a `with` block."""

    def __init__(
        self,
        run: Path,
        *,
        update: int,
        episodes: bool = False,
        logs: Mapping[str, int] | None = None,
        loggers: Sequence[Logger] = (),
    ) -> None:
        """Opens the logs, and drops the rows that a stopped run wrote after its checkpoint.

        Args:
          run: the run directory.
          update: updates done at the checkpoint.
          episodes: whether to log episodes.
          logs: bytes of each log at the checkpoint. Checkpoints of older versions do not record
            them; rows are then dropped by their update.
          loggers: receive the rows too, and are closed at the end.
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
        self._loggers = [Guarded(each) for each in loggers]

    def write(self, found: Sequence[Row], decisions: Iterable[Row], speeds: Row) -> None:
        """Writes the rows and decisions of a call. Loggers also receive its speeds."""
        self._logs[METRICS].write(found)
        self._logs[DECISIONS].write(decisions)
        for logger in self._loggers:
            logger.write(found, speeds)

    def write_episodes(self, found: Iterable[Row]) -> None:
        """Writes the episodes of a call, if they are logged."""
        if EPISODES in self._logs:
            self._logs[EPISODES].write(found)

    def sync(self) -> dict[str, int]:
        """Flushes all rows to disk, and returns the bytes of each log by name."""
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
    """Reads the metrics and decisions that a run logged before a checkpoint.

    Args:
      run: the run directory.
      update: updates done at the checkpoint.
      logs: bytes of each log at the checkpoint. Without these lengths, rows are selected by their
        update.

    Raises:
      CheckpointError: if a log is damaged.
    """
    if logs:
        metrics, decisions = (directory.read_rows(run / k, logs.get(k, 0)) for k in _READ)
        return metrics, decisions
    metrics, decisions = (directory.read_rows(run / k, None, whole=False) for k in _READ)
    return _earlier(metrics, update), _earlier(decisions, update)


def _earlier(rows: Sequence[Row], update: int) -> list[Row]:
    """Returns the rows before `update`."""
    return [row for row in rows if directory.is_before(row, update)]
