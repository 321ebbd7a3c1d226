"""What a run writes while it trains: metrics, decisions, episodes (all JSONL) and TensorBoard."""

import json
import math
import sys
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from swarmjax.sim import gaps

if TYPE_CHECKING:
    from tensorboardX import SummaryWriter

METRICS, DECISIONS, EPISODES = "metrics.jsonl", "curriculum.jsonl", "episodes.jsonl"
BOARDS = 16  # seeds that TensorBoard is written for: a board holds three files open
MOST_PENDING = 100  # calls whose rows TensorBoard may be behind

Row = dict[str, Any]


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
    """Appends to the files of a run directory. Use it with `with`."""

    def __init__(
        self,
        run: Path,
        *,
        seeds: Sequence[int],
        tensorboard: bool,
        update: int,
        arena_steps: int = 0,
        episodes: bool = False,
    ) -> None:
        """Opens the files, dropping what a stopped run wrote after the checkpoint `update`.

        `arena_steps` is where that checkpoint stands, on TensorBoard's axis. Of several seeds the
        first `BOARDS` have a folder of TensorBoard each. `episodes` opens a file for them.
        """
        run.mkdir(parents=True, exist_ok=True)
        for name in (METRICS, DECISIONS, EPISODES):
            _truncate(run / name, update)
        self._metrics = (run / METRICS).open("a")
        self._decisions = (run / DECISIONS).open("a")
        self._episodes = (run / EPISODES).open("a") if episodes else None
        purge = arena_steps + 1 if update else None  # TensorBoard hides what it has from here on
        folder = run / "tensorboard"
        folders = {k: folder / f"seed{k}" if len(seeds) > 1 else folder for k in seeds[:BOARDS]}
        self._boards = Boards(folders, purge) if tensorboard else None

    def write(self, found: Sequence[Row], decisions: Iterable[Row], speeds: Row) -> None:
        """Writes the rows of a call; the speeds, of all seeds together, to TensorBoard's first."""
        self._metrics.writelines(json.dumps(row) + "\n" for row in found)
        self._decisions.writelines(json.dumps(row) + "\n" for row in decisions)
        self._metrics.flush()
        self._decisions.flush()
        if self._boards is not None:
            self._boards.write(found, speeds)

    def write_episodes(self, found: Iterable[Row]) -> None:
        """Writes the episodes of a call, where there is a file for them."""
        if self._episodes is not None:
            self._episodes.writelines(json.dumps(row) + "\n" for row in found)
            self._episodes.flush()

    def __enter__(self) -> "Recorder":
        """Returns itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Closes the files."""
        self._metrics.close()
        self._decisions.close()
        if self._episodes is not None:
            self._episodes.close()
        if self._boards is not None:
            self._boards.close(at_once=kind is KeyboardInterrupt)


class Boards:
    """Folders of TensorBoard, by seed, which a thread opens and writes.

    TensorBoardX takes seconds to import where there is PyTorch, which it brings along; a run that
    waits for a GPU meanwhile has them to spare. Where they cannot be written, a sentence says so
    and the run goes on: they hold nothing that the metrics do not.
    """

    def __init__(self, folders: Mapping[int, Path], purge: int | None) -> None:
        """Opens nothing yet; what lies at arena step `purge` and after is to be hidden."""
        self._folders, self._purge = folders, purge
        self._open: dict[int, SummaryWriter] = {}
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
        self._pending.append(self._thread.submit(self._write, found, speeds))

    def close(self, *, at_once: bool = False) -> None:
        """Waits until everything is written, unless that is to be `at_once`."""
        self._thread.shutdown(wait=not at_once, cancel_futures=at_once)
        if at_once:
            return
        for board in self._open.values():
            board.close()
        for write in self._pending:
            write.result()

    def _write(self, found: Sequence[Row], speeds: Row) -> None:
        if self._lost:
            return
        try:
            self._add(found, speeds)
        except (ImportError, OSError) as error:
            self._lost = True
            sys.stderr.write(f"swarmjax: TensorBoard is not written from here on: {error}.\n")

    def _add(self, found: Sequence[Row], speeds: Row) -> None:
        from tensorboardX import SummaryWriter

        if not self._open:
            self._open = {
                seed: SummaryWriter(str(folder), purge_step=self._purge)
                for seed, folder in self._folders.items()
            }
        for row in found:
            if row["seed"] in self._open and row["update"] % len(self._open) == 0:
                _add_scalars(self._open[row["seed"]], row, row["arena_steps"])
        _add_scalars(next(iter(self._open.values())), speeds, found[-1]["arena_steps"])


def _add_scalars(board: "SummaryWriter", row: Row, arena_steps: int) -> None:
    """Writes the numbers of a row to TensorBoard."""
    for name, value in row.items():
        if isinstance(value, int | float):
            board.add_scalar(name, value, arena_steps)


def history(run: Path, update: int) -> tuple[list[Row], list[Row]]:
    """Reads what a run had written down before `update`: its metrics and its decisions."""
    return _kept(run / METRICS, update), _kept(run / DECISIONS, update)


def _kept(path: Path, update: int) -> list[Row]:
    """Reads the rows before `update`."""
    if not path.exists():
        return []
    found = map(_parsed, path.read_text().splitlines())
    return [row for row in found if row.get("update", math.inf) < update]


def _truncate(path: Path, update: int) -> None:
    """Keeps the rows before `update`."""
    if path.exists():
        path.write_text("".join(json.dumps(row) + "\n" for row in _kept(path, update)))


def _parsed(line: str) -> Row:
    """Reads a row; one that a crash cut off is empty."""
    try:
        return json.loads(line)
    except json.JSONDecodeError:
        return {}
