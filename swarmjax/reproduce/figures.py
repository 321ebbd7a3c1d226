"""Draws the figures of a reproduction with Matplotlib: the paper's figures and additional ones.

A figure shows those of its arms that have finished. Colours are from Okabe & Ito 2008, "Color
universal design". Arms also have different dashes.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from swarmjax.evaluate import statistics
from swarmjax.evaluate.statistics import curve, iqm
from swarmjax.pages import figures as drawing
from swarmjax.reproduce import measures
from swarmjax.reproduce.measures import AXES, WINDOW, Axis, Measure
from swarmjax.reproduce.raster import raster
from swarmjax.reproduce.rows import EXPANDED, LAST, MODERN, PAIR, TUNED, Reproduction

SHADES = 128  # colours in a file, a quarter of the size; each colour is off by at most 23 of 255
_POINTS, _RESAMPLES = 100, 1000  # for the interval along a curve
COLOURS = {
    "curriculum": "#0072b2",
    "baseline": "#d55e00",
    "curriculum_expanded": "#0072b2",
    "baseline_expanded": "#d55e00",
    "modern_curriculum": "#009e73",
    "modern_baseline": "#aa4499",
}
_DASHES = {"baseline": "--", "baseline_expanded": "--", "modern_baseline": "--"}


class Plot(NamedTuple):
    """A figure of the report: the arms in it, and a function that draws the finished ones."""

    arms: tuple[str, ...]
    make: Callable[[Reproduction, tuple[str, ...]], Figure]


class Panel(NamedTuple):
    """A row of curves: a measure over the episodes of one or all stages; shares in percent."""

    label: str
    of: Measure
    stage: str | None
    share: bool = False


def draw(data: Reproduction) -> dict[str, bytes]:
    """Draws every figure with at least one finished arm.

    Returns:
      PNG files by name. The same reproduction gives the same files.
    """
    files = {}
    for name, plot in PLOTS.items():
        arms = tuple(arm for arm in plot.arms if arm in data.logs)
        if arms:
            files[name] = drawing.png(plot.make(data, arms), SHADES)
    return files


def curves(
    data: Reproduction, arms: tuple[str, ...], *, panels: tuple[Panel, ...], axes: tuple[Axis, ...]
) -> Figure:
    """Draws rolling means: every seed, and their interquartile mean with its interval.

    Args:
      data: the reproduction's data.
      arms: finished arms; every panel shows all of them.
      panels: rows, from top to bottom.
      axes: columns, from left to right.
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
        if panel.share:
            row[0].yaxis.set_major_formatter(drawing.percent())
    for place, axis in zip(grid[-1], axes, strict=True):
        place.set_xlabel(AXES[axis], fontsize=9)
        place.set_xlim(left=0)
        place.xaxis.set_major_formatter(drawing.thousands(least=10_000))
        place.xaxis.set_major_locator(MaxNLocator(5))
    _explain_curves(figure, data, arms)
    return figure


def _arm(place: Axes, data: Reproduction, arm: str, panel: Panel, axis: Axis) -> None:
    """Draws the rolling means of an arm."""
    found = []
    for log in data.logs[arm]:
        chosen = log.on(panel.stage)
        at = measures.along(chosen, axis)[WINDOW - 1 :]
        found.append((at, measures.rolling(np.asarray(panel.of(chosen), float))))
        place.plot(*_thinned(*found[-1]), color=COLOURS[arm], lw=0.5, alpha=0.35)
    shared = measures.on_grid(found, _POINTS)
    if shared is None:
        return
    band = curve(shared[1], resamples=_RESAMPLES)
    place.fill_between(shared[0], band.low, band.high, color=COLOURS[arm], alpha=0.25, lw=0)
    style = _DASHES.get(arm, "-")
    place.plot(shared[0], band.estimate, style, color=COLOURS[arm], lw=2.0)


