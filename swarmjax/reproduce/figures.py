"""Draws the figures of a reproduction with Matplotlib: the paper's figures and additional ones.

A figure shows only the arms that have finished. Colours are from Okabe & Ito 2008, "Color universal
design". The curves of baselines are also dashed.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from swarmjax.evaluate.statistics import curve
from swarmjax.pages import figures as drawing
from swarmjax.reproduce import measures
from swarmjax.reproduce.measures import AXES, WINDOW, Axis, Measure
from swarmjax.reproduce.rows import EXPANDED, LAST, MODERN, PAIR, TUNED, Reproduction, RunLog

_POINTS, _RESAMPLES = 100, 1000  # of a curve's interval: its points and its bootstrap resamples
COLOURS = {"curriculum": "#0072b2", "baseline": "#d55e00"}
COLOURS |= {f"{arm}_expanded": colour for arm, colour in COLOURS.items()}
COLOURS |= {"modern_curriculum": "#009e73", "modern_baseline": "#aa4499"}
_LABELS: dict[Measure, str] = {
    measures.targets: "targets reached",
    measures.first_reward: "reward of robot 1 (m)",
    measures.mean_reward: "reward of a robot (m)",
    measures.sensed_share: "steps within infrared range",
    measures.contacts: "contacts per robot",
}
_SHARES = (measures.targets, measures.sensed_share)  # shown in percent

PAPER = {"curriculum": 300, "baseline": 600}  # episodes that section 4 of the paper names
_COLUMNS = 700  # columns of a raster: about one per pixel
_REACHED = LinearSegmentedColormap.from_list("reached", ["white", "#0b4f9e"])
_NOTHING, _STEADY = "0.86", "#e69f00"


class Plot(NamedTuple):
    """A figure of the report: the arms in it, and a function that draws the finished ones."""

    arms: tuple[str, ...]
    make: Callable[[Reproduction, tuple[str, ...]], Figure]


class Panel(NamedTuple):
    """A row of panels: a measure over the episodes of one stage, or of all if `stage` is None."""

    of: Measure
    stage: str | None = None

    @property
    def label(self) -> str:
        """The label of the row's vertical axis."""
        which = "all episodes" if self.stage is None else f"episodes on {self.stage}"
        return f"{_LABELS[self.of]},\n{which}"


def png_files(data: Reproduction) -> dict[str, bytes]:
    """Draws every figure with at least one finished arm.

    Returns:
      PNG files by name. The same reproduction gives the same files.
    """
    files = {}
    for name, plot in PLOTS.items():
        arms = tuple(arm for arm in plot.arms if arm in data.logs)
        if arms:
            files[name] = drawing.png(plot.make(data, arms))
    return files


def curves(
    data: Reproduction,
    arms: tuple[str, ...],
    *,
    panels: tuple[Panel, ...],
    axes: tuple[Axis, ...] = ("episode", "steps"),
) -> Figure:
    """Draws rolling means: every seed, and their interquartile mean with its interval.

    Args:
      data: the reproduction's data.
      arms: finished arms; every panel shows all of them.
      panels: what each row of panels shows, from top to bottom.
      axes: the unit of the horizontal axis in each column, from left to right.
    """
    height = 1.0 + 2.0 * len(panels)
    figure = Figure(figsize=(drawing.WIDTH, height), layout="constrained")
    grid = figure.subplots(len(panels), len(axes), sharex="col", sharey="row", squeeze=False)
    for row, panel in zip(grid, panels, strict=True):
        for place, axis in zip(row, axes, strict=True):
            for arm in arms:
                _arm(place, data, arm, panel, axis)
            place.grid(visible=True, alpha=0.25)
            place.tick_params(labelsize=8)
        row[0].set_ylabel(panel.label, fontsize=8)
        if panel.of in _SHARES:
            row[0].yaxis.set_major_formatter(drawing.percent())
    for place, axis in zip(grid[-1], axes, strict=True):
        place.set_xlabel(AXES[axis], fontsize=9)
        place.set_xlim(left=0)
        place.xaxis.set_major_formatter(drawing.thousands(least=10_000))
        place.xaxis.set_major_locator(MaxNLocator(5))
    kinds = [Line2D([], [], lw=2.0, label=arm, **_style(arm)) for arm in arms]
    kinds.append(Line2D([], [], color="0.5", lw=0.5, label=f"each of {len(data.seeds)} seeds"))
    drawing.explain(figure, kinds)
    return figure


