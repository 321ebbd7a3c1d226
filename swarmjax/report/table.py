"""Compares several runs in a table, one line per group of equal settings. Needs no JAX.

A line may hold one run with several seeds, or several runs with one or more seeds each, as the jobs
of an array write them. Success is that of the newest whole cohort on the last stage.
"""

import itertools
import json
import math
import os
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmjax.config import ConfigError, check_text, files, show, to_dict
from swarmjax.config.section import keys
from swarmjax.evaluate.statistics import LEAST_DRAWN, bootstrap
from swarmjax.report import rows
from swarmjax.report.rows import History
from swarmjax.run.directory import CONFIG, METRICS
from swarmjax.run.settings import TrainConfig

# Runs on one line may differ in these settings: which seeds they have, and how they ran.
_APART = ("seed", "seeds", "seeds_by", "devices", "streams", "resume", "run")
HEADS = ("settings", "stage", "updates", "seeds", "success", "95 %", "train (s)", "runs")
_WIDTH = 100  # characters of a line on the terminal


class TableLine(NamedTuple):
    """All seeds of the same settings, as plain data.

    Attributes:
      runs: their directories.
      settings: the settings that differ from the other lines, as `key=value` words.
      stage: name of the last stage.
      updates: number of updates that each run has done at least.
      budget: number of updates that each run is to do.
      seeds: increasing.
      success: success of each seed on the last stage, in the newest cohort, 0 to 1; None without
        one.
      measure: names the quantity in `success`.
      mean: mean success over the seeds that have one; None where no seed has one.
      interval: ends of the mean's 95 % interval over seeds; None for fewer than three seeds.
      train_s: training time of all runs together, s; None if it was not recorded.
    """

    runs: list[str]
    settings: str
    stage: str
    updates: int
    budget: int
    seeds: list[int]
    success: list[float | None]
    measure: str
    mean: float | None
    interval: list[float] | None
    train_s: float | None


def find(text: str) -> list[Path]:
    """Finds run directories.

    Args:
      text: run directories and folders of runs, separated by commas.

    Returns:
      Run directories, in the order given. The runs of a folder and of its subfolders come in
      alphabetical order, without runs that have not trained yet.

    Raises:
      ConfigError: if an entry names no run.
    """
    check_text("runs", text)
    runs: list[Path] = []
    for part in text.split(","):
        path = Path(part)
        inner = sorted([*path.glob("*"), *path.glob("*/*")])
        within = [path] if (path / CONFIG).exists() else list(filter(_has_trained, inner))
        if not part or not within:
            raise ConfigError(
                f"runs is {show(text)}, but {show(part)} names neither a run nor a folder of runs."
            )
        runs += within
    return runs


def _has_trained(run: Path) -> bool:
    metrics = run / METRICS
    return (run / CONFIG).exists() and metrics.exists() and metrics.stat().st_size > 0


class Group(NamedTuple):
    """Runs of the same settings: their line of the table, and their histories."""

    line: TableLine
    histories: list[History]