def _thinned(at: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thins a curve to about one point per pixel."""
    every = max(1, len(at) // 500)
    return at[::every], values[::every]


def _explain_curves(figure: Figure, data: Reproduction, arms: tuple[str, ...]) -> None:
    """Adds a legend of the arms above the panels."""
    kinds = [
        Line2D([], [], color=COLOURS[arm], lw=2.0, ls=_DASHES.get(arm, "-"), label=arm)
        for arm in arms
    ]
    kinds.append(Line2D([], [], color="0.5", lw=0.5, label=f"each of {len(data.seeds)} seeds"))
    drawing.explain(figure, kinds)


def final(data: Reproduction, arms: tuple[str, ...]) -> Figure:
    """Draws the results of the final policies on both stages: every seed, and intervals."""
    kinds = {
        "targets_reached": "targets reached",
        "all_reached": "episodes in which all arrived",
        "sensed_share": "robot steps within infrared range",
        "contacts_per_robot": "contacts per robot and episode",
    }
    figure = Figure(figsize=(drawing.WIDTH, 1.6 + 0.8 * len(arms)), layout="constrained")
    places = figure.subplots(2, 2, sharey=True)
    for place, (key, label) in zip(places.flat, kinds.items(), strict=True):
        for shift, stage, mark in ((-0.16, LAST, "o"), (0.16, EXPANDED, "s")):
            for row, arm in enumerate(arms):
                _dots(place, data.judged[arm, stage][key], row + shift, (COLOURS[arm], mark))
        place.set_title(label, loc="left", fontsize=9)
        place.grid(axis="x", alpha=0.3)
        place.tick_params(labelsize=8)
        if key != "contacts_per_robot":
            place.xaxis.set_major_formatter(drawing.percent())
        place.set_xlim(left=max(0.0, place.get_xlim()[0]))
    places[0, 0].set_yticks(range(len(arms)), arms)
    places[0, 0].set_ylim(len(arms) - 0.5, -0.5)
    marks = [
        Line2D([], [], color="0.3", marker=mark, ls="-", label=f"on {stage}, IQM and 95 %")
        for mark, stage in (("o", LAST), ("s", EXPANDED))
    ]
    marks.append(Line2D([], [], color="0.3", marker=".", ls="", ms=4, alpha=0.5, label="a seed"))
    drawing.explain(figure, marks, 3)
    return figure


def _dots(place: Axes, values: np.ndarray, row: float, style: tuple[str, str]) -> None:
    """Draws the seeds of an arm as dots, and their interquartile mean with its interval."""
    colour, mark = style
    mean = statistics.bootstrap(values[:, None], iqm)
    place.plot(values, np.full(len(values), row + 0.11), ".", color=colour, ms=4, alpha=0.5)
    place.hlines(row, mean.low, mean.high, color=colour, lw=2.0)
    place.plot([mean.estimate], [row], mark, color=colour, ms=5)


_TWO: tuple[Axis, ...] = ("episode", "steps")
_ALL_OF_THEM = "all episodes"
_ON_LAST = f"episodes on {LAST}"


def _rewards(of: Measure, who: str) -> tuple[Panel, ...]:
    kinds = {_ALL_OF_THEM: None, _ON_LAST: LAST}
    return tuple(Panel(f"reward of {who} (m),\n{which}", of, kinds[which]) for which in kinds)


def _collisions(stage: str | None, which: str) -> tuple[Panel, ...]:
    return (
        Panel(f"steps within infrared range,\n{which}", measures.sensed_share, stage, share=True),
        Panel(f"contacts per robot,\n{which}", measures.contacts, stage),
    )


_OF_ROBOT_1 = _rewards(measures.first_reward, "robot 1")
_OF_SWARM = _rewards(measures.mean_reward, "a robot")
_TO_THE_END = (
    Panel("targets reached", measures.targets, EXPANDED, share=True),
    Panel("reward of a robot (m)", measures.mean_reward, EXPANDED),
)
_DEFAULT_TRAINER = (
    Panel(f"targets reached,\n{_ON_LAST}", measures.targets, LAST, share=True),
    _OF_SWARM[1],
    *_collisions(LAST, _ON_LAST),
)
_ALL_COLLISIONS = (*_collisions(None, _ALL_OF_THEM), *_collisions(LAST, _ON_LAST))

# Their captions are in reproduce.html.
PLOTS = {
    "figure6_episodes": Plot(PAIR, partial(raster, axis="episode", stage=None)),
    "figure6_steps": Plot(PAIR, partial(raster, axis="steps", stage=LAST)),
    "figure7_robot1": Plot(PAIR, partial(curves, panels=_OF_ROBOT_1, axes=_TWO)),
    "figure7_swarm": Plot(PAIR, partial(curves, panels=_OF_SWARM, axes=_TWO)),
    "figure8": Plot(PAIR, partial(curves, panels=_ALL_COLLISIONS, axes=_TWO)),
    "figure9_raster": Plot(TUNED, partial(raster, axis="episode", stage=EXPANDED)),
    "figure9_curves": Plot(TUNED, partial(curves, panels=_TO_THE_END, axes=_TWO)),
    "final": Plot((*PAIR, *TUNED, *MODERN), final),
    "modern_curves": Plot(
        (*PAIR, *MODERN), partial(curves, panels=_DEFAULT_TRAINER, axes=("steps",))
    ),
    "modern_raster": Plot(MODERN, partial(raster, axis="steps", stage=LAST)),
}
