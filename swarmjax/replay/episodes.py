"""Chooses the episodes of a replay, and records them."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from rich.progress import Progress

from swarmjax.config import ConfigError
from swarmjax.evaluate import cells
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate import trials as evaluate_trials
from swarmjax.evaluate.cells import Cell
from swarmjax.evaluate.trials import Entrant, Trial
from swarmjax.replay import record
from swarmjax.replay.config import ReplayConfig
from swarmjax.replay.record import ReplayEpisode


class Pick(NamedTuple):
    """An episode to replay: the index of its cell, and its row there."""

    cell: int
    row: int


def replay(
    settings: ReplayConfig, entrants: Sequence[Entrant], progress: Progress
) -> list[ReplayEpisode]:
    """Records the requested episodes.

    Args:
      settings: The replay's settings.
      entrants: The policies that drive.
      progress: Shows the progress.

    Returns:
      The recordings of each level, in the order in which the levels were named, or the worst
      first.

    Raises:
      PolicyError: If a policy does not fit a level's stage.
      ConfigError: If there are too few levels, or the physics breaks down.
    """
    judged = settings.evaluation
    if settings.worst is None:
        chosen = [cells.draw_stage(judged, settings.levels)]
    else:
        chosen = list(cells.load(judged).cells)
    for cell in chosen:
        for each in entrants:
            evaluate_judge.check_policy(judged, cell.stage, *each)
    if settings.worst is None:
        picks = [Pick(0, row) for row in range(len(settings.levels))]
    else:
        count = sum(len(cell.episodes) for cell in chosen)
        if settings.worst > count:
            raise ConfigError(
                f"worst is {settings.worst}: give 1 to {count}, the levels there are."
            )
        report = partial(progress.advance, progress.add_task("episodes", total=count))
        picks = worst(
            list(evaluate_trials.run(judged, chosen, entrants[:1], report)), settings.worst
        )
    return _record(settings, entrants, chosen, picks)


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
        np.concatenate([each.measures[name][0] for each in trials])
        for name in ("targets_reached", "contacts_per_robot", "episode_time_s")
    )
    return [picks[i] for i in np.lexsort([-time, -contacts, reached])[:count]]


def _record(
    settings: ReplayConfig,
    entrants: Sequence[Entrant],
    chosen: Sequence[Cell],
    picks: Sequence[Pick],
) -> list[ReplayEpisode]:
    """Records episodes; those of one cell run side by side."""
    recorded = {}
    for i in sorted({pick.cell for pick in picks}):
        cell, mine = chosen[i], [pick for pick in picks if pick.cell == i]
        levels = cells.split(cell.levels)
        runs = []
        for each in entrants:
            judged = evaluate_trials.specialise(settings.evaluation, cell)
            judge = evaluate_judge.load(judged, each.policy, cell.half)
            runs.append(record.record(judge, [levels[pick.row] for pick in mine]))
        for pick, by_policy in zip(mine, zip(*runs, strict=True), strict=True):
            number = int(cell.episodes[pick.row])
            label = f"level {number}" if len(chosen) == 1 else f"{cell.name}, level {number}"
            recorded[pick] = ReplayEpisode(label, number, list(by_policy))
    return [recorded[pick] for pick in picks]
