"""Draws levels of a suite: `python -m benchmarks.worlds_figure suite=worlds out=FILE.png`.

The figure shows one level of each cell of the suite from above. Walls and boxes are black. A robot
is a disc, and the arrival zone of its target is a circle of the same colour.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import matplotlib as mpl

from benchmarks import key_value
from swarmjax import command
from swarmjax.config import Section, about
from swarmjax.config.section import MAX_COUNT
from swarmjax.evaluate import cells
from swarmjax.evaluate.suite_config import CellConfig, read_suite
from swarmjax.report import levels as report_levels
from swarmjax.task.config import TaskConfig
from swarmjax.task.level import Level

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

COLUMNS = 5


@dataclass(frozen=True, kw_only=True)
class WorldsFigureConfig(Section):
    """Settings: what to draw."""

    suite: str = field(default="worlds", metadata=about("a name of configs/suites/, or a file"))
    out: str = field(metadata=about("file .png"))
    level: int = field(default=0, metadata=about("which level of each cell", 0, MAX_COUNT))


def draw(chosen: Sequence[CellConfig], number: int, out: Path) -> None:
    """Draws one level of each cell into a file.

    Args:
      chosen: The cells.
      number: Number of the level.
      out: The file.
    """
    count = math.ceil(len(chosen) / COLUMNS)
    figure, axes = plt.subplots(count, COLUMNS, figsize=(2.2 * COLUMNS, 2.4 * count), squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, cell in zip(axes.flat, chosen, strict=False):
        one = replace(cell, levels=1, episodes=(number,), digest=None)
        _draw_level(axis, cells.split(cells.draw_cell(one).levels)[0], cell.name)
    figure.tight_layout()
    figure.savefig(out, dpi=100)
    plt.close(figure)


def _draw_level(axis: Axes, drawn: Level, name: str) -> None:
    axis.set_title(name)
    report_levels.draw_level(axis, drawn, TaskConfig().target_radius)


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = key_value.load(WorldsFigureConfig, arguments)
    draw(read_suite(settings.suite).cells, settings.level, Path(settings.out))
    return 0


if __name__ == "__main__":
    sys.exit(command.run("worlds_figure", main, WorldsFigureConfig))
