"""Draws the figures of a report with Matplotlib.

The colour map viridis rises evenly in lightness, so stages can also be told apart without colours
(Crameri et al. 2020, "The misuse of colour in science communication").
"""

import math
from collections.abc import Sequence
from typing import Any

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

_STRETCHES = 200  # points of a curve or band: about one per pixel
_SEED, _ALL, _LIMIT = "0.62", "#0b4f9e", "#c04000"
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
      PNG files by name: `success`; `stages` and `mix` if there are several stages; and `curves`
      if the run recorded their values. The same run always gives the same files, because the files
      do not hold Matplotlib's version.
    """
    several = {"stages": stages, "mix": mix} if len(history.names) > 1 else {}
    figures = {name: make(history) for name, make in (several | {"curves": curves}).items()}
    files = {"success": drawing.png(success(history), 2 * drawing.DOTS)}  # the page shows it large
    return files | {name: drawing.png(each) for name, each in figures.items() if each is not None}


def mix(history: History) -> Figure:
    """Draws each stage's share of the arenas, stacked, as the mean over seeds."""
    steps, bands = _stretched(history.arena_steps, history.mix.mean(axis=0).T)
    figure, [panel] = over_training(steps[-1], [""])
    # An update's shares hold from the end of the previous update.
    panel.stackplot(
        np.concatenate([[0], steps]),
        np.concatenate([bands[:, :1], bands], axis=1),
        colors=colours(len(history.names)),
        step="pre",
        linewidth=0,
        antialiased=False,  # hides the background between two bands
    )
    panel.set_ylim(0, 1)
    seeds = len(history.seeds)
    means = f", mean of {seeds} seeds" if seeds > 1 else ""
    figure.supylabel(f"share of the arenas{means}", fontsize=10)
    drawing.explain(figure, _stage_patches(history, 24), 6)
    return figure


def success(history: History) -> Figure:
    """Draws learning curves: the interquartile mean over seeds on every stage.

    On the last stage, every seed is drawn too. The figure is small in inches, so that its text can
    be read on a telephone.
    """
    figure, [panel] = over_training(history.arena_steps[-1], [_title(history, -1)])
    figure.set_size_inches(5.2, 3.6)
    mean = report_rows.together(history.success).T
    steps, shares = _stretched(history.arena_steps, mean[:-1])
    for share, colour in zip(shares, colours(len(mean)), strict=False):
        line(panel, steps, share, color=colour, lw=1.2)
    _draw(panel, history.arena_steps, history.success[..., -1])
    earlier = _stage_patches(history, 8)[1:]
    drawing.explain(figure, [*_seed_lines(history), *earlier], 3 if earlier else 2)
    figure.supylabel(report_rows.measure(history), fontsize=10)
    return figure


def stages(history: History) -> Figure:
    """Draws the success on each stage in its own panel: every seed, and the interquartile mean."""
    titles = [_title(history, i) for i in range(len(history.names))]
    figure, panels = over_training(history.arena_steps[-1], titles)
    thresholds = np.broadcast_to(history.config.curriculum.threshold, len(history.names))
    for i, panel in enumerate(panels):
        _draw(panel, history.arena_steps, history.success[..., i])
        panel.axhline(thresholds[i], color=_LIMIT, lw=0.8, ls="--")
    figure.supylabel(report_rows.measure(history), fontsize=10)
    promotes = Line2D([], [], color=_LIMIT, lw=0.8, ls="--", label="promotes")
    drawing.explain(figure, [*_seed_lines(history), promotes], 3)
    return figure


def curves(history: History) -> Figure | None:
    """Draws a panel for each quantity of `History.curves`: every seed, and the interquartile mean.

    Returns None if the run recorded none of these quantities.
    """
    if all(np.isnan(values).all() for values in history.curves.values()):
        return None
    own = [key for key in history.curves if key.startswith(MEASURED)]
    titles = {key: key.removeprefix(MEASURED).replace("_", " ") for key in own} | _CURVES
    figure, panels = over_training(history.arena_steps[-1], [*titles.values()], are_shares=False)
    for panel, key in zip(panels, titles, strict=True):
        _draw(panel, history.arena_steps, history.curves[key])
    drawing.explain(figure, _seed_lines(history), 2)
    return figure