def _style(arm: str) -> dict[str, Any]:
    return {"color": COLOURS[arm], "ls": "--" if "baseline" in arm else "-"}


def _arm(place: Axes, data: Reproduction, arm: str, panel: Panel, axis: Axis) -> None:
    """Draws the rolling means of an arm."""
    seeds, colour = [], COLOURS[arm]
    faint = min(0.35, 5.0 / len(data.seeds))  # many seeds would hide the bands
    for log in data.logs[arm]:
        chosen = log.on(panel.stage)
        at = measures.along(chosen, axis)[WINDOW - 1 :]
        means = measures.rolling(np.asarray(panel.of(chosen), float))
        seeds.append((at, means))
        every = max(1, len(at) // 500)  # about one point per pixel
        place.plot(at[::every], means[::every], color=colour, lw=0.5, alpha=faint, zorder=1)
    shared = measures.on_grid(seeds, _POINTS)
    if shared is None:
        return
    band = curve(shared[1], resamples=_RESAMPLES)
    place.fill_between(shared[0], band.low, band.high, color=colour, alpha=0.25, lw=0)
    place.plot(shared[0], band.estimate, lw=2.0, **_style(arm))


def raster(data: Reproduction, arms: tuple[str, ...], *, axis: Axis, stage: str | None) -> Figure:
    """Draws a line for each episode that reached the goal, as the paper's Figures 6 and 9 do.

    Each seed has a row of its own.

    Args:
      data: the reproduction's data.
      arms: finished arms; each gets two panels, one per definition of success.
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
        look = {"aspect": "auto", "interpolation": "nearest", "extent": extent}
        panel.imshow(np.array(rows), _REACHED, Normalize(0.0, 1.0), **look)
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
    share = np.where(shows > 0, wins / np.maximum(shows, 1), np.nan)
    return np.where(ended, share, under_way)


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


def _collisions(stage: str | None) -> tuple[Panel, ...]:
    return Panel(measures.sensed_share, stage), Panel(measures.contacts, stage)


_ROBOT_1 = (Panel(measures.first_reward), Panel(measures.first_reward, LAST))
_SWARM = (Panel(measures.mean_reward), Panel(measures.mean_reward, LAST))
_TO_THE_END = (Panel(measures.targets, EXPANDED), Panel(measures.mean_reward, EXPANDED))
_DEFAULT_TRAINER = (Panel(measures.targets, LAST), _SWARM[1], *_collisions(LAST))

# The captions of these figures are in reproduce.html.
PLOTS = {
    "figure6_episodes": Plot(PAIR, partial(raster, axis="episode", stage=None)),
    "figure6_steps": Plot(PAIR, partial(raster, axis="steps", stage=LAST)),
    "figure7_robot1": Plot(PAIR, partial(curves, panels=_ROBOT_1)),
    "figure7_swarm": Plot(PAIR, partial(curves, panels=_SWARM)),
    "figure8": Plot(PAIR, partial(curves, panels=_collisions(None) + _collisions(LAST))),
    "figure9_raster": Plot(TUNED, partial(raster, axis="episode", stage=EXPANDED)),
    "figure9_curves": Plot(TUNED, partial(curves, panels=_TO_THE_END)),
    "modern_curves": Plot(
        (*PAIR, *MODERN), partial(curves, panels=_DEFAULT_TRAINER, axes=("steps",))
    ),
    "modern_raster": Plot(MODERN, partial(raster, axis="steps", stage=LAST)),
}
