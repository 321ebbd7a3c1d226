"""`python -m swarmjax.suite suite=NAME [out=FILE]`: draws the levels of a suite.

The levels are checked against the digests in the suite's file. `write=true` writes new digests into
it. With `policies`, each cell gets the levels of a pool that these policies fail most.
"""

import json
import re
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from swarmjax import command, outputs
from swarmjax.config import ConfigError, about, files, reading
from swarmjax.config.section import Section
from swarmjax.evaluate import cells, trials
from swarmjax.evaluate.cells import Cell, Suite
from swarmjax.evaluate.config import MOST_STEPS, STEPS, EvaluateConfig
from swarmjax.evaluate.evaluation import list_files
from swarmjax.evaluate.suite_config import CellConfig, read_suite
from swarmjax.evaluate.table import PLAIN_WIDTH
from swarmjax.evaluate.trials import Entrant, Trial
from swarmjax.outputs import OVERWRITE, replacing

_WIDTH = 100  # columns of a suite's file


@dataclass(frozen=True, kw_only=True)
class SuiteConfig(Section):
    """The suite to draw, and the outputs."""

    command: ClassVar[str] = "suite"

    suite: str = field(metadata=about("a name in configs/suites/, or a .yaml file"))
    out: str | None = field(default=None, metadata=about(".npz file for all of its levels"))
    overwrite: bool = field(default=False, metadata=OVERWRITE)
    write: bool = field(
        default=False,
        metadata=about("write digests, and chosen episodes, into the suite's file"),
    )
    policies: str | None = field(
        default=None,
        metadata=about("choose the levels that these policies fail most: a.npz,b.npz or a pattern"),
    )
    pool: int = field(default=20_000, metadata=about("levels drawn to choose from", 1, 1_000_000))
    steps: int | None = field(
        default=None,
        metadata=about(
            f"control steps of an episode; null: as in the cell, else {STEPS}", 1, MOST_STEPS
        ),
    )
    workers: int | None = field(
        default=None, metadata=about("processes; null: one per core", 1, 1024)
    )


def choose(trial: Trial, count: int) -> np.ndarray:
    """Chooses the levels that policies fail most.

    Args:
      trial: Trial of one or more policies on a pool of levels.
      count: Number of levels to choose, at most the size of the pool.

    Returns:
      Their numbers [count], rising. Levels with the fewest reached targets are chosen first.
      Ties go to the level with the most contacts, then to the slowest, then to the first.
    """
    reached, contacts, time = (
        trial.found[name].mean(axis=0)
        for name in ("targets_reached", "contacts_per_robot", "time_to_reach_s")
    )
    worst = np.lexsort((trial.cell.episodes, -time, -contacts, reached))[:count]
    return np.sort(trial.cell.episodes[worst])


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = files.load(SuiteConfig, arguments)
    if settings.policies is not None and not settings.write:
        raise ConfigError(
            "policies is given, but write is false: give write=true, which puts the levels that "
            "are chosen into the suite's file."
        )
    if settings.out is not None and Path(settings.out).suffix != ".npz":
        raise ConfigError(f"out is {reading.called(settings.out)}: give a file .npz.")
    out = [] if settings.out is None else [Path(settings.out)]
    outputs.check("out", out, overwrite=settings.overwrite)
    suite = _renew(settings) if settings.write else cells.draw(settings.suite)
    for path in out:
        cells.write(path, suite)
    outputs.note(out)
    console = Console()
    if not console.is_terminal:
        console.width = PLAIN_WIDTH
    _show(console, suite)
    return 0


def _renew(settings: SuiteConfig) -> Suite:
    """Draws a suite without checking its digests, and writes the new digests into its file."""
    file = read_suite(settings.suite)
    wanted = file.cells
    if settings.policies is not None:
        entrants = trials.read_policies(list_files("policies", settings.policies))
        wanted = tuple(_search(settings, each, entrants) for each in wanted)
    suite = Suite(file.name, tuple(cells.draw_cell(each) for each in wanted))
    path = files.named_path("suites", settings.suite, "suite")
    content = files.read_yaml(path)
    for entry, cell, chosen in zip(content["cells"], suite.cells, wanted, strict=True):
        entry["digest"] = cell.digest
        if chosen.episodes:
            entry["episodes"] = list(chosen.episodes)
    _replace(path, _comment(path) + to_yaml(content))
    return suite


