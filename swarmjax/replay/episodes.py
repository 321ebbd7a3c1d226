"""Chooses the episodes of a replay, and records them."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from rich.progress import Progress

from swarmjax import words
from swarmjax.config import ConfigError
from swarmjax.evaluate import cells
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate import trials as evaluate_trials
from swarmjax.evaluate.cells import Suite
from swarmjax.evaluate.trials import Entrant, Trial
from swarmjax.replay import judged, record
from swarmjax.replay.config import ReplayConfig
from swarmjax.replay.record import Recording, ReplayEpisode
from swarmjax.task.config import TaskConfig


class Pick(NamedTuple):
    """An episode to replay: the index of its cell in the suite, and its row in that cell."""

    cell: int
    row: int


def replay(
    settings: ReplayConfig, entrants: Sequence[Entrant], progress: Progress
) -> list[ReplayEpisode]:
    """Records the requested episodes.

    Args:
      settings: The replay's settings.
      entrants: The policies that drive the robots.
      progress: Shows the progress, and says whether the results of an earlier evaluation are used.

    Returns:
      The recordings of each level. They are in the order of the setting `level`; with `worst`, the
      worst episode comes first.

    Raises:
      PolicyError: If a policy does not fit the stage of a level.
      ConfigError: If `worst` exceeds the number of levels, or the physics breaks down.
    """
    if settings.worst is None:
        suite = Suite(None, (cells.draw_stage(settings.evaluation, settings.levels),))
    else:
        suite = cells.load(settings.evaluation)
    for cell in suite.cells:
        for each in entrants:
            evaluate_judge.check_policy(settings.evaluation, cell.stage, *each)
    count = sum(len(cell.episodes) for cell in suite.cells)
    if settings.worst is None:
        picks = [Pick(0, row) for row in range(count)]
    elif settings.worst > count:
        raise ConfigError(f"worst is {settings.worst}: give 1 to {count} levels.")
    else:
        picks = worst(_judge(settings, entrants[0], suite, count, progress), settings.worst)
    return _record(settings, entrants, suite, picks)


def _judge(
    settings: ReplayConfig, entrant: Entrant, suite: Suite, count: int, progress: Progress
) -> list[Trial]:
    """Takes a policy's results on all levels from an earlier evaluation, or evaluates the policy.

    `count` is the number of levels.
    """
    say = partial(progress.print, markup=False, highlight=False, soft_wrap=True)
    episodes, found = words.count(count, "episode"), judged.find(settings, entrant, suite)
    if found:
        say(f"Takes the results of {episodes} from {found[0]}, where evaluate stored them.")
        return found[1]
    say(f"Evaluates {episodes}. To reuse results, give `out=` to evaluate (docs/replay.md).")
    report = partial(progress.advance, progress.add_task("episodes", total=count))
    return list(evaluate_trials.run(settings.evaluation, suite.cells, [entrant], report))


def worst(trials: Sequence[Trial], count: int) -> list[Pick]:
    """Chooses the episodes that went worst for the first policy.

    Args:
      trials: The policy's results on each cell.
      count: How many episodes to choose.

    Returns:
      The worst episodes first. The order is by fewest targets reached, then by most contacts per
      robot, then by longest duration, then by level number.
    """
    picks = [Pick(i, j) for i, each in enumerate(trials) for j in range(len(each.cell.episodes))]
    reached, contacts, time = (
        np.concatenate([each.measures[name][0] for each in trials]) for name in judged.RANKED
    )
    return [picks[i] for i in np.lexsort([-time, -contacts, reached])[:count]]


def _record(
    settings: ReplayConfig, entrants: Sequence[Entrant], suite: Suite, picks: Sequence[Pick]
) -> list[ReplayEpisode]:
    """Records episodes; those of one cell run side by side."""
    recorded = {}
    for i in sorted({pick.cell for pick in picks}):
        cell, mine = suite.cells[i], [pick for pick in picks if pick.cell == i]
        levels = cells.split(cell.levels)
        runs = []
        for each in entrants:
            config = evaluate_trials.specialise(settings.evaluation, cell)
            judge = evaluate_judge.load(config, each.policy, cell.half)
            runs.append(record.record(judge, [levels[pick.row] for pick in mine]))
        for pick, by_policy in zip(mine, zip(*runs, strict=True), strict=True):
            number = int(cell.episodes[pick.row])
            name = f"Episode {number} of {cell.name}: {outcome(by_policy, settings.task)}"
            recorded[pick] = ReplayEpisode(name, number, list(by_policy))
    return [recorded[pick] for pick in picks]


def outcome(runs: Sequence[Recording], task: TaskConfig) -> str:
    """Says how an episode ended, as in `4 of 5 robots arrived, 12.3 s`.

    With two policies, the text begins like `3 and 4 of 5 robots`.

    Args:
      runs: The level's recordings, one per policy.
      task: Gives the control step, and what counts as arrival.
    """
    there = " and ".join(str(run.arrived[-1].sum()) for run in runs)
    robots = words.count(runs[0].arrived.shape[1], "robot")
    end = "arrived" if task.arrival == "latch" else "within their targets"
    times = " and ".join(f"{(len(run.pose) - 1) * task.control_step:.1f}" for run in runs)
    return f"{there} of {robots} {end}, {times} s"
