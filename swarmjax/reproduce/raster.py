"""Draws the raster of a reproduction: every episode of every seed."""

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from swarmjax.pages import figures as drawing
from swarmjax.reproduce import measures
from swarmjax.reproduce.measures import AXES, Axis, Measure
from swarmjax.reproduce.rows import Reproduction, RunLog

PAPER = {"curriculum": 300, "baseline": 600}  # episodes: section 4, on Figure 6
_COLUMNS = 700  # columns of a raster: about one per pixel
_REACHED = LinearSegmentedColormap.from_list("reached", ["white", "#0b4f9e"])
_NOTHING, _STEADY = "0.86", "#e69f00"


def raster(data: Reproduction, arms: tuple[str, ...], *, axis: Axis, stage: str | None) -> Figure:
    """Draws a line for each episode that reached the goal, one row per seed: Figures 6 and 9.

    Args:
      data: the reproduction's data.
      arms: finished arms; each gets two panels, one per reading of success.
      axis: unit of the horizontal axis.
      stage: shows only the episodes of this stage; None for all.
    """
    kinds = [(name, success, arm) for name, success in measures.SUCCESS.items() for arm in arms]
    seeds = len(data.seeds)
    height = 1.1 + len(kinds) * (0.55 + 0.11 * seeds)
    figure = Figure(figsize=(drawing.WIDTH, height), layout="constrained")
    panels = figure.subplots(len(kinds), sharex=True, squeeze=False)[:, 0]
    edges = _edges([log for arm in arms for log in data.logs[arm]], axis)
    for panel, (name, success, arm) in zip(panels, kinds, strict=True):
        rows = [columns(log, success, axis, stage, edges) for log in data.logs[arm]]
        extent = (float(edges[0]), float(edges[-1]), seeds - 0.5, -0.5)
        panel.set_facecolor(_NOTHING)
        panel.imshow(
            np.array(rows),
            _REACHED,
            vmin=0.0,
            vmax=1.0,
            aspect="auto",
            interpolation="nearest",
            extent=extent,
        )
        places = measures.steady_at(data, arm, success=success, axis=axis, stage=stage)
        panel.scatter(places, range(seeds), s=16, marker="v", color=_STEADY, ec="black", lw=0.5)
        if axis == "episode" and arm in PAPER:
            panel.axvline(PAPER[arm], color="black", lw=1.0, ls=":")
        panel.set_title(f"{arm}: {name}", loc="left", fontsize=9, pad=3)
        panel.set_yticks(range(seeds), [str(seed) for seed in data.seeds], fontsize=6)
    panels[-1].set_xlabel(AXES[axis])
    panels[-1].xaxis.set_major_formatter(drawing.thousands(least=10_000))
    figure.supylabel("seed", fontsize=10)
    _explain_raster(figure, axis == "episode" and any(arm in PAPER for arm in arms))
    return figure


def columns(
    log: RunLog, success: Measure, axis: Axis, stage: str | None, edges: np.ndarray
) -> np.ndarray:
    """Computes the share of successes in each column of a raster.

    A column in which no episode ended shows the episode that was running.

    Args:
      log: log of one seed.
      success: takes [E] successes from a log.
      axis: unit of the horizontal axis.
      stage: shows only the episodes of this stage; None for all.
      edges: [P + 1] edges of the columns, increasing.

    Returns:
      [P] values from 0 to 1; nan where there is no episode to show.
    """
    at, shown = measures.along(log, axis), np.ones(len(log), bool)
    if stage is not None:
        shown = log.stage == stage
    value = np.where(shown, success(log), np.nan)
    count = len(edges) - 1
    column = np.clip(np.searchsorted(edges, at, side="left") - 1, 0, count - 1)
    shows = np.bincount(column[shown], minlength=count)
    wins = np.bincount(column[shown], weights=value[shown], minlength=count)
    ended = np.bincount(column, minlength=count) > 0
    following = np.searchsorted(at, edges[1:], side="left")
    under_way = np.append(value, np.nan)[following]
    found = np.where(shows > 0, wins / np.maximum(shows, 1), np.nan)
    return np.where(ended, found, under_way)


def _edges(logs: list[RunLog], axis: Axis) -> np.ndarray:
    """Computes the column edges of a raster: one column per episode unless there are too many."""
    last = max(int(measures.along(log, axis)[-1]) for log in logs)
    if axis == "episode":
        return np.linspace(0, last, min(last, _COLUMNS) + 1) + 0.5
    return np.linspace(0, last, _COLUMNS + 1)


def _explain_raster(figure: Figure, paper: bool) -> None:
    """Adds a legend above the panels."""
    kinds = [
        Patch(fc=_REACHED(1.0), label="reached"),
        Patch(fc="white", ec="0.5", lw=0.5, label="not reached"),
        Patch(fc=_NOTHING, label="no such episode"),
        Line2D([], [], color=_STEADY, mec="black", mew=0.5, marker="v", ls="", label="steady from"),
    ]
    if paper:
        kinds.append(Line2D([], [], color="black", lw=1.0, ls=":", label="the paper's number"))
    drawing.explain(figure, kinds)
