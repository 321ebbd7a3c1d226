"""Draws the figures of a report with Matplotlib.

The colour map viridis rises evenly in lightness, so stages can also be told apart without colours
(Crameri et al. 2020, "The misuse of colour in science communication").
"""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from swarmjax.pages import figures as drawing
from swarmjax.report import rows as report_rows
from swarmjax.report.rows import History
from swarmjax.task.goals.goal import MEASURED

_POINTS, _STRETCHES = 600, 200  # points of a curve, and stretches of a band: about one per pixel
_NAMED = 24  # stages named in the legend of the mix; more names would take the figure's place
_SEED, _ALL, _LIMIT = "0.62", "#0b4f9e", "#c04000"
_STEPS = "arena control steps per seed"
_CURVES = {
    "return": "return per robot",
    "contacts_per_robot": "contacts per robot",
    "entropy": "entropy of the policy",
    "policy_loss": "policy loss",
    "value_loss": "value loss",
}


def png_files(history: History) -> dict[str, bytes]:
    """Draws the figures of a run.

    Returns:
      PNG files by name: `mix`, `success`, and `curves` if the run recorded them. The same run
      gives the same files, since they do not hold Matplotlib's version.
    """
    files = {}
    makers = {"mix": mix, "success": success, "curves": curves}
    for name, make in makers.items():
        figure = make(history)
        if figure is not None:
            files[name] = drawing.png(figure)
    return files


def mix(history: History) -> Figure:
    """Draws each stage's share of the arenas, stacked, as the mean over seeds."""
    steps, bands = _stretched(history.arena_steps, history.mix.mean(axis=0).T)
    names = history.labels
    colours = colormaps["viridis"](np.linspace(0.0, 1.0, len(names)))
    figure = Figure(figsize=(drawing.WIDTH, 4.2), layout="constrained")
    axes = figure.subplots()
    # The mix of an update holds from the end of the update before it.
    axes.stackplot(
        np.concatenate([[0], steps]),
        np.concatenate([bands[:, :1], bands], axis=1),
        colors=colours,
        step="pre",
        linewidth=0,
        antialiased=False,  # else the background shows between two bands
    )
    axes.set(xlim=(0, steps[-1]), ylim=(0, 1), xlabel=_STEPS)
    seeds = len(history.seeds)
    axes.set_ylabel("share of the arenas" + (f", mean of {seeds} seeds" if seeds > 1 else ""))
    axes.xaxis.set_major_formatter(drawing.thousands())
    axes.yaxis.set_major_formatter(drawing.percent())
    every = math.ceil(len(names) / _NAMED)
    rows = range(len(names) - 1, -1, -every)  # from the top; always names the last stage, the goal
    drawing.explain(figure, [Patch(color=colours[i], label=names[i]) for i in rows], 6)
    return figure


def success(history: History) -> Figure:
    """Draws the success of each stage in its own panel: every seed, and their IQM."""
    titles = [_title(history, i) for i in range(len(history.names))]
    figure, panels = success_panels(history.arena_steps[-1], titles)
    at = spread(len(history.updates), _POINTS)
    steps = history.arena_steps[at]
    mean = report_rows.together(history.success)[at]
    thresholds = np.broadcast_to(history.config.curriculum.threshold, len(history.names))
    for i, panel in enumerate(panels):
        panel.plot(steps, history.success[:, at, i].T, color=_SEED, lw=0.7)
        panel.plot(steps, mean[:, i], color=_ALL, lw=2.0)
        if len(panels) > 1:
            panel.axhline(thresholds[i], color=_LIMIT, lw=0.8, ls="--")
    figure.supylabel(report_rows.measure(history), fontsize=10)
    kinds = _seed_lines(history)
    if len(panels) > 1:
        kinds.append(Line2D([], [], color=_LIMIT, lw=0.8, ls="--", label="promotes"))
    drawing.explain(figure, kinds, 3)
    return figure