def over_training(
    last_step: int, titles: Sequence[str], *, are_shares: bool = True
) -> tuple[Figure, list[Axes]]:
    """Makes a figure with a panel for each title. The horizontal axes show the steps of training.

    Args:
      last_step: the last arena control step on the horizontal axes.
      titles: the title of each panel.
      are_shares: whether the panels show shares, on a common vertical axis from 0 to 1.
    """
    count = len(titles)
    columns = min(count, 3 if count <= report_rows.MANY else 6 if count <= 30 else 8)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(max(drawing.WIDTH, 1.4 * columns), max(1.2 + 1.6 * rows, 4.2)))
    figure.set_layout_engine("constrained")
    panels = list(
        figure.subplots(rows, columns, sharex=True, sharey=are_shares, squeeze=False).flat
    )
    for i, (panel, title) in enumerate(zip(panels, titles, strict=False)):
        drawing.dress(panel, title, 7 if count > report_rows.MANY else 10)
        panel.tick_params(labelbottom=i + columns >= count)
    for panel in panels[count:]:
        panel.set_visible(False)
    panels[0].set_xlim(0, last_step)
    panels[0].xaxis.set_major_locator(MaxNLocator(2 if count > report_rows.MANY else 4))
    panels[0].xaxis.set_major_formatter(drawing.thousands())
    figure.supxlabel("arena control steps per seed", fontsize=10)
    if are_shares:
        panels[0].set_ylim(0, 1.02)
        panels[0].yaxis.set_major_formatter(drawing.percent())
    return figure, panels[:count]


def colours(count: int) -> np.ndarray:
    """Returns colours [count, 4] for stages or runs, all dark enough to be seen on white."""
    return colormaps["viridis"](np.linspace(0.0, 0.85, count))


def line(panel: Axes, steps: np.ndarray, values: np.ndarray, **look: Any) -> None:
    """Draws a curve through the values that are not nan, or a dot if there is only one."""
    there = ~np.isnan(values)
    panel.plot(steps[there], values[there], marker="o" if there.sum() == 1 else "", **look)


def _draw(panel: Axes, steps: np.ndarray, seeds: np.ndarray) -> None:
    """Draws a curve for each seed of values [N, T], and a curve for the interquartile mean."""
    steps, seeds = _stretched(steps, seeds)
    for values in seeds:
        line(panel, steps, values, color=_SEED, lw=0.7)
    line(panel, steps, report_rows.together(seeds), color=_ALL, lw=2.0)


def _stage_patches(history: History, most: int) -> list[Patch]:
    """Makes legend entries for at most `most` evenly spread stages, the last stage first."""
    names, looks = history.labels, colours(len(history.names))
    every = range(len(names) - 1, -1, -math.ceil(len(names) / most))
    return [Patch(color=looks[i], label=names[i]) for i in every]


def spread(updates: int, points: int) -> np.ndarray:
    """Returns at most `points` evenly spread indices of updates, including that of the last."""
    return np.unique(np.linspace(updates - 1, 0, points).round().astype(int))


def _stretched(steps: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Averages values [N or S, T] over stretches of updates.

    Returns the step at which each stretch ends, and the means. Missing values are skipped. The mean
    of a stretch without any value is nan.
    """
    ends = spread(len(steps), _STRETCHES) + 1
    starts = np.concatenate([[0], ends[:-1]])
    there = np.add.reduceat(~np.isnan(values), starts, axis=1)
    sums = np.add.reduceat(np.nan_to_num(values), starts, axis=1)
    return steps[ends - 1], np.where(there, sums / np.maximum(there, 1), np.nan)


def _title(history: History, stage: int) -> str:
    """Writes a stage's name and the success on it after the last update."""
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
