"""What a run writes while it trains: `metrics.jsonl`, `curriculum.jsonl` and TensorBoard."""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tensorboardX import SummaryWriter

from swarmjax.sim import gaps

METRICS, DECISIONS = "metrics.jsonl", "curriculum.jsonl"

Row = dict[str, Any]


def rows(
    metrics: dict[str, np.ndarray], n: int, stages: Sequence[str], control_steps: int
) -> list[Row]:
    """Turns the metrics of a call into a row an update.

    Args:
      metrics: as `loop.train_chunk` returns them; the first n entries hold an update each.
      n: updates of the call.
      stages: names.
      control_steps: arena control steps of one update, over all arenas.

    Returns:
      Rows of plain numbers: counts as they are, shares and means over the episodes that ended in
      the update on its stage (None where none did).
    """
    columns = {name: np.asarray(column)[:n].tolist() for name, column in metrics.items()}
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
    finite = {
        k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in raw.items()
    }
    return finite | named


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None


class Recorder:
    """Appends to the files of a run directory. Use it with `with`."""

    def __init__(self, run: Path, *, tensorboard: bool, update: int, arena_steps: int = 0) -> None:
        """Opens the files, dropping what a stopped run wrote after the checkpoint `update`.

        `arena_steps` is where that checkpoint stands, on TensorBoard's axis.
        """
        run.mkdir(parents=True, exist_ok=True)
        for name in (METRICS, DECISIONS):
            _truncate(run / name, update)
        self._metrics = (run / METRICS).open("a")
        self._decisions = (run / DECISIONS).open("a")
        purge = arena_steps + 1 if update else None  # TensorBoard hides what it has from here on
        self._board = (
            SummaryWriter(str(run / "tensorboard"), purge_step=purge) if tensorboard else None
        )

    def write(self, found: Sequence[Row], decisions: Iterable[Row], speeds: Row) -> None:
        """Writes the rows of a call; the speeds go to TensorBoard with the last of them."""
        self._metrics.writelines(json.dumps(row) + "\n" for row in found)
        self._decisions.writelines(json.dumps(row) + "\n" for row in decisions)
        self._metrics.flush()
        self._decisions.flush()
        if self._board:
            for row in [*found[:-1], found[-1] | speeds]:
                _add_scalars(self._board, row)

    def __enter__(self) -> "Recorder":
        """Returns itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Closes the files."""
        self._metrics.close()
        self._decisions.close()
        if self._board:
            self._board.close()


def _add_scalars(board: SummaryWriter, row: Row) -> None:
    """Writes the numbers of a row to TensorBoard."""
    for name, value in row.items():
        if isinstance(value, int | float):
            board.add_scalar(name, value, row["arena_steps"])


def history(run: Path, update: int) -> tuple[list[Row], list[Row]]:
    """Reads what a run had written down before `update`: its metrics and its promotions."""
    return _kept(run / METRICS, update), _kept(run / DECISIONS, update)


def _kept(path: Path, update: int) -> list[Row]:
    """Reads the rows before `update`."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text().splitlines() if _update_of(line) < update]


def _truncate(path: Path, update: int) -> None:
    """Keeps the rows before `update`."""
    if path.exists():
        path.write_text("".join(json.dumps(row) + "\n" for row in _kept(path, update)))


def _update_of(line: str) -> float:
    """Returns the update of a row; a line that a crash cut off counts as later than all."""
    try:
        return json.loads(line)["update"]
    except (json.JSONDecodeError, KeyError):
        return math.inf
