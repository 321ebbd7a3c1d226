"""`python -m swarmjax.suite suite=NAME [out=FILE]`: draws the levels of a suite.

The levels are checked against the digests in the suite's file. A cell without a digest is drawn
unchecked; the table shows the digest to put into the file.

Examples:
  # draw the levels, and check them against the digests in the suite's file
  python -m swarmjax.suite suite=headline
  # write all levels to a file that evaluate reads
  python -m swarmjax.suite suite=headline out=headline.npz
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from swarmjax import command
from swarmjax.config import ConfigError, about, files, reading, setting
from swarmjax.config.section import Section
from swarmjax.evaluate import cells, trials
from swarmjax.evaluate.cells import Cell, Suite
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.table import PLAIN_WIDTH


@dataclass(frozen=True, kw_only=True)
class SuiteConfig(Section):
    """The suite to draw, and the outputs."""

    command: ClassVar[str] = "suite"

    suite: str = field(metadata=about("a name in configs/suites/, or a .yaml file"))
    out: str | None = setting(None, ".npz file for all of its levels")


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = files.load(SuiteConfig, arguments)
    if settings.out is not None and Path(settings.out).suffix != ".npz":
        raise ConfigError(f"out is {reading.called(settings.out)}: give a file .npz.")
    suite = cells.draw(settings.suite)
    if settings.out is not None:
        cells.write(Path(settings.out), suite)
    console = Console()
    if not console.is_terminal:
        console.width = PLAIN_WIDTH + 64  # a digest has 64 letters
    _show(console, suite)
    return 0


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
    return [str(each) for each in (cell.name, *numbers, *words, *counts, cell.digest)]


if __name__ == "__main__":
    sys.exit(command.run("suite", main, SuiteConfig))
