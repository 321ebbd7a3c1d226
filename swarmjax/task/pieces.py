"""Selects the extension pieces that a task uses, without JAX; `extended.py` runs them."""

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
      observations: observations in order, placed after the built-in inputs.
      terms: reward terms with non-zero weights.
      drawings: level drawings.
    """

    observations: tuple[Observation, ...]
    terms: tuple[tuple[RewardTerm, float], ...]
    drawings: tuple[LevelDrawing, ...]


def choose(extensions: Extensions, task: TaskConfig, stages: Sequence[StageConfig]) -> Chosen:
    """Finds the pieces that a task and its stages name.

    Args:
      extensions: the available pieces.
      task: the task, which names observations and weights. By default, all observations are used,
        and each term has its own default weight.
      stages: stages, which may name level drawings.

    Returns:
      The pieces.

    Raises:
      ConfigError: a named piece is missing.
    """
    observations = {piece.name: piece for piece in extensions.observations}
    wanted = tuple(observations) if task.observations is None else task.observations
    for name in wanted:
        _check_named("task.observations", name, observations)
    terms = {piece.name: piece for piece in extensions.rewards}
    for name in task.reward.extra:
        _check_named("task.reward.extra", name, terms)
    weighted = [(each, task.reward.extra.get(name, each.weight)) for name, each in terms.items()]
    stack(stages, extensions.levels)  # raises if a level drawing is missing
    return Chosen(
        observations=tuple(observations[name] for name in wanted),
        terms=tuple((piece, weight) for piece, weight in weighted if weight),
        drawings=extensions.levels,
    )


def resolve(extensions: Extensions, task: TaskConfig) -> TaskConfig:
    """Fills in the pieces that a task uses, so that its config names all of them.

    Args:
      extensions: the available pieces.
      task: the task as given.

    Returns:
      The task with all its observations and weights named.

    Raises:
      ConfigError: a named piece is missing.
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
        f"{key} names {show(name)}, which is not part of swarmjax: add extensions=FILE, the Python "
        f"file that defines {show(name)}."
    )
