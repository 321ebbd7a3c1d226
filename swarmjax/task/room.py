"""Checks that the map or the layout of a stage has room for its robots."""

from collections.abc import Sequence

import numpy as np

from swarmjax.config import ConfigError, show
from swarmjax.extension import LevelDrawing
from swarmjax.task import level
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level, Spacing
from swarmjax.task.placement import MARGIN
from swarmjax.task.stage_config import StageConfig

_TRIED = 16  # levels of a map to check
_ROUNDING = 1.0 / 1024  # m; x and y of points are rounded to units of 1/4096 m
_BESIDE = 0.003  # m, between the hull and each side of the narrowest door


def check(
    stages: Sequence[StageConfig], spacing: Spacing, drawings: Sequence[LevelDrawing] = ()
) -> None:
    """Refuses maps and layouts in which robots or targets would overlap.

    Args:
      stages: stages to run.
      spacing: sizes.
      drawings: level drawings of an extension.

    Raises:
      ConfigError: a stage has too little room; the message says for what, and how to fix it.
    """
    for stage in stages:
        if stage.map:
            _check_map(stage, _sample(stage, spacing, drawings), spacing)
        elif stage.kind is not None:
            _check_gap(stage, spacing)
            _check_layout(stage, _sample(stage, spacing, drawings), spacing)


def _sample(stage: StageConfig, spacing: Spacing, drawings: Sequence[LevelDrawing]) -> list[Level]:
    """Draws some levels of a stage."""
    count = level.uniform_count(spacing)
    uniforms = np.random.default_rng(0).random((_TRIED, count), dtype=np.float32)
    arrays = task_stage.single(stage, drawings)
    return [level.sample(each, arrays, spacing, np) for each in uniforms]


def _check_map(stage: StageConfig, drawn: Sequence[Level], spacing: Spacing) -> None:
    for area, problem in _AREAS.items():
        if any(problem(each, spacing) for each in drawn):
            letters = len(stage.drawn_map.pair) if stage.drawn_map else 0
            raise ConfigError(
                f"stage {stage.name}: map has no room for {stage.robots - letters} robots in "
                f"{area}: give more or larger cells there, or fewer robots."
            )


def _check_gap(stage: StageConfig, spacing: Spacing) -> None:
    """Refuses doors and corridors that are narrower than a robot."""
    least = 2.0 * (spacing.hull_radius + _BESIDE)
    for key in ("gap", "width"):
        found = stage.smallest(key)
        if found is not None and found < least:
            raise ConfigError(
                f"stage {stage.name}: {key} is {show(found)}, but a robot is "
                f"{show(2.0 * spacing.hull_radius)} m wide: give at least {show(round(least, 4))}."
            )


def _check_layout(stage: StageConfig, drawn: Sequence[Level], spacing: Spacing) -> None:
    problems = (_hulls_overlap, _starts_arrived)
    if any(problem(each, spacing) for each in drawn for problem in problems):
        raise ConfigError(
            f"stage {stage.name}: level={stage.level} has no room for {stage.robots} robots in an "
            f"arena of {show(stage.side)} m: give fewer robots, or a larger side."
        )


def _hulls_overlap(drawn: Level, spacing: Spacing) -> bool:
    places = (drawn.target[drawn.present], drawn.start[drawn.present, :2])
    return min(map(_least, places)) < 2.0 * spacing.hull_radius


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
