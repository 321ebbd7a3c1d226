"""Which pieces of an extension a task uses. No JAX; what they compute is in `extended.py`."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from swarmjax.config import ConfigError, show
from swarmjax.config.section import ByName
from swarmjax.extension import Extensions, LevelDrawing, Observation, RewardTerm
from swarmjax.task.config import TaskConfig
from swarmjax.task.stage import stack
from swarmjax.task.stage_config import StageConfig


class Chosen(NamedTuple):
    """The pieces that a task uses.

    Attributes:
      observations: in the order in which they follow the built-in inputs.
      terms: of the reward, with their weights; none of weight 0.
      drawings: ways of drawing levels.
    """

    observations: tuple[Observation, ...]
    terms: tuple[tuple[RewardTerm, float], ...]
    drawings: tuple[LevelDrawing, ...]


def choose(extensions: Extensions, task: TaskConfig, stages: Sequence[StageConfig]) -> Chosen:
    """Finds the pieces that a task and its stages name.

    Args:
      extensions: the pieces there are.
      task: names observations and weights; where it does not, all observations are used and each
        term has the weight that it was made with.
      stages: name ways of drawing levels.

    Returns:
      The pieces.

    Raises:
      ConfigError: if one that is named is missing.
    """
    observations = {piece.name: piece for piece in extensions.observations}
    wanted = tuple(observations) if task.observations is None else task.observations
    for name in wanted:
        _check_named("task.observations", name, observations)
    terms = {piece.name: piece for piece in extensions.rewards}
    for name in task.reward.extra:
        _check_named("task.reward.extra", name, terms)
    weighted = [(each, task.reward.extra.get(name, each.weight)) for name, each in terms.items()]
    stack(stages, extensions.levels)  # refuses one that is missing
    return Chosen(
        observations=tuple(observations[name] for name in wanted),
        terms=tuple((piece, weight) for piece, weight in weighted if weight),
        drawings=extensions.levels,
    )


def resolve(extensions: Extensions, task: TaskConfig) -> TaskConfig:
    """Says in full which pieces a task uses, so that its config alone tells.

    Args:
      extensions: the pieces there are.
      task: what was given.

    Returns:
      The task with all its observations and weights named.

    Raises:
      ConfigError: if one that is named is missing.
    """
    names = tuple(piece.name for piece in choose(extensions, task, ()).observations)
    weights = ByName({piece.name: piece.weight for piece in extensions.rewards})
    weights.update(task.reward.extra)
    return replace(task, observations=names, reward=replace(task.reward, extra=weights))


def _check_named(key: str, name: str, there: dict[str, Any]) -> None:
    if name in there:
        return
    if there:
        raise ConfigError(f"{key} names {show(name)}: give one of {', '.join(there)}.")
    raise ConfigError(
        f"{key} names {show(name)}, which is not part of swarmjax: give extensions=FILE, the file "
        "that defines it."
    )
