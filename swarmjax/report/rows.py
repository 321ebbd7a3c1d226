"""Reads the files of a run into arrays, for the run's report. Needs no JAX.

Axes: N seeds, T updates, S stages. A missing value is nan in the arrays and null in the files.

A run can be read at any time. A last line without its newline is still being written, or was being
written when the run was killed, so it is skipped. Any other damage raises an error that names the
file, line and key.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, NamedTuple

import numpy as np

from swarmjax import words
from swarmjax.config import ConfigError, reading
from swarmjax.evaluate.statistics import iqm
from swarmjax.run import load_settings
from swarmjax.run.directory import CONFIG, DECISIONS, METRICS, SUMMARY
from swarmjax.run.settings import TrainConfig
from swarmjax.task.goals.goal import MEASURED

Row = dict[str, Any]

# Keys of lists with one number per stage, from the newest cohort of episodes on that stage.
BY_STAGE = ("success_by_stage", "complete_by_stage", "contacts_by_stage", "return_by_stage")
_LISTS = ("mix", *BY_STAGE)
# Keys with one number per update. The first two cover the episodes that ended in the update.
CURVES = ("return", "contacts_per_robot", "policy_loss", "value_loss", "entropy")
MANY = 9  # with more stages than this, the panel of each stage is drawn small
_LARGEST = float(np.finfo(np.float32).max)


class ValueKind(NamedTuple):
    """A kind of value in a row: its name in messages, and the test for values of this kind."""

    name: str
    fits: Callable[[Any], bool]


def _is_number(value: Any, types: type | UnionType, largest: float) -> bool:
    """Tests whether a value is a number no larger than `largest`; booleans and nan do not count."""
    return isinstance(value, types) and not isinstance(value, bool) and abs(value) <= largest


# NumPy's int64 holds no larger whole number.
COUNT = ValueKind("whole number", lambda each: _is_number(each, int, 2**63 - 1) and each >= 0)
NUMBER = ValueKind("number", lambda value: _is_number(value, int | float, _LARGEST))
NUMBER_OR_NULL = ValueKind("number", lambda value: value is None or NUMBER.fits(value))
NAME = ValueKind("name", lambda value: isinstance(value, str))
MAP = ValueKind("keys and values", lambda value: isinstance(value, dict))
FLAG = ValueKind("truth value", lambda value: isinstance(value, bool))


def list_of(kind: ValueKind, count: int) -> ValueKind:
    """Makes the kind of a list with exactly `count` values of a kind; no list fits a count of 0."""

    def fits(value: Any) -> bool:
        return isinstance(value, list) and len(value) == count > 0 and all(map(kind.fits, value))

    return ValueKind(f"list of {count} {kind.name}s", fits)


@dataclass(frozen=True, kw_only=True, eq=False)
class History:
    """The results of a run at the updates that all of its seeds have recorded.

    Attributes:
      config: the run's settings.
      seeds: [N], increasing.
      updates: [T], increasing from 0.
      arena_steps: [T] arena control steps of one seed by the end of the update.
      mix: [N, T, S] share of the arenas that were on the stage, 0 to 1.
      by_stage: an array [N, T, S] for each name in `BY_STAGE`.
      curves: an array [N, T] for each name in `CURVES`, and for the goal's first own measure.
      seconds: training time up to the last update; None if it was not recorded.
      decisions: the curriculum's decisions as recorded, sorted by seed and update.
      summary: the run's summary as recorded; empty before the run ends.
    """

    config: TrainConfig
    seeds: np.ndarray
    updates: np.ndarray
    arena_steps: np.ndarray
    mix: np.ndarray
    by_stage: dict[str, np.ndarray]
    curves: dict[str, np.ndarray]
    seconds: float | None
    decisions: list[Row]
    summary: Row

    @property
    def names(self) -> list[str]:
        """The names of the stages."""
        return self.config.stage_names

    @property
    def labels(self) -> list[str]:
        """Names of the stages in figures; with `curriculum.axes`, their values on the axes."""
        axes, stages = self.config.curriculum.axes, self.config.stage
        values = [[words.setting(getattr(stage, key)) for key in axes] for stage in stages]
        return list(map(" · ".join, values)) if axes else self.names

    @property
    def success(self) -> np.ndarray:
        """The success [N, T, S] by which the curriculum decides.

        Success is the share of targets that were reached, or of episodes in which all robots
        arrived.
        """
        return self.by_stage[self.decided_by]

    @property
    def decided_by(self) -> str:
        """The name in `BY_STAGE` of the success that the curriculum uses."""
        by_targets = self.config.curriculum.success == "targets"
        return "success_by_stage" if by_targets else "complete_by_stage"

    @property
    def has_reached(self) -> bool:
        """Whether the run ended here because every seed had reached `run.stop_at`."""
        goal, found = self.config.run.stop_at, self.summary
        ended = found.get("updates") == int(self.updates[-1]) + 1
        return ended and goal is not None and found.get("stopped_at") == goal


def read(run: Path) -> History:
    """Reads a run directory.

    Raises:
      ConfigError: if a file is missing or damaged, or no update has a row of every seed.
    """
    trained = read_config(run)
    by_seed = _read_metrics(run, len(trained.stage))
    updates = sorted(set.intersection(*map(set, by_seed.values()))) if by_seed else []
    if not updates:
        raise ConfigError(f"{run / METRICS} has no update that every seed recorded: train first.")
    seeds = sorted(by_seed)
    rows = [[by_seed[seed][update] for update in updates] for seed in seeds]
    lists, curves = (
        np.array([[row[key] for row in of_seed] for of_seed in rows]) for key in ("lists", "curves")
    )
    names = by_seed[seeds[0]][updates[0]]["names"]
    columns = dict(zip(_LISTS, np.moveaxis(lists, 2, 0), strict=True))
    mix = np.nan_to_num(columns["mix"])
    return History(
        config=trained,
        seeds=np.array(seeds),
        updates=np.array(updates),
        arena_steps=np.array([row["arena_steps"] for row in rows[0]]),
        mix=mix / np.maximum(mix.sum(axis=-1, keepdims=True), 1.0),
        by_stage={key: columns[key] for key in BY_STAGE},
        curves=dict(zip(names, np.moveaxis(curves, 2, 0), strict=True)),
        seconds=rows[0][-1]["train_s"],
        decisions=_read_decisions(run),
        summary=read_object(run / SUMMARY) if (run / SUMMARY).exists() else {},
    )


def _read_metrics(run: Path, stages: int) -> dict[int, dict[int, Row]]:
    """Reads the values that a report needs from each row, by seed and update.

    The values become arrays, which need less memory than lists. `lists` [K, S] has the values of
    the K keys in `_LISTS`. `curves` has those of `CURVES` and of the goal's first own measure,
    which `names` lists. nan stands for null.
    """
    by_seed: dict[int, dict[int, Row]] = {}
    for where, row in read_lines(run, METRICS):
        check(row, ("seed", "update", "arena_steps"), COUNT, where)
        own = [name for name in row if name.startswith(MEASURED)][:1]
        names = (*CURVES, *own)
        check(row, ("train_s", *names), NUMBER_OR_NULL, where)
        check(row, _LISTS, list_of(NUMBER_OR_NULL, stages), where)
        by_seed.setdefault(row["seed"], {})[row["update"]] = {
            "arena_steps": row["arena_steps"],
            "train_s": row.get("train_s"),
            "lists": np.array([row[key] for key in _LISTS], np.float32),
            "names": names,
            "curves": np.array([row.get(key) for key in names], np.float32),
        }
    return by_seed


def shared_stages(histories: Sequence[History]) -> list[str]:
    """Names the stages that all runs have, in the order of the first run."""
    return [n for n in histories[0].names if all(n in each.names for each in histories)]


def measure(history: History) -> str:
    """Names the quantity that `History.success` holds."""
    by_targets = history.decided_by == "success_by_stage"
    return "targets reached" if by_targets else "episodes in which all arrived"


def together(values: np.ndarray) -> np.ndarray:
    """Computes the interquartile mean over seeds at the points where every seed has a value.

    Where only some seeds have a value, these are the fast seeds, whose mean would be biased.

    Args:
      values: [N, ...] with nan for a missing value.

    Returns:
      [...] with nan where a seed has no value.
    """
    missing = np.isnan(values).any(axis=0)
    return np.where(missing, np.nan, iqm(np.where(missing, 0.0, values), axis=0))


def among(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Computes the interquartile mean [S] over the seeds that have a value, and counts them.

    Args:
      values: [N, S] with nan for a missing value.

    Returns:
      The means [S], nan where no seed has a value, and the counts [S].
    """
    there = ~np.isnan(values)
    mean = [iqm(v[t]) if t.any() else np.nan for v, t in zip(values.T, there.T, strict=True)]
    return np.array(mean), there.sum(axis=0)


