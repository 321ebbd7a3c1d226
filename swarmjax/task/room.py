"""Whether the areas of a stage's map have room for its robots."""

from collections.abc import Sequence

import numpy as np

from swarmjax.config import ConfigError
from swarmjax.extension import LevelDrawing
from swarmjax.task import level
from swarmjax.task import stage as task_stage
from swarmjax.task.level import MARGIN, Level, Spacing
from swarmjax.task.stage_config import StageConfig

_TRIED = 16  # levels of a map that are looked at
_ROUNDING = 1.0 / 1024  # m; points are rounded to units of 1/4096 m, each way


def check(
    stages: Sequence[StageConfig], spacing: Spacing, drawings: Sequence[LevelDrawing] = ()
) -> None:
    """Refuses maps in which robots or targets would be on top of each other.

    Args:
      stages: those that will be run.
      spacing: sizes.
      drawings: an extension's ways of drawing levels.

    Raises:
      ConfigError: naming the stage, the area and what would help.
    """
    count = level.uniform_count(spacing)
    uniforms = np.random.default_rng(0).random((_TRIED, count), dtype=np.float32)
    for stage in stages:
        if not stage.map:
            continue
        arrays = task_stage.single(stage, drawings)
        drawn = [level.sample(each, arrays, spacing, np) for each in uniforms]
        for area, problem in _AREAS.items():
            if any(problem(each, spacing) for each in drawn):
                letters = int(arrays.map.pairs) if arrays.map else 0
                raise ConfigError(
                    f"stage {stage.name}: map has no room for {stage.robots - letters} robots in "
                    f"{area}: give more or larger cells there, or fewer robots."
                )


def _targets_overlap(drawn: Level, spacing: Spacing) -> bool:
    places = drawn.target[drawn.present]
    return _least(places) < 2.0 * (spacing.hull_radius + MARGIN) - _ROUNDING


def _starts_overlap(drawn: Level, spacing: Spacing) -> bool:
    places = drawn.start[drawn.present, :2]
    return _least(places) < 2.0 * spacing.hull_radius + MARGIN - _ROUNDING


def _starts_arrived(drawn: Level, spacing: Spacing) -> bool:
    apart = np.linalg.norm(drawn.start[:, :2] - drawn.target, axis=-1)[drawn.present]
    return bool(np.any(apart < spacing.target_radius))


def _least(places: np.ndarray) -> float:
    """Returns the least distance between two of the places, m."""
    apart = np.linalg.norm(places[:, None] - places[None, :], axis=-1)
    return float(np.min(apart[np.triu_indices(len(places), 1)], initial=np.inf))


_AREAS = {
    "T, beside targets with letters": _targets_overlap,
    "S, beside starts with letters": _starts_overlap,
    "S, apart from their targets": _starts_arrived,
}