def success_panels(last_step: int, titles: Sequence[str]) -> tuple[Figure, list[Axes]]:
    """Makes a figure with a panel of success, 0 to 1, for each stage.

    Args:
      last_step: the last arena control step on the axis that all panels share.
      titles: of each panel.
    """
    stages = len(titles)
    columns = min(stages, 3 if stages <= report_rows.MANY else 6 if stages <= 30 else 8)
    rows = math.ceil(stages / columns)
    figure = Figure(figsize=(max(drawing.WIDTH, 1.4 * columns), max(1.2 + 1.6 * rows, 4.2)))
    figure.set_layout_engine("constrained")
    panels = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
    for i, (panel, title) in enumerate(zip(panels, titles, strict=False)):
        drawing.dress(panel, title, 7 if stages > report_rows.MANY else 10)
        panel.tick_params(labelbottom=i + columns >= stages)
    for panel in panels[stages:]:
        panel.set_visible(False)
    _label_steps(figure, last_step, 2 if stages > report_rows.MANY else 4)
    panels[0].set_ylim(0, 1.02)
    panels[0].yaxis.set_major_formatter(drawing.percent())
    return figure, panels[:stages]


def curves(history: History) -> Figure | None:
    """Draws the learning curves, one panel per quantity: every seed, and their IQM.

    Returns None if the run recorded none of them.
    """
    if all(np.isnan(values).all() for values in history.curves.values()):
        return None
    figure = Figure(figsize=(drawing.WIDTH, 5.2), layout="constrained")
    panels = list(figure.subplots(2, 3, sharex=True).flat)
    own = [key for key in history.curves if key.startswith(MEASURED)]
    titles = {key: key.removeprefix(MEASURED).replace("_", " ") for key in own} | _CURVES
    for panel, (key, title) in zip(panels, titles.items(), strict=False):
        steps, seeds = _stretched(history.arena_steps, history.curves[key])
        panel.plot(steps, seeds.T, color=_SEED, lw=0.7)
        panel.plot(steps, report_rows.together(seeds), color=_ALL, lw=2.0)
        drawing.dress(panel, title)
    for panel in panels[len(titles) :]:
        panel.set_visible(False)
    panels[2].tick_params(labelbottom=True)  # the last row may have no panel below this one
    _label_steps(figure, history.arena_steps[-1], 4)
    drawing.explain(figure, _seed_lines(history), 2)
    return figure


def spread(updates: int, points: int) -> np.ndarray:
    """Returns the indices of evenly spread points, including the last one."""
    return np.unique(np.linspace(updates - 1, 0, points).round().astype(int))


def _stretched(steps: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Averages values [N or S, T] over stretches of updates; also gives the step where each ends.

    Missing values are skipped. A stretch without any value is nan.
    """
    ends = spread(len(steps), _STRETCHES) + 1
    starts = np.concatenate([[0], ends[:-1]])
    there = np.add.reduceat(~np.isnan(values), starts, axis=1)
    sums = np.add.reduceat(np.nan_to_num(values), starts, axis=1)
    return steps[ends - 1], np.where(there, sums / np.maximum(there, 1), np.nan)


def _title(history: History, stage: int) -> str:
    """Writes a stage's name and last share."""
    last, measured = report_rows.among(history.success[:, -1])
    share = f"{100 * last[stage]:.0f} %" if measured[stage] else "not measured"
    return f"{history.labels[stage]}   {share}"


def _seed_lines(history: History) -> list[Line2D]:
    """Makes the legend entries of one seed's line and of the mean over seeds."""
    seeds = len(history.seeds)
    if seeds == 1:
        return [Line2D([], [], color=_ALL, lw=2.0, label=f"seed {history.seeds[0]}")]
    return [
        Line2D([], [], color=_ALL, lw=2.0, label=f"interquartile mean of {seeds} seeds"),
        Line2D([], [], color=_SEED, lw=0.7, label="each seed"),
    ]


def _label_steps(figure: Figure, last_step: int, ticks: int) -> None:
    """Scales and labels the steps, an axis that all panels share."""
    axis = figure.axes[0].xaxis
    figure.axes[0].set_xlim(0, last_step)
    axis.set_major_locator(MaxNLocator(ticks))
    axis.set_major_formatter(drawing.thousands())
    figure.supxlabel(_STEPS, fontsize=10)
