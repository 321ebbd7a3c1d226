"""Draws the success of several runs into the same panels, with Matplotlib.

The runs differ in lightness and in the style of their lines, so they can also be told apart in grey
print.
"""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from swarmjax import words
from swarmjax.evaluate.statistics import LEAST_DRAWN, curve, iqm
from swarmjax.pages import figures as drawing
from swarmjax.report import figures as report_figures
from swarmjax.report import rows, table
from swarmjax.report.table import Group, TableLine

_POINTS = 200  # points of a curve; the interval of each point takes a bootstrap
_STYLES = ("-", "--", "-.", ":")
_LONGEST = 60  # characters of settings, or of directories, in the legend


def success(groups: Sequence[Group], stages: Sequence[str]) -> Figure:
    """Draws the success on each stage in its own panel, with a curve for each group of runs.

    A curve is the interquartile mean over seeds, at the updates where every seed has a value. With
    three seeds or more, its 95 % bootstrap interval is drawn too. All curves show the kind of
    success by which the curriculum of the first run decides.

    Args:
      groups: runs, in the order of the table.
      stages: names of stages that all runs have.
    """
    first = groups[0].histories[0]
    last_step = max(min(each.arena_steps[-1] for each in group.histories) for group in groups)
    titles = [_title(groups, name) for name in stages]
    figure, panels = report_figures.over_training(last_step, titles)
    colours = report_figures.colours(len(groups))
    looks = [{"color": c, "ls": _STYLES[i % len(_STYLES)]} for i, c in enumerate(colours)]
    for group, look in zip(groups, looks, strict=True):
        for name, panel in zip(stages, panels, strict=True):
            _draw(panel, *_joined(group, first.decided_by, name), look)
    figure.supylabel(f"{rows.measure(first)}, interquartile mean", fontsize=10)
    _explain(figure, [group.line for group in groups], looks)
    return figure


def _joined(group: Group, measure: str, stage: str) -> tuple[np.ndarray, np.ndarray]:
    """Joins the seeds of a group's runs on one stage, at the updates that all runs have done.

    Returns:
      Arena control steps [T], and success [N, T].
    """
    runs = group.histories
    count = min(len(each.updates) for each in runs)
    values = [each.by_stage[measure][:, :count, each.names.index(stage)] for each in runs]
    return runs[0].arena_steps[:count], np.concatenate(values)


def _draw(panel: Axes, steps: np.ndarray, success: np.ndarray, look: Mapping[str, Any]) -> None:
    """Draws a curve with its interval."""
    whole = np.flatnonzero(~np.isnan(success).any(axis=0))
    if not len(whole):
        return
    at = whole[report_figures.spread(len(whole), _POINTS)]
    report_figures.line(panel, steps[at], np.asarray(iqm(success[:, at], axis=0)), lw=2.0, **look)
    if len(success) >= LEAST_DRAWN:
        band = curve(success[:, at])
        panel.fill_between(steps[at], band.low, band.high, color=look["color"], alpha=0.2, lw=0)


def _title(groups: Sequence[Group], name: str) -> str:
    """Writes the title of a stage's panel."""
    histories = [each for group in groups for each in group.histories]
    stages = {each.config.stage[each.names.index(name)] for each in histories}
    label = histories[0].labels[histories[0].names.index(name)]
    return label if len(stages) == 1 else f"{label}, not the same in all runs"


def _explain(figure: Figure, lines: Sequence[TableLine], looks: Sequence[Mapping]) -> None:
    """Adds the legend, and makes the figure higher so that the legend fits."""
    kinds: list[Line2D | Patch] = [
        Line2D([], [], lw=2.0, label=_label(line), **look)
        for line, look in zip(lines, looks, strict=True)
    ]
    if any(len(line.seeds) >= LEAST_DRAWN for line in lines):
        kinds.append(Patch(color="0.8", label="95 % interval over seeds"))
    figure.set_figheight(figure.get_figheight() + 0.17 * len(kinds))
    drawing.explain(figure, kinds, 1)


def _label(line: TableLine) -> str:
    """Labels a curve with the directories of its runs, the number of seeds and the settings."""
    place, seeds = table.cells(line)[-1], words.count(len(line.seeds), "seed")
    settings = textwrap.shorten(line.settings, _LONGEST, placeholder=" ...")
    label = f"{words.shorten(place, _LONGEST)} ({seeds}) {settings}".rstrip()
    return label.replace("$", r"\$")  # a pair of $ would enclose a formula
