"""Judges policies on the levels of a suite or a stage, and summarises the outcome."""

import os
from collections.abc import Callable
from functools import partial
from glob import glob
from typing import Any, NamedTuple

from rich.progress import Progress

from swarmjax.config import ConfigError, show
from swarmjax.evaluate import cells, judge, summary
from swarmjax.evaluate import trials as evaluate_trials
from swarmjax.evaluate.cells import Suite
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.trials import Entrant, Trial


class Evaluation(NamedTuple):
    """The findings of an evaluation.

    Attributes:
      result: Plain data for JSON; docs/interface.md lists it.
      entrants: The policies; in a comparison, the policies of both sides.
      trials: The results for each cell, with one row for each policy in `entrants`.
    """

    result: dict[str, Any]
    entrants: list[Entrant]
    trials: list[Trial]


def evaluate(
    settings: EvaluateConfig,
    progress: Progress | None = None,
    announce: Callable[[], object] = lambda: None,
) -> Evaluation:
    """Judges policies.

    Args:
      settings: Settings of the evaluation.
      progress: Progress display; None shows nothing.
      announce: Called before the first episode, once all inputs are checked.

    Returns:
      The findings.

    Raises:
      PolicyError: A policy is unsound, or does not fit the levels.
      ConfigError: A file is missing, a suite is unsound, or the physics breaks down.
    """
    files = _sides(settings)
    sides = [evaluate_trials.read_policies(each, settings.extensions) for each in files]
    return _judge(settings, sides, progress or Progress(disable=True), announce)


def judge_entrants(settings: EvaluateConfig, entrants: list[Entrant]) -> Evaluation:
    """Judges policies of one recipe that have already been read from their files.

    Args:
      settings: Settings of the evaluation; its `policy` is ignored.
      entrants: The policies.

    Returns:
      The findings.

    Raises:
      PolicyError: A policy does not fit the levels.
      ConfigError: A suite is unsound, or the physics breaks down.
    """
    return _judge(settings, [entrants], Progress(disable=True), lambda: None)


def _judge(
    settings: EvaluateConfig,
    sides: list[list[Entrant]],
    progress: Progress,
    announce: Callable[[], object],
) -> Evaluation:
    """Judges the policies of one side, or of two sides for a comparison."""
    entrants = [each for side in sides for each in side]
    for stage in cells.stages(settings):  # before drawing levels, which takes a while
        for path, trained in entrants:
            judge.check_policy(settings, stage, path, trained)
    suite = cells.load(settings)
    announce()
    total = sum(len(entrants) * len(cell.episodes) for cell in suite.cells)
    report = partial(progress.advance, progress.add_task("episodes", total=total))
    trials = list(evaluate_trials.run(settings, suite.cells, entrants, report))
    return Evaluation(_sum_up(settings, suite, sides, trials), entrants, trials)


def _sum_up(
    settings: EvaluateConfig, suite: Suite, sides: list[list[Entrant]], trials: list[Trial]
) -> dict[str, Any]:
    if settings.compare is None:
        return summary.result(settings, suite.name, sides[0], trials)
    first, second = sides
    part = len(first)
    pair = ([_rows(t, slice(part)) for t in trials], [_rows(t, slice(part, None)) for t in trials])
    return summary.comparison(settings, suite.name, (first, second), pair)


def _rows(trial: Trial, rows: slice) -> Trial:
    """Keeps some of the policies of a trial."""
    return trial._replace(measures={name: x[rows] for name, x in trial.measures.items()})


def _sides(settings: EvaluateConfig) -> list[list[str]]:
    """Lists the files to judge: of one recipe, or of the two recipes to compare."""
    if settings.policy is not None:
        return [list_files("policy", settings.policy)]
    parts = (settings.compare or "").split(",")
    if len(parts) != 2 or not all(parts):
        raise ConfigError(
            f"compare is {show(settings.compare)}: give two files or patterns, as in a.npz,b.npz."
        )
    sides = [list_files("compare", part) for part in parts]
    first, second = map(len, sides)
    if first != second:
        raise ConfigError(
            f"compare is {show(settings.compare)}, with {first} and {second} policies: give the "
            "same number on both sides, with the same seeds in the same order."
        )
    return sides


def list_files(key: str, text: str) -> list[str]:
    """Lists the files that a setting of the command line names.

    Args:
      key: Key of the setting.
      text: Paths and patterns such as `runs/a-seed*.npz`, separated by commas.

    Returns:
      The paths. Paths that match the same pattern are in alphabetical order.

    Raises:
      ConfigError: A pattern matches nothing, or a file is named twice.
    """
    files: list[str] = []
    for part in [text] if os.path.isfile(text) else text.split(","):
        matches = sorted(glob(part)) if set(part) & set("*?[") else [part]
        if not matches or not part:
            raise ConfigError(f"{key} is {show(text)}, and {show(part)} matches no file.")
        files += matches
    for file in files:
        if files.count(file) > 1:
            raise ConfigError(f"{key} is {show(text)}, which names {file} twice: give it once.")
    return files
