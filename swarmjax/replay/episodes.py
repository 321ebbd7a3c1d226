"""Chooses the episodes of a replay, and records them."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from rich.progress import Progress

from swarmjax.config import ConfigError, show
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
      ConfigError: If there is no such level, or the physics breaks down.
    """
    chosen = _cells(settings)
    count = sum(len(cell.episodes) for cell in chosen)
    _check_worst(settings, count)
    for cell in chosen:
        for each in entrants:
            evaluate_judge.check_policy(settings.evaluation, cell.stage, *each)
    if settings.worst is None:
        picks = _named(settings, chosen)
    else:
        report = partial(progress.advance, progress.add_task("episodes", total=count))
        trials = list(evaluate_trials.run(settings.evaluation, chosen, entrants[:1], report))
        picks = worst(trials, settings.worst)
    used = [chosen[row] for row in {pick.cell for pick in picks}]
    limits = [evaluate_trials.specialise(settings.evaluation, cell).step_limit for cell in used]
    bar = progress.add_task("steps", total=sum(limits) * len(entrants))
    return _record(settings, entrants, chosen, picks, partial(progress.advance, bar))


def _cells(settings: ReplayConfig) -> list[Cell]:
    """Draws the levels to choose from; for a stage, no more than the named ones need."""
    if settings.suite is None and settings.worst is None:
        return [cells.draw_stage(settings.evaluation, settings.levels)]
    suite = cells.load(settings.evaluation)
    if settings.cell is None:
        return list(suite.cells)
    named = [cell for cell in suite.cells if cell.name == settings.cell]
    if not named:
        names = ", ".join(cell.name for cell in suite.cells)
        raise ConfigError(f"cell is {show(settings.cell)}: give one of {names}.")
    return named


def _check_worst(settings: ReplayConfig, count: int) -> None:
    """Checks that there are enough levels to choose from."""
    if settings.worst is not None and settings.worst > count:
        where = f"suite {settings.suite}" + (f", cell {settings.cell}," if settings.cell else "")
        raise ConfigError(
            f"worst is {settings.worst}, but {where} has {count} levels: give 1 to {count}."
        )


def _named(settings: ReplayConfig, chosen: Sequence[Cell]) -> list[Pick]:
    """Finds the named levels; they need a single cell."""
    if len(chosen) > 1:
        names = ", ".join(cell.name for cell in chosen)
        raise ConfigError(
            f"suite {settings.suite} has several cells: give worst=5, or cell=NAME of {names}."
        )
    rows = {number: row for row, number in enumerate(chosen[0].episodes.tolist())}
    for number in settings.levels:
        if number not in rows:
            raise ConfigError(
                f"level is {number}, but cell {chosen[0].name} has the {len(rows)} levels "
                f"{min(rows)} to {max(rows)}: give one of them."
            )
    return [Pick(0, rows[number]) for number in settings.levels]


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
    report: Callable[[int], None],
) -> list[ReplayEpisode]:
    """Records episodes; those of one cell run side by side."""
    recorded = {}
    for i in sorted({pick.cell for pick in picks}):
        cell, mine = chosen[i], [pick for pick in picks if pick.cell == i]
        levels = cells.split(cell.levels)
        runs = []
        for each in entrants:
            judged = evaluate_trials.specialise(settings.evaluation, cell, each.path)
            judge = evaluate_judge.load(judged, each.policy, cell.half)
            runs.append(record.record(judge, [levels[pick.row] for pick in mine], report))
        for pick, by_policy in zip(mine, zip(*runs, strict=True), strict=True):
            number = int(cell.episodes[pick.row])
            label = f"level {number}" if len(chosen) == 1 else f"{cell.name}, level {number}"
            recorded[pick] = ReplayEpisode(label, number, list(by_policy))
    return [recorded[pick] for pick in picks]
