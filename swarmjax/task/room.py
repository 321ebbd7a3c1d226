"""Checks that maps, layouts and an extension's level drawings place robots where they fit."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from swarmjax import epuck
from swarmjax.config import ConfigError, show
from swarmjax.extension import LevelDrawing
from swarmjax.sim import gaps
from swarmjax.task import level, ways
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level, Spacing
from swarmjax.task.placement import MARGIN, round_up
from swarmjax.task.stage_config import StageConfig, smallest_side

_TRIED = 16  # levels of a stage to check
_THINGS: dict[str, str] = dict(
    zip(gaps.KINDS, ("another robot", "an obstacle", "a wall"), strict=True)
)


def check(
    stages: Sequence[StageConfig], spacing: Spacing, drawings: Sequence[LevelDrawing] = ()
) -> None:
    """Refuses stages in which robots or targets would overlap, or lie outside the walls.

    Args:
      stages: stages to run. Random and fixed levels always fit hulls up to the e-puck's.
      spacing: sizes.
      drawings: level drawings of an extension.

    Raises:
      ConfigError: a stage or a drawing has a fault; the message says which.
    """
    for stage in stages:
        own = next((piece for piece in drawings if piece.name == stage.level), None)
        if own is not None:
            for drawn in _levels(stage, spacing, drawings):
                _check_own(own, stage, drawn, spacing)
        elif must_check(stage, spacing.hull_radius):
            # A level without room for starts at `distance` keeps those that are checked here.
            for drawn in _levels(replace(stage, distance=None), spacing):
                check_level(stage, drawn, spacing)
        if stage.distance is not None:
            _check_distance(stage, spacing, drawings)


def must_check(stage: StageConfig, hull: float) -> bool:
    """Returns whether the levels of a stage might lack room for hulls of this radius.

    Raises:
      ConfigError: no level of the stage has room for such hulls.
    """
    if stage.gap is not None and np.min(stage.gap) < 2 * hull:
        raise ConfigError(
            f"stage {stage.name}: gap is {show(stage.gap)}, but robot.hull_radius is {show(hull)}, "
            f"so that no robot fits through: give more than {show(2 * hull)}."
        )
    if stage.map or stage.kind is not None:
        return True
    least = smallest_side(stage, hull) if stage.level == "random" else 0.0
    if stage.sides[0] < least and hull > epuck.HULL_RADIUS:
        raise ConfigError(
            f"stage {stage.name}: side is {show(stage.side)}, too small for {stage.robots} robots "
            f"and {stage.obstacles} obstacles with robot.hull_radius={show(hull)}: give at least "
            f"{math.ceil(100 * least) / 100}."
        )
    return hull > epuck.HULL_RADIUS and stage.level in ("random", "fixed")


def _levels(
    stage: StageConfig, spacing: Spacing, drawings: Sequence[LevelDrawing] = ()
) -> Iterator[Level]:
    """Draws the levels to check, one by one."""
    count = level.uniform_count(spacing)
    arrays = task_stage.single(stage, drawings)
    for uniforms in np.random.default_rng(0).random((_TRIED, count), dtype=np.float32):
        yield level.sample(uniforms, arrays, spacing, np)


def check_level(stage: StageConfig, drawn: Level, spacing: Spacing) -> None:
    """Refuses a level that has no room for its robots."""
    arrived = np.linalg.norm(drawn.start[:, :2] - drawn.target, axis=-1) < spacing.target_radius
    problem = _problem(drawn, spacing, gaps.KINDS, gaps.KINDS)
    if not problem and (arrived & drawn.present).any():
        problem = "a robot starts at its target"
    if problem:
        raise ConfigError(
            f"stage {stage.name}: level={stage.level} has no room for {stage.robots} robots, "
            f"because {problem}: give fewer robots, or more space."
        )


def _check_own(own: LevelDrawing, stage: StageConfig, drawn: Level, spacing: Spacing) -> None:
    """Refuses an extension's level in which robots do not fit; its targets may overlap."""
    from swarmjax.task import extended  # with JAX

    problem = _problem(extended.redraw(own, drawn), spacing, ("robot", "wall"), ("wall",))
    if problem:
        raise ConfigError(f"{extended.label(own)}, drawn for stage {stage.name}: {problem}.")


def _check_distance(stage: StageConfig, spacing: Spacing, drawings: Sequence[LevelDrawing]) -> None:
    """Refuses a distance within the target's radius, or that no sampled level allows."""
    least = round(spacing.target_radius + MARGIN, 4)
    ends = np.array(stage.distance_units)
    if ends[0] < round_up(least):
        raise ConfigError(
            f"stage {stage.name}: distance is {show(stage.distance)}, but a robot arrives within "
            f"{spacing.target_radius:g} m of its target: give at least {least:g}."
        )
    sizes = spacing.hull_radius, spacing.target_radius
    # This leaves out absent robots, which would take as long as the others.
    own = spacing._replace(robots=stage.robots, obstacles=stage.obstacles)
    levels = _levels(replace(stage, distance=None), own, drawings)
    if not any(ways.starts(each, ends, *sizes, np)[1].any() for each in levels):
        raise ConfigError(
            f"stage {stage.name}: distance is {show(stage.distance)}, but in {_TRIED} sampled "
            "levels no robot has a path of this length to its target: give a smaller distance."
        )


def _problem(
    drawn: Level, spacing: Spacing, at_start: Sequence[str], at_target: Sequence[str]
) -> str | None:
    """Describes the fault of a level: what a robot touches at its start or its target."""
    start, target = drawn.start[drawn.present], drawn.target[drawn.present]
    if not all(np.isfinite(field).all() for field in (start, target, drawn.obstacle)):
        return "a number is not finite"
    there = np.concatenate([target, start[:, 2:]], axis=-1)
    for what, pose, kinds in (("starts", start, at_start), ("has its target", there, at_target)):
        gap = gaps.gaps(pose, drawn.side, drawn.obstacle, spacing.hull_radius, np)
        for kind in kinds:
            touching = np.flatnonzero(gap[:, gaps.KINDS.index(kind)] < 0.0)
            if touching.size:
                return f"robot {touching[0]} overlaps {_THINGS[kind]} where it {what}"
    return None
