"""Writes a run's metrics, curriculum decisions and episodes to JSONL files and loggers."""

import contextlib
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax.run import directory
from swarmjax.run.directory import DECISIONS, EPISODES, METRICS, Log, Row
from swarmjax.run.loggers import Guarded, Logger
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import gaps
from swarmjax.sim.config import physics_substeps
from swarmjax.task.goals.goal import MEASURED


def rows(
    metrics: dict[str, np.ndarray],
    n: int,
    stages: Sequence[str],
    seeds: Sequence[int],
    control_steps: int,
) -> list[Row]:
    """Turns the metrics of a call of the program into one row for each update and seed.

    Args:
      metrics: [N, rows, ...] as `seeds.chunk` returns them. The first n entries of each seed
        hold one update each.
      n: number of updates of the call.
      stages: names of the stages.
      seeds: [N] seeds of the run.
      control_steps: control steps of one update and seed, summed over all arenas.

    Returns:
      Rows of plain numbers, ordered by update, then by seed. Counts are unchanged. Shares and means
      cover the episodes that ended on the row's stage in the update. They are None if no episode
      ended.
    """
    # The axes [n, N] are flattened in this order, so that the seeds of an update are adjacent.
    columns = {
        name: np.swapaxes(np.asarray(column)[:, :n], 0, 1).reshape(-1, *column.shape[2:]).tolist()
        for name, column in metrics.items()
    }
    columns["seed"] = [*seeds] * n
    every = zip(*columns.values(), strict=True)
    return [_row(dict(zip(columns, each, strict=True)), stages, control_steps) for each in every]


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
    own = {name: _finite(_share(raw[name], episodes)) for name in raw if name.startswith(MEASURED)}
    return {name: _finite(value) for name, value in raw.items()} | named | own


def _finite(value: Any) -> Any:
    """Replaces numbers that are not finite with None, since JSON has no such numbers."""
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def speeds(settings: TrainConfig, rows: Sequence[Row], seconds: float) -> dict[str, float]:
    """Returns the speeds of a call, per second and summed over all seeds."""
    rollout = settings.algo.rollout_length
    arena_steps = len(rows) * settings.arenas * rollout
    steps = {
        "arena_steps": arena_steps,
        "robot_steps": rollout * sum(row["robots"] for row in rows),
        "physics_steps": arena_steps * physics_substeps(settings.robot, settings.sim.substeps),
        "transitions": sum(row["transitions"] for row in rows),
    }
    return {f"{name}_per_s": count / seconds for name, count in steps.items()}


class Recorder:
    """Appends to the logs of a run directory and calls the loggers, in a `with` block."""

    def __init__(
        self,
        run: Path,
        logs: Mapping[str, int],
        *,
        episodes: bool = False,
        loggers: Sequence[Logger] = (),
    ) -> None:
        """Opens the logs, and drops the rows that a stopped run wrote after its checkpoint.

        Args:
          run: the run directory.
          logs: length of each log at the checkpoint, in bytes; empty without a checkpoint.
          episodes: whether to log episodes.
          loggers: loggers that receive the same rows, and are closed at the end.
        """
        run.mkdir(parents=True, exist_ok=True)
        for name in directory.LOGS:
            directory.cut(run / name, logs.get(name, 0))
        self._open = contextlib.ExitStack()
        names = [METRICS, DECISIONS, *([EPISODES] if episodes else [])]
        self._logs = {name: self._open.enter_context(Log(run / name)) for name in names}
        # Earlier starts of the run may have written logs that this start does not write.
        self._closed = {name: length for name, length in logs.items() if name not in names}
        self._loggers = [
            self._open.enter_context(contextlib.closing(Guarded(each))) for each in loggers
        ]

    def write(self, rows: Sequence[Row], decisions: Iterable[Row], speeds: Row) -> None:
        """Writes the rows and decisions of a call. Loggers also receive its speeds."""
        self._logs[METRICS].write(rows)
        self._logs[DECISIONS].write(decisions)
        for logger in self._loggers:
            logger.write(rows, speeds)

    def write_episodes(self, rows: Iterable[Row]) -> None:
        """Writes the rows of a call's episodes, if the run logs episodes."""
        if EPISODES in self._logs:
            self._logs[EPISODES].write(rows)

    def sync(self) -> dict[str, int]:
        """Flushes all rows to disk, and returns the length of each log in bytes, by name."""
        return self._closed | {name: log.sync() for name, log in self._logs.items()}

    def __enter__(self) -> "Recorder":
        """Returns itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Closes the files and the loggers."""
        self._open.close()