def read(runs: Sequence[Path]) -> list[Group]:
    """Reads runs and joins runs with the same settings into one group.

    Args:
      runs: run directories.

    Raises:
      ConfigError: if a run cannot be read, or two runs of the same settings share a seed.
    """
    groups: dict[str, list[tuple[Path, History]]] = {}
    for run in runs:
        history = rows.read(run)
        shared = {k: v for k, v in to_dict(history.config).items() if k not in _APART}
        shared["run"] = {"stop_at": history.config.run.stop_at}  # this key may end runs early
        shared["stage"] = {stage["name"]: stage for stage in shared["stage"]}
        groups.setdefault(json.dumps(shared), []).append((run, history))
    flat = [files.flatten(json.loads(key)) for key in groups]
    return [
        Group(join(group, _differences(each, flat)), [history for _, history in group])
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
    histories = [history for _, history in group]
    every = [seed for history in histories for seed in history.seeds.tolist()]
    if len(set(every)) < len(every):
        places = " and ".join(str(run) for run, _ in group)
        raise ConfigError(f"{places} have the same settings and share a seed: give one of them.")
    shares = [share for history in histories for share in history.success[:, -1, -1].tolist()]
    success = dict(sorted(zip(every, shares, strict=True)))
    measured = np.array([share for share in success.values() if not math.isnan(share)])
    seconds = [history.seconds for history in histories if history.seconds is not None]
    config, several = histories[0].config, len(measured) >= LEAST_DRAWN
    return TableLine(
        runs=[str(run) for run, _ in group],
        settings=settings,
        stage=config.stage[-1].name,
        updates=min(int(each.updates[-1]) + 1 for each in histories),
        budget=config.updates,
        seeds=list(success),
        success=[None if math.isnan(share) else share for share in success.values()],
        measure=rows.measure(histories[0]),
        mean=float(measured.mean()) if len(measured) else None,
        interval=list(bootstrap(measured[:, None], np.mean)[1:]) if several else None,
        train_s=math.fsum(seconds) if len(seconds) == len(group) else None,
    )


def _differences(mine: Mapping[str, Any], every: Sequence[Mapping[str, Any]]) -> str:
    """Writes the settings that differ between lines, except those that follow from other settings.

    Stages of one name are compared setting by setting. An extension's piece is written without its
    digest.
    """
    derived, written = keys(TrainConfig, derived=True).keys() - {"stage_name"}, []
    for key, value in mine.items():
        missing = value if key.startswith("stage.") else None  # `stage=` names the stages
        if key not in derived and any(other.get(key, missing) != value for other in every):
            piece = key.removeprefix("pieces.").replace(".", "=", 1)
            text = f"{key.removesuffix('_name')}={show(value, quote='')}"
            written.append(piece if key.startswith("pieces.") else text)
    return " ".join(written)


def cells(line: TableLine) -> tuple[str, ...]:
    """Writes a line as text in the columns of `HEADS`."""
    first, count = line.runs[0], len(line.runs)
    folder = os.path.commonpath(map(os.path.abspath, line.runs))
    seeds, unmeasured = len(line.seeds), line.success.count(None)
    return (
        line.settings or "-",
        line.stage,
        f"{line.updates:,} of {line.budget:,}",
        f"{seeds}, {seeds - unmeasured} measured" if unmeasured else str(seeds),
        "-" if line.mean is None else f"{100.0 * line.mean:.1f} %",
        "-" if line.interval is None else "{:.1%} to {:.1%}".format(*line.interval),
        "-" if line.train_s is None else f"{line.train_s:,.1f}",
        first if count == 1 else f"{count} in {folder}",
    )


def text(lines: Sequence[TableLine]) -> str:
    """Writes lines as a table for a terminal, with a note about success and its interval."""
    table = [HEADS, *map(cells, lines)]
    columns = list(zip(*table, strict=True))
    widths = [max(map(len, column)) for column in columns]
    # The settings go onto several lines first. A word is cut only if that does not suffice.
    least = [max(map(len, " ".join(columns[0]).split())), *widths[1:]]
    while sum(widths) > _WIDTH - 2 * (len(widths) - 1):
        at = max(range(len(widths)), key=lambda i: (max(widths[i] - least[i], 0), widths[i]))
        widths[at] -= 1
    written = []
    for row in table:
        wrapped = [textwrap.wrap(cell, width) for cell, width in zip(row, widths, strict=True)]
        for parts in itertools.zip_longest(*wrapped, fillvalue=""):
            written.append("  ".join(map(str.ljust, parts, widths)).rstrip())
    measures = " or ".join(sorted({line.measure for line in lines}))
    note = (
        f"Success: {measures} on the last stage, over its newest episodes that began together. "
        f"Mean over seeds, with its 95 % bootstrap interval for {LEAST_DRAWN} seeds or more. "
        "Curves show the interquartile mean instead."
    )
    return "\n".join([*written, *textwrap.wrap(note, _WIDTH)])
