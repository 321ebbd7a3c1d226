"""Summarises an evaluation: means, interquartile means, worst levels, each with its interval."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from swarmjax import provenance
from swarmjax.config import to_dict
from swarmjax.evaluate import judge, statistics
from swarmjax.evaluate.cells import Cell
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.measures import MEASURES, Measure
from swarmjax.evaluate.statistics import LEAST_DRAWN, Draw, Interval, Statistic
from swarmjax.evaluate.trials import Entrant, Trial, specialise

WORST = 0.05  # share of the levels that CVaR averages
Measured = Mapping[str, np.ndarray]


def result(
    config: EvaluateConfig,
    suite: str | None,
    sides: Sequence[Sequence[Entrant]],
    trials: Sequence[Trial],
) -> dict[str, Any]:
    """Collects the results of an evaluation as plain data for JSON.

    Args:
      config: Settings of the evaluation.
      suite: Its name, or None.
      sides: Policies of one recipe, or of two recipes to compare, the same number of each.
      trials: Their results, one for each cell, with the rows of the first side first.

    Returns:
      The result; docs/interface.md lists it.
    """
    who = [[{"path": path, "digest": trained.digest} for path, trained in each] for each in sides]
    is_one = len(sides) == 1
    own = {name: measure._asdict() for name, measure in trials[0].own.items()}
    return {
        **about(config, suite),
        **({"own_measures": own} if own else {}),
        **({"policies": who[0]} if is_one else {"compared": who}),
        "cells": [
            {
                **about_cell(config, trial.cell),
                "unreachable": int(np.isinf(trial.shortest).any(axis=-1).sum()),
                "measures": _figures([trial], is_one=is_one),
            }
            for trial in trials
        ],
        "pooled": _pool(trials, is_one=is_one),
    }


def _figures(
    trials: Sequence[Trial], strata: Sequence[int] | None = None, *, is_one: bool
) -> dict[str, dict[str, Any]]:
    """Summarises cells together, or compares the two halves of their policies."""
    measured = {
        name: np.concatenate([trial.measures[name] for trial in trials], axis=1)
        for name in trials[0].measures
    }
    about = {**MEASURES, **trials[0].own}
    if is_one:
        return summarize(measured, strata, about)
    halves = {name: np.split(table, 2) for name, table in measured.items()}
    a, b = ({name: half[side] for name, half in halves.items()} for side in (0, 1))
    return compare(a, b, strata, about)


def about(config: EvaluateConfig, suite: str | None) -> dict[str, Any]:
    """Describes the settings of an evaluation as plain data for JSON.

    Args:
      config: Settings of the evaluation.
      suite: Its name, or None.
    """
    return {
        "suite": suite,
        "engine": config.engine,
        "action": config.action,
        "robot": to_dict(config.robot),
        "task": to_dict(config.task),
        "steps": config.step_limit,
        "substeps": judge.substeps(config),
        "versions": provenance.versions(),
    }


def about_cell(config: EvaluateConfig, cell: Cell) -> dict[str, Any]:
    """Describes the levels of a cell, and its own settings.

    Args:
      config: Settings of the evaluation.
      cell: The cell.

    Returns:
      Plain data for JSON.
    """
    mine = specialise(config, cell)
    return {
        "cell": cell.name,
        "stage": to_dict(cell.stage),
        "realism": to_dict(mine.realism),
        "hull_friction": mine.robot.hull_friction,
        "episodes": len(cell.episodes),
        "steps": mine.step_limit,
        "seed": cell.seed,
        "digest": cell.digest,
    }


def summarize(
    measured: Measured,
    strata: Sequence[int] | None = None,
    about: Mapping[str, Measure] = MEASURES,
) -> dict[str, dict[str, Any]]:
    """Summarises measures.

    Args:
      measured: Values [P, E] of each measure, from policies of one recipe on the same levels.
      strata: Sizes of groups of consecutive levels; levels are drawn within each group.
      about: The measures.

    Returns:
      For each measure `mean`, `iqm` and `cvar` (mean over the worst 5 % of the levels and
      policies). Each of the three has an interval, under its name with `_interval` appended. The
      interval is null if there are too few values.
    """
    return {name: _summary(table, about[name], strata) for name, table in measured.items()}


def _summary(table: np.ndarray, measure: Measure, strata: Sequence[int] | None) -> dict[str, Any]:
    of: dict[str, Statistic] = {
        "mean": np.mean,
        "iqm": statistics.iqm,
        "cvar": partial(statistics.cvar, share=WORST, lowest=measure.is_good),
    }
    figures: dict[str, Any] = {}
    for name, statistic in of.items():
        figures[name] = float(statistic(table, axis=(0, 1)))
        figures[f"{name}_interval"] = None
        if _are_enough(table, strata):
            drawn = statistics.bootstrap(table, statistic, draw=_draw(table), strata=strata)
            figures[f"{name}_interval"] = [drawn.low, drawn.high]
    return figures


def _are_enough(table: np.ndarray, strata: Sequence[int] | None) -> bool:
    """Tells whether each group has enough levels [P, E] to draw from."""
    return min(strata or [table.shape[1]]) >= LEAST_DRAWN


def _draw(table: np.ndarray) -> Draw:
    """Chooses what to draw.

    All policies have the same levels. If there are few policies, only levels are drawn.
    """
    return "runs_and_tasks" if len(table) >= LEAST_DRAWN else "tasks"


def _pool(trials: Sequence[Trial], *, is_one: bool) -> dict[str, Any] | None:
    """Summarises the levels of all cells together.

    Returns None for a single cell, and if cells share levels. Results of cells that share levels
    are not independent, but the intervals draw the levels of each cell independently.
    """
    cells = [trial.cell for trial in trials]
    if len(cells) < 2 or any(_share(*pair) for pair in combinations(cells, 2)):
        return None
    strata = [len(cell.episodes) for cell in cells]
    return {"episodes": sum(strata), "measures": _figures(trials, strata, is_one=is_one)}


def _share(a: Cell, b: Cell) -> bool:
    """Tells whether cells have the same stage and seed, and a level number in common."""
    alike = a.seed == b.seed and replace(a.stage, name=b.stage.name) == b.stage
    return alike and bool(np.isin(a.episodes, b.episodes).any())


def compare(
    a: Measured,
    b: Measured,
    strata: Sequence[int] | None = None,
    about: Mapping[str, Measure] = MEASURES,
) -> dict[str, dict[str, Any]]:
    """Compares two recipes level by level.

    Args:
      a: Values [P, E] of each measure for the first recipe.
      b: Values [P, E] for the second recipe, on the same levels; equal rows have equal seeds.
      strata: As in `summarize`.
      about: As in `summarize`.

    Returns:
      For each measure that both have, the means `a` and `b`; `difference`, b - a of the means; and
      `improvement`, the probability that b is better on a level. Each of the last two has an
      interval, under its name with `_interval` appended.
    """
    return {name: _comparison(about[name], a[name], b[name], strata) for name in a if name in b}


def _comparison(
    measure: Measure, a: np.ndarray, b: np.ndarray, strata: Sequence[int] | None
) -> dict[str, Any]:
    better, worse = (b, a) if measure.is_good else (a, b)
    figures: dict[str, Any] = {"a": float(a.mean()), "b": float(b.mean())}
    if not _are_enough(a, strata):
        return figures
    drawn: dict[str, Any] = {"draw": _draw(a), "strata": strata}
    chance = statistics.probability_of_improvement(better, worse, **drawn)
    parts: dict[str, Interval[float]] = {
        "difference": statistics.paired(a, b, np.mean, **drawn),
        "improvement": chance,
    }
    for key, (estimate, low, high) in parts.items():
        figures |= {key: estimate, f"{key}_interval": [low, high]}
    return figures
