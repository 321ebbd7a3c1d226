"""Curricula along axes: a stage and easier values of its keys become a grid of stages.

With `curriculum.axes`, each combination of one value from every axis is a stage. The last value of
an axis is the stage's own, so the last stage is the stage itself. From one stage to the next,
the last axis changes fastest.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from swarmjax import words
from swarmjax.config import ConfigError, show
from swarmjax.task.layouts.site import NUMBERS
from swarmjax.task.stage_files import complete

AXES = ("robots", "side", "distance", "obstacles", "obstacle_size", "breadth", "cells", *NUMBERS)
MOST_STAGES = 64  # of a grid; each stage has a record and a column in the log


def expand(stage: Mapping[str, Any], axes: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Makes the stages of a grid.

    Args:
      stage: plain data of the stage that becomes the last one.
      axes: for each axis, values from easy to hard; the stage's own value is left out.

    Returns:
      Plain data of the stages; the last one is `stage`.

    Raises:
      ConfigError: an axis is unknown or empty, or holds an invalid value, a value twice or the
        stage's own value; or the grid is too large.
    """
    for key, values in axes.items():
        _check(stage, key, values)
    columns = [[*values, stage.get(key)] for key, values in axes.items()]
    count = math.prod(map(len, columns))
    if count > MOST_STAGES:
        raise ConfigError(
            f"curriculum.axes makes {count} stages, including those with the stage's own values: "
            f"give fewer values, for at most {MOST_STAGES} stages."
        )
    grid = []
    for values in itertools.product(*columns):
        own = dict(zip(axes, values, strict=True))
        name = "-".join(f"{key}{_written(value)}" for key, value in own.items())
        grid.append(complete({**stage, **own, "name": f"{stage['name']}-{name}"}))
    return [*grid[:-1], dict(stage)]


def _check(stage: Mapping[str, Any], key: str, values: Any) -> None:
    """Refuses an axis that is unknown or has invalid values."""
    if key not in AXES:
        raise ConfigError(f"curriculum.axes.{key} is not an axis: give one of {', '.join(AXES)}.")
    if not isinstance(values, Sequence) or isinstance(values, str) or not values:
        raise ConfigError(
            f"curriculum.axes.{key} is {show(values)}: give a list of values from easy to hard, "
            "and leave out the stage's own value."
        )
    for value in values:
        ends = value if isinstance(value, Sequence) and len(value) == 2 else [value]
        if any(isinstance(end, bool) or not isinstance(end, int | float) for end in ends):
            raise ConfigError(
                f"curriculum.axes.{key} holds {show(value)}: give numbers, or ranges [low,high]."
            )
        if values.count(value) > 1:
            raise ConfigError(
                f"curriculum.axes.{key} holds {show(value)} more than once: give each value once."
            )
    if stage.get(key) in values:
        raise ConfigError(
            f"curriculum.axes.{key} is {show(values)}, but stage.{key} is {show(stage[key])}: "
            "leave out this value, because it is added as the last one."
        )


def _written(value: Any) -> str:
    """Writes a value as part of a stage's name, such as 0p15 or 0p1to0p2."""
    return words.setting(value).replace(" ", "").replace(".", "p").replace("-", "m")


def easier(axes: Mapping[str, Sequence[Any]], stages: int) -> np.ndarray:
    """Returns which stages have to be learned before each stage opens.

    Args:
      axes: `curriculum.axes`; empty if the stages are a sequence.
      stages: S.

    Returns:
      [S, S] bool; entry (i, j) is true if stage j is one step easier than stage i on one axis. In a
      sequence, stage j is the stage before stage i.
    """
    sizes = [len(values) + 1 for values in axes.values()] or [stages]
    place = np.stack(np.unravel_index(np.arange(stages), sizes), axis=-1)
    ahead = place[:, None] - place[None]
    return (ahead >= 0).all(axis=-1) & (ahead.sum(axis=-1) == 1)
