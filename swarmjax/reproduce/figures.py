"""The figures of a reproduction, with Matplotlib: the paper's, and those that it lacks.

A figure is drawn of those of its arms that have finished. Colours are of Okabe & Ito 2008, "Color
universal design", and arms differ in their dashes too.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from swarmjax.evaluate import statistics
from swarmjax.evaluate.curves import curve
from swarmjax.evaluate.statistics import iqm
from swarmjax.pages import figures as drawing
from swarmjax.reproduce import measures
from swarmjax.reproduce.measures import AXES, WINDOW, Axis, Measure
from swarmjax.reproduce.raster import raster
from swarmjax.reproduce.rows import EXPANDED, LAST, Reproduction

SHADES = 128  # colours of a file: a quarter of its size, each off by 23 of 255 at most
_POINTS, _RESAMPLES = 100, 1000  # of an interval along a curve
COLOURS = {
    "curriculum": "#0072b2",
    "baseline": "#d55e00",
    "curriculum_expanded": "#0072b2",
    "baseline_expanded": "#d55e00",
    "modern_curriculum": "#009e73",
    "modern_baseline": "#aa4499",
}
_DASHES = {"baseline": "--", "baseline_expanded": "--", "modern_baseline": "--"}
_PAIR = ("curriculum", "baseline")
_TUNED = ("curriculum_expanded", "baseline_expanded")
_MODERN = ("modern_curriculum", "modern_baseline")


@dataclass(frozen=True, kw_only=True)
class Plot:
    """A figure of the report.

    Attributes:
      name: of its file.
      arms: that it shows.
      caption: says what is seen.
      make: draws it, of those of its arms that have finished.
    """

    name: str
    arms: tuple[str, ...]
    caption: str
    make: Callable[[Reproduction, tuple[str, ...]], Figure]


@dataclass(frozen=True, kw_only=True)
class Panel:
    """What a row of curves shows.

    Attributes:
      label: of the measure, with its unit.
      of: the measure.
      stage: whose episodes alone are shown; None for all.
      share: whether it is a share, written in percent.
    """

    label: str
    of: Measure
    stage: str | None
    share: bool = False


def draw(data: Reproduction) -> dict[str, bytes]:
    """Draws every figure that has a finished arm.

    Returns:
      PNG files by name. The same reproduction gives the same files.
    """
    files = {}
    for plot in PLOTS:
        arms = tuple(arm for arm in plot.arms if arm in data.logs)
        if arms:
            files[plot.name] = drawing.png(plot.make(data, arms), SHADES)
    return files


def curves(
    data: Reproduction, arms: tuple[str, ...], *, panels: tuple[Panel, ...], axes: tuple[Axis, ...]
) -> Figure:
    """Draws rolling means: every seed, and their interquartile mean with its interval.

    Args:
      data: of the reproduction.
      arms: finished ones, all in each panel.
      panels: rows, from above.
      axes: columns, from the left.
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
    """Takes about as many points of a curve as the dots can show."""
    every = max(1, len(at) // 500)
    return at[::every], values[::every]


def _explain_curves(figure: Figure, data: Reproduction, arms: tuple[str, ...]) -> None:
    """Says above the panels which arm is which."""
    kinds = [
        Line2D([], [], color=COLOURS[arm], lw=2.0, ls=_DASHES.get(arm, "-"), label=arm)
        for arm in arms
    ]
    kinds.append(Line2D([], [], color="0.5", lw=0.5, label=f"each of {len(data.seeds)} seeds"))
    drawing.explain(figure, kinds)


def final(data: Reproduction, arms: tuple[str, ...]) -> Figure:
    """Draws what final policies came to on both stages: every seed, and intervals."""
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
_ROLLING = (
    f"Rolling means of {WINDOW} episodes. Thin: each seed. Thick, with its band: interquartile "
    "mean over seeds and 95 % bootstrap interval, where all seeds have a value."
)
_RASTER = (
    "A row a seed, a line an episode: blue where the goal was reached, white where not, a shade "
    "where a line is several episodes."
)


def _rewards(of: Measure, who: str) -> tuple[Panel, ...]:
    return (
        Panel(label=f"reward of {who} (m),\n{_ALL_OF_THEM}", of=of, stage=None),
        Panel(label=f"reward of {who} (m),\n{_ON_LAST}", of=of, stage=LAST),
    )


def _collisions(stage: str | None, which: str) -> tuple[Panel, ...]:
    return (
        Panel(
            label=f"steps within infrared range,\n{which}",
            of=measures.sensed_share,
            stage=stage,
            share=True,
        ),
        Panel(label=f"contacts per robot,\n{which}", of=measures.contacts, stage=stage),
    )


PLOTS = (
    Plot(
        name="figure6_episodes",
        arms=_PAIR,
        caption=f"Figure 6 over episodes, all of a run, on whatever stage. {_RASTER} The triangle "
        "is the episode from which on success is steady, and is missing where it never is; the "
        "dotted line is the number that the paper gives. A run ends after its steps, so that those "
        "with short episodes have more.",
        make=partial(raster, axis="episode", stage=None),
    ),
    Plot(
        name="figure6_steps",
        arms=_PAIR,
        caption=f"Figure 6 over arena control steps from the beginning of the run, episodes on "
        f"{LAST} alone. {_RASTER} Grey is time on the curriculum's earlier stages, and after the "
        "last episode.",
        make=partial(raster, axis="steps", stage=LAST),
    ),
    Plot(
        name="figure7_robot1",
        arms=_PAIR,
        caption="Figure 7: cumulative reward of an episode, of robot 1, as the paper's is of one "
        f"robot. {_ROLLING} "
        "Earlier stages are smaller, and so is what can be collected on them: the lower row "
        f"compares like with like, from the beginning of the run, on {LAST}.",
        make=partial(curves, panels=_rewards(measures.first_reward, "robot 1"), axes=_TWO),
    ),
    Plot(
        name="figure7_swarm",
        arms=_PAIR,
        caption=f"The same as the mean over the robots of the swarm. {_ROLLING}",
        make=partial(curves, panels=_rewards(measures.mean_reward, "a robot"), axes=_TWO),
    ),
    Plot(
        name="figure8",
        arms=_PAIR,
        caption="Figure 8: collisions by the paper's rule, the share of robot steps with something "
        "within infrared range, and by true contacts per robot and episode, over training with "
        f"sampled actions. {_ROLLING}",
        make=partial(
            curves,
            panels=(*_collisions(None, _ALL_OF_THEM), *_collisions(LAST, _ON_LAST)),
            axes=_TWO,
        ),
    ),
    Plot(
        name="figure9_raster",
        arms=_TUNED,
        caption=f"Figure 9: episodes of training on at 1.5 m, from the final policies of the two "
        f"arms. {_RASTER} The triangle is the episode from which on success is steady.",
        make=partial(raster, axis="episode", stage=EXPANDED),
    ),
    Plot(
        name="figure9_curves",
        arms=_TUNED,
        caption=f"Figure 9 as curves: training on at 1.5 m. {_ROLLING}",
        make=partial(
            curves,
            panels=(
                Panel(label="targets reached", of=measures.targets, stage=EXPANDED, share=True),
                Panel(label="reward of a robot (m)", of=measures.mean_reward, stage=EXPANDED),
            ),
            axes=_TWO,
        ),
    ),
    Plot(
        name="final",
        arms=(*_PAIR, *_TUNED, *_MODERN),
        caption=f"Final policies by their mean actions, in MuJoCo C, on {LAST} (1.2 m, circles) "
        f"and {EXPANDED} (1.5 m, squares): each seed as a dot, interquartile mean over seeds with "
        "its 95 % bootstrap interval. Arms that end on _expanded were trained on at 1.5 m; for all "
        "others 1.5 m is zero-shot.",
        make=final,
    ),
    Plot(
        name="modern_curves",
        arms=(*_PAIR, *_MODERN),
        caption="The default trainer beside the paper's algorithm, at the same arena control steps "
        f"in all: training on {LAST} with sampled actions. {_ROLLING}",
        make=partial(
            curves,
            panels=(
                Panel(
                    label=f"targets reached,\n{_ON_LAST}",
                    of=measures.targets,
                    stage=LAST,
                    share=True,
                ),
                _rewards(measures.mean_reward, "a robot")[1],
                *_collisions(LAST, _ON_LAST),
            ),
            axes=("steps",),
        ),
    ),
    Plot(
        name="modern_raster",
        arms=_MODERN,
        caption=f"Figure 6 of the default trainer over arena control steps, episodes on {LAST} "
        f"alone. {_RASTER} It runs several arenas at once, whose episodes end together.",
        make=partial(raster, axis="steps", stage=LAST),
    ),
)
