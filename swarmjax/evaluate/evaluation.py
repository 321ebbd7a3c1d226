"""Evaluates policies on the levels of a suite or a stage, and summarises the outcome."""

import os
from collections.abc import Callable
from functools import partial
from glob import glob
from typing import Any, NamedTuple

from rich.progress import Progress

from swarmjax.config import ConfigError, show
from swarmjax.evaluate import cells, judge, summary
from swarmjax.evaluate import trials as evaluate_trials
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.trials import Entrant, Trial


class Evaluation(NamedTuple):
    """The results of an evaluation.

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
    entrants: list[Entrant] | None = None,
    progress: Progress | None = None,
    announce: Callable[[], object] = lambda: None,
) -> Evaluation:
    """Evaluates policies of one recipe, or of two recipes to compare.

    Args:
      settings: Settings of the evaluation.
      entrants: Policies of one recipe, already read from their files; None: those of `settings`.
      progress: Progress display; None shows nothing.
      announce: Called before the first episode, once all inputs are checked.

    Returns:
      The results.

    Raises:
      PolicyError: A policy is invalid, or does not fit the levels.
      ConfigError: A file is missing, a suite is invalid, or the physics breaks down.
    """
    sides = _read(settings) if entrants is None else [entrants]
    every = [each for side in sides for each in side]
    suite = cells.load(settings)
    for cell in suite.cells:
        for path, trained in every:
            judge.check_policy(settings, cell.stage, path, trained)
    announce()
    progress = progress or Progress(disable=True)
    total = sum(len(every) * len(cell.episodes) for cell in suite.cells)
    report = partial(progress.advance, progress.add_task("episodes", total=total))
    trials = list(evaluate_trials.run(settings, suite.cells, every, report))
    return Evaluation(summary.result(settings, suite.name, sides, trials), every, trials)


def _read(settings: EvaluateConfig) -> list[list[Entrant]]:
    """Reads the policies to evaluate: of one recipe, or of the two recipes to compare."""
    return [evaluate_trials.read_policies(files, settings.extensions) for files in _sides(settings)]


def _sides(settings: EvaluateConfig) -> list[list[str]]:
    """Lists the policy files: of one recipe, or of the two recipes to compare."""
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
            f"compare is {show(settings.compare)}, which names {first} and {second} policies: give "
            "as many before the comma as after it, with the same seeds in the same order."
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
            raise ConfigError(f"{key} is {show(text)}, but no file matches {show(part)}.")
        files += matches
    for file in files:
        if files.count(file) > 1:
            raise ConfigError(f"{key} is {show(text)}, which names {file} twice: give it once.")
    return files