def _replace(path: Path, text: str) -> None:
    """Replaces the text of a file, whole or not at all."""
    try:
        with replacing(path) as temporary:
            temporary.write_text(text)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror or error}.") from None


def _search(settings: SuiteConfig, cell: CellConfig, entrants: Sequence[Entrant]) -> CellConfig:
    """Gives a cell the levels of a pool that policies fail most."""
    if settings.pool < cell.levels:
        raise ConfigError(
            f"pool is {settings.pool}, but cell {cell.name} takes {cell.levels} levels: give more."
        )
    pool = cells.draw_cell(replace(cell, levels=settings.pool, episodes=(), digest=None))
    judged = EvaluateConfig(
        policy=settings.policies,
        stage=cell.stage,
        action="mean",  # a level should not depend on lucky draws
        steps=settings.steps,
        workers=settings.workers,
    )
    progress = Progress(console=Console(stderr=True), transient=True)
    progress.disable = not progress.console.is_terminal
    with progress:
        bar = progress.add_task(cell.name, total=settings.pool * len(entrants))
        (trial,) = trials.run(judged, [pool], entrants, partial(progress.advance, bar))
    chosen = choose(trial, cell.levels)
    return replace(cell, episodes=tuple(chosen.tolist()), digest=None)


def _comment(path: Path) -> str:
    """Returns the comment lines at the beginning of a file."""
    lines = reading.read_text(path).splitlines(keepends=True)
    end = next((i for i, line in enumerate(lines) if not line.startswith("#")), len(lines))
    return "".join(lines[:end])


def to_yaml(content: dict[str, Any]) -> str:
    """Formats a suite's file: a line for each key, with lists of numbers wrapped.

    Args:
      content: Plain data, as from `files.read_yaml`.

    Returns:
      The text.
    """
    lines = [f"{key}: {_flow(value)}" for key, value in content.items() if key != "cells"]
    lines.append("cells:")
    for cell in content["cells"]:
        for i, (key, value) in enumerate(cell.items()):
            head = f"  {' ' if i else '-'} {key}: "
            lines += textwrap.wrap(
                head + _flow(value),
                _WIDTH,
                subsequent_indent=" " * 6,
                break_long_words=False,
                break_on_hyphens=False,
            )
    return "\n".join(lines) + "\n"


def _flow(value: Any) -> str:
    """Formats a value in YAML's flow style; quotes text only where YAML would misread it."""
    if isinstance(value, dict):
        items = (f"{_flow(key)}: {_flow(item)}" for key, item in value.items())
        return "{" + ", ".join(items) + "}"
    if isinstance(value, str) and re.fullmatch(r"[A-Za-z_][\w-]*", value, re.ASCII):
        return value if yaml.safe_load(value) == value else json.dumps(value)
    return json.dumps(value, ensure_ascii=False)


def _show(console: Console, suite: Suite) -> None:
    """Prints a row for each cell."""
    table = Table(box=box.SIMPLE if console.is_terminal else None)
    heads = (
        "cell",
        "robots",
        "obstacles",
        "side",
        "shape",
        "realism",
        "friction",
        "steps",
        "levels",
        "unreachable",
    )
    for i, head in enumerate((*heads, "digest")):
        table.add_column(head, justify="right" if 0 < i < len(heads) else "left")
    for cell in suite.cells:
        table.add_row(*_row(cell))
    console.print(table)


def _row(cell: Cell) -> list[str]:
    stage = cell.stage
    lost = np.isinf(trials.ways(EvaluateConfig(policy="", stage=stage), cell.levels))
    numbers = (stage.robots, stage.obstacles, f"{'-'.join(f'{x:g}' for x in set(stage.sides))} m")
    friction = "-" if cell.hull_friction is None else f"{cell.hull_friction:g}"
    words = (cell.shape, cell.realism or "-", friction, cell.steps or "-")
    counts = (len(cell.episodes), int(lost.any(axis=-1).sum()))
    return [str(each) for each in (cell.name, *numbers, *words, *counts, cell.digest[:12])]


if __name__ == "__main__":
    sys.exit(command.run("suite", main, SuiteConfig))
