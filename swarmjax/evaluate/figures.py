"""The plots of an evaluation, with Matplotlib."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from swarmjax.evaluate.trials import Trial
from swarmjax.pages import figures as drawing

_MARK, _WORST = "#0b4f9e", "#c04000"
_ROW = 0.32  # inches per cell


def png_files(result: Mapping[str, Any], trials: Sequence[Trial], limit: float) -> dict[str, bytes]:
    """Draws the plots of an evaluation.

    Args:
      result: Result of `summary.result`.
      trials: Results of the policies, one for each cell.
      limit: Length of an episode, s.

    Returns:
      PNG files by name, `measures` and `times`. The same evaluation gives the same files.
    """
    return {
        "measures": drawing.png(intervals(result)),
        "times": drawing.png(times(trials, limit)),
    }


def intervals(result: Mapping[str, Any]) -> Figure:
    """Draws each cell's targets and contacts: the mean with its interval, and the worst levels."""
    cells = result["cells"]
    figure = Figure(figsize=(drawing.WIDTH, 1.5 + _ROW * len(cells)), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    _mark(left, cells, "targets_reached")
    left.set(xlabel="targets reached", xlim=(None, 1.005))
    left.xaxis.set_major_locator(MaxNLocator(4))
    left.xaxis.set_major_formatter(drawing.percent())
    _mark(right, cells, "contacts_per_robot")
    right.set(xlabel="contacts per robot and episode", xlim=(0, None))
    left.set_yticks(range(len(cells)), [cell["cell"] for cell in cells])
    left.set_ylim(len(cells) - 0.5, -0.5)
    figure.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def _mark(axes: Axes, cells: Sequence[Mapping[str, Any]], name: str) -> None:
    """Draws a row for each cell, with intervals as bars."""
    measured = [cell["measures"][name] for cell in cells]
    rows = np.arange(len(cells))
    for key, mark, colour, shift in (("mean", "o", _MARK, -0.12), ("iqm", "|", "0.35", 0.12)):
        middle = np.array([each[key] for each in measured])
        ends = np.array([each[f"{key}_interval"] or [each[key]] * 2 for each in measured])
        # A percentile interval need not contain the estimate, so bar and estimate are drawn
        # separately.
        label = f"{key if key == 'mean' else 'IQM'}, 95 %"
        axes.hlines(rows + shift, ends[:, 0], ends[:, 1], color=colour)
        axes.plot(middle, rows + shift, mark, color=colour, label=label)
    worst = [each["cvar"] for each in measured]
    axes.plot(worst, rows, "x", color=_WORST, label="worst 5 % of the levels")
    axes.grid(axis="x", alpha=0.3)


def times(trials: Sequence[Trial], limit: float) -> Figure:
    """Draws the share of robots that have arrived over time, a curve for each cell."""
    figure = Figure(figsize=(drawing.WIDTH, 4.2), layout="constrained")
    axes = figure.subplots()
    colours = colormaps["viridis"](np.linspace(0.0, 0.9, len(trials)))
    for trial, colour in zip(trials, colours, strict=True):
        arrival = np.sort(trial.arrival.ravel())
        share = np.arange(1, len(arrival) + 1) / len(arrival)
        there = np.isfinite(arrival)
        steps = np.concatenate([[0.0], arrival[there], [limit]])
        reached = np.concatenate([[0.0], share[there], [there.mean()]])
        axes.step(steps, reached, where="post", color=colour, label=trial.cell.name)
    axes.set(xlim=(0, limit), ylim=(0, 1.02), xlabel="time since the start, s")
    axes.set_ylabel("robots that have arrived")
    axes.yaxis.set_major_formatter(drawing.percent())
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", ncols=1 + len(trials) // 9)
    return figure