def check(row: Mapping[str, Any], keys: Iterable[str], kind: ValueKind, where: str) -> None:
    """Checks that values of a row have the given kind.

    Args:
      row: the row as recorded.
      keys: keys of the values; a missing key counts as null.
      kind: the kind that all values must have.
      where: names the row in the message.

    Raises:
      ConfigError: if a value has another kind.
    """
    for key in keys:
        if not kind.fits(row.get(key)):
            raise ConfigError(f"{where} has no {kind.name} as {key}: it is damaged.")


def read_config(run: Path) -> TrainConfig:
    """Reads the config of a run.

    Raises:
      ConfigError: if there is no config, or it is invalid.
    """
    stored = load_settings.read_config(run)
    try:
        return load_settings.from_stored(stored)
    except ConfigError as error:
        raise ConfigError(f"{run / CONFIG} is not valid: {error}") from None


def read_object(path: Path) -> Row:
    """Reads a file that holds one JSON object.

    Raises:
      ConfigError: if the file cannot be read, or does not hold one JSON object.
    """
    content = reading.read_json(path)
    if not MAP.fits(content):
        raise ConfigError(f"{path} holds no keys and values: it is damaged.")
    return content


def _read_decisions(run: Path) -> list[Row]:
    """Reads the decisions of the curriculum, sorted by seed and update."""
    decisions = []
    for where, row in read_lines(run, DECISIONS):
        check(row, ("seed", "update"), COUNT, where)
        check(row, ("targets_reached", "all_reached"), NUMBER_OR_NULL, where)
        decisions.append(row)
    return sorted(decisions, key=lambda row: (row["seed"], row["update"]))


def read_lines(run: Path, name: str) -> Iterator[tuple[str, Row]]:
    """Reads a file with one JSON object per line; skips a last line without a newline.

    Args:
      run: the run directory.
      name: name of the file.

    Yields:
      A phrase that names the line, and the line's object.

    Raises:
      ConfigError: if the file is missing or cannot be read, or a line is not one JSON object.
    """
    path = run / name
    if not path.exists():
        raise ConfigError(f"{run} has no {name}: it holds no training yet.")
    for number, line in enumerate(reading.read_lines(path), 1):
        if not line.endswith(b"\n"):
            return
        where = f"{path} in line {number}"
        yield where, _object(line, where)


def _object(line: bytes, where: str) -> Row:
    """Parses a line that should hold one JSON object; `where` names the line in messages."""
    try:
        row = reading.parse_json(line.decode(), where)
    except (ConfigError, UnicodeDecodeError):
        row = None
    if not isinstance(row, dict):
        raise ConfigError(f"{where} is damaged: resume the run, or remove the line.")
    return row
