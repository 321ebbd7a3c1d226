"""Checks that maps, layouts and an extension's level drawings place robots where they fit."""

from collections.abc import Sequence

import numpy as np

from swarmjax.config import ConfigError, show
from swarmjax.extension import LevelDrawing
from swarmjax.task import extended, level
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level, Spacing
from swarmjax.task.stage_config import StageConfig

_TRIED = 16  # levels of a stage to check
_BESIDE = 0.003  # m, between the hull and each side of the narrowest door


def check(
    stages: Sequence[StageConfig], spacing: Spacing, drawings: Sequence[LevelDrawing] = ()
) -> None:
    """Refuses stages in which robots or targets would overlap, or lie outside the walls.

    Args:
      stages: stages to run. Random and fixed levels always fit.
      spacing: sizes.
      drawings: level drawings of an extension.

    Raises:
      ConfigError: a stage or a drawing has a fault; the message says which.
    """
    uniforms = np.random.default_rng(0).random(
        (_TRIED, level.uniform_count(spacing)), dtype=np.float32
    )
    for stage in stages:
        own = next((piece for piece in drawings if piece.name == stage.level), None)
        if own is None and not stage.map and stage.kind is None:
            continue
        _check_gap(stage, spacing)
        arrays = task_stage.single(stage, drawings)
        for each in uniforms:
            drawn = level.sample(each, arrays, spacing, np)
            if own is not None:
                drawn = extended.redraw(own, drawn)
            problem = _problem(drawn, spacing, targets=own is None)
            if problem and own is not None:
                raise ConfigError(
                    f"{extended.label(own)}, drawn for stage {stage.name}: {problem}."
                )
            if problem:
                raise ConfigError(
                    f"stage {stage.name}: level={stage.level} has no room for {stage.robots} "
                    f"robots, since {problem}: give fewer robots, or more space."
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


def _problem(drawn: Level, spacing: Spacing, *, targets: bool) -> str | None:
    """Describes the fault of a level, if it has one; an extension's targets may overlap."""
    start, target = drawn.start[drawn.present], drawn.target[drawn.present]
    if not all(np.isfinite(field).all() for field in (start, target, drawn.obstacle)):
        return "a number is not finite"
    room = 0.5 * float(drawn.side) - spacing.hull_radius
    for what, place in (("starts", start[:, :2]), ("has its target", target)):
        outside = np.flatnonzero(np.abs(place).max(axis=-1) > room)
        if outside.size:
            return f"robot {outside[0]} {what} {show(room)} m or more off the middle of the arena"
        apart = np.linalg.norm(place[:, None] - place[None, :], axis=-1)
        close = np.argwhere(np.triu(apart < 2.0 * spacing.hull_radius, 1))
        if close.size and (what == "starts" or targets):
            return f"robots {close[0][0]} and {close[0][1]} overlap where each {what}"
    arrived = np.linalg.norm(start[:, :2] - target, axis=-1) < spacing.target_radius
    return "a robot starts within its target" if targets and arrived.any() else None
