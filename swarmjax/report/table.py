"""Compares several runs in a table, one line per group of equal settings. No JAX.

A line may hold one run with several seeds, or several runs with one or more seeds each, as the jobs
of an array write them. Success is the last stage's newest verdict.
"""

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax.config import ConfigError, check_text, show, to_dict
from swarmjax.config.section import keys
from swarmjax.evaluate.statistics import LEAST_DRAWN, bootstrap
from swarmjax.report import rows
from swarmjax.report.rows import History
from swarmjax.run.directory import CONFIG, METRICS
from swarmjax.run.load_settings import leaves
from swarmjax.run.settings import TrainConfig

_DEEP = 2  # levels of subfolders that are searched for runs
# Runs on one line may differ in these settings: which seeds they have, and how they ran.
_APART = ("seed", "seeds", "seeds_by", "devices", "streams", "resume", "run")
HEADS = (
    "runs",
    "settings",
    "last stage",
    "updates",
    "seeds",
    "success",
    "95 % interval",
    "train (s)",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class TableLine:
    """All seeds of the same settings.

    Attributes:
      runs: their directories.
      settings: the settings that differ from the other lines, as `key=value` words.
      stage: name of the last stage.
      updates: updates that all of the runs have done, and updates that they are to do.
      seeds: [N], increasing.
      success: [N] success of the last stage's newest cohort, 0 to 1; nan where there is none yet.
      measure: names the quantity in `success`.
      train_s: training time of all runs together, s; None if it was not recorded.
    """

    runs: tuple[Path, ...]
    settings: str
    stage: str
    updates: tuple[int, int]
    seeds: np.ndarray
    success: np.ndarray
    measure: str
    train_s: float | None

    @property
    def measured(self) -> np.ndarray:
        """The success [M] of the seeds that have one."""
        return self.success[~np.isnan(self.success)]

    @property
    def mean(self) -> float:
        """The mean success over seeds; nan where no seed has one."""
        return float(self.measured.mean()) if len(self.measured) else math.nan

    @property
    def interval(self) -> tuple[float, float] | None:
        """The ends of the mean's 95 % interval over seeds; None for fewer than three seeds."""
        if len(self.measured) < LEAST_DRAWN:
            return None
        mean = bootstrap(self.measured[:, None], np.mean)
        return mean.low, mean.high


def find(text: str) -> list[Path]:
    """Finds run directories.

    Args:
      text: run directories, folders of runs and patterns for either, separated by commas.

    Returns:
      Run directories, in the order given. The runs of a pattern or a folder come in alphabetical
      order, without runs that have not trained yet.

    Raises:
      ConfigError: if an entry names no run, or a run is named twice.
    """
    check_text("runs", text)
    runs: list[Path] = []
    for part in [text] if os.path.isdir(text) else text.split(","):
        named = sorted(glob(part)) if set(part) & set("*?[") else [part]
        within = [run for path in named for run in _within(Path(path), part)]
        if not part or not within:
            raise ConfigError(
                f"runs is {show(text)}, but {show(part)} names neither a run nor a folder of runs."
            )
        runs += within
    twice = [str(run) for run in runs if runs.count(run) > 1]
    if twice:
        raise ConfigError(f"runs is {show(text)}, which names {twice[0]} twice: give it once.")
    return runs


def _within(path: Path, part: str, deep: int = _DEEP) -> Iterator[Path]:
    """Finds the run at a path, or the runs in that folder that have begun to train."""
    if (path / CONFIG).exists():
        if _has_trained(path) or path == Path(part):
            yield path
    elif path.is_dir() and deep:
        for inner in sorted(path.iterdir()):
            yield from _within(inner, part, deep - 1)


def _has_trained(run: Path) -> bool:
    return (run / METRICS).exists() and (run / METRICS).stat().st_size > 0


def read(runs: Sequence[Path]) -> list[TableLine]:
    """Reads runs and joins runs with the same settings into one line.

    Args:
      runs: run directories.

    Raises:
      ConfigError: if a run cannot be read, or two runs of the same settings share a seed.
    """
    groups: dict[str, list[tuple[Path, History]]] = {}
    for run in runs:
        history = rows.read(run)
        groups.setdefault(json.dumps(_settings(history)), []).append((run, history))
    flat = [leaves(json.loads(key)) for key in groups]
    return [
        join(group, _differences(each, flat))
        for each, group in zip(flat, groups.values(), strict=True)
    ]


def read_each(labels: Mapping[Path, str]) -> list[TableLine]:
    """Reads runs that have trained, one line per run.

    Args:
      labels: what distinguishes each run, by directory.

    Raises:
      ConfigError: if a run cannot be read.
    """
    trained = {run: label for run, label in labels.items() if _has_trained(run)}
    return [join([(run, rows.read(run))], label) for run, label in trained.items()]


def join(group: Sequence[tuple[Path, History]], settings: str) -> TableLine:
    """Joins runs of the same settings into one line.

    Args:
      group: run directories and their histories.
      settings: the settings that differ from other lines.

    Raises:
      ConfigError: if two of them share a seed.
    """
    owner: dict[int, Path] = {}
    for run, history in group:
        for seed in history.seeds.tolist():
            if seed in owner:
                raise ConfigError(
                    f"seed {seed} is in {owner[seed]} and in {run}, which have the same settings: "
                    "give one of them."
                )
            owner[seed] = run
    histories = [history for _, history in group]
    seeds = np.concatenate([history.seeds for history in histories])
    success = np.concatenate([history.success[:, -1, -1] for history in histories])
    seconds = [history.seconds for history in histories]
    config = histories[0].config
    return TableLine(
        runs=tuple(run for run, _ in group),
        settings=settings,
        stage=config.stage[-1].name,
        updates=(min(int(each.updates[-1]) + 1 for each in histories), config.updates),
        seeds=np.sort(seeds),
        success=success[np.argsort(seeds)],
        measure=rows.measure(histories[0]),
        train_s=None if None in seconds else math.fsum(s for s in seconds if s is not None),
    )


def _settings(history: History) -> dict[str, Any]:
    """Takes the settings that runs must share to be joined into one line."""
    return {key: value for key, value in to_dict(history.config).items() if key not in _APART}


def _differences(mine: Mapping[str, Any], every: Sequence[Mapping[str, Any]]) -> str:
    """Writes the settings that differ between lines, without settings that follow from others."""
    derived = {*keys(TrainConfig, derived=True), "stage"}
    differing = [
        key
        for key, value in mine.items()
        if key not in derived - {"stage_name"} and any(other.get(key) != value for other in every)
    ]
    words = (f"{key.removesuffix('_name')}={show(mine[key], quote='')}" for key in differing)
    return " ".join(words)


def cells(lines: Sequence[TableLine]) -> list[tuple[str, ...]]:
    """Writes lines as text in the columns of `HEADS`."""
    return [
        (
            _place(line.runs),
            line.settings or "-",
            line.stage,
            f"{line.updates[0]:,} of {line.updates[1]:,}",
            _seeds(line),
            "-" if math.isnan(line.mean) else f"{100.0 * line.mean:.1f} %",
            _interval(line.interval),
            "-" if line.train_s is None else f"{line.train_s:,.1f}",
        )
        for line in lines
    ]


def note(lines: Sequence[TableLine]) -> str:
    """Explains the success and interval columns."""
    measures = " or ".join(sorted({line.measure for line in lines}))
    return (
        f"Success: {measures} on the last stage, in its newest whole cohort; mean over seeds and "
        f"95 % bootstrap interval, which needs {LEAST_DRAWN} seeds or more."
    )


def text(lines: Sequence[TableLine]) -> str:
    """Writes lines as a table for a terminal, with a note."""
    table = [HEADS, *cells(lines)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    written = (
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in table
    )
    return "\n".join([*written, note(lines)])


def plain(lines: Sequence[TableLine]) -> list[dict[str, Any]]:
    """Writes lines as plain data for JSON, with null for missing values."""
    return [
        {
            "runs": [str(run) for run in line.runs],
            "settings": line.settings,
            "stage": line.stage,
            "updates": line.updates[0],
            "budget_spent": line.updates[0] >= line.updates[1],
            "seeds": line.seeds.tolist(),
            "success": [None if math.isnan(each) else each for each in line.success.tolist()],
            "measure": line.measure,
            "mean": None if math.isnan(line.mean) else line.mean,
            "interval": line.interval,
            "train_s": line.train_s,
        }
        for line in lines
    ]


def _place(runs: Sequence[Path]) -> str:
    """Names a run; for several runs, their common folder and how many they are."""
    if len(runs) == 1:
        return str(runs[0])
    return f"{len(runs)} in {os.path.commonpath(runs)}"


def _seeds(line: TableLine) -> str:
    """Writes the number of seeds, and how many have a success if not all do."""
    of, measured = len(line.seeds), len(line.measured)
    return str(of) if measured == of else f"{of}, {measured} measured"


def _interval(ends: tuple[float, float] | None) -> str:
    return "-" if ends is None else f"{100.0 * ends[0]:.1f} to {100.0 * ends[1]:.1f} %"
