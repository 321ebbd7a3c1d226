"""Stages of the curriculum as arrays; stages differ in values, never in shapes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from swarmjax.config import ConfigError, show
from swarmjax.extension import LevelDrawing
from swarmjax.task import fixed_level, maps
from swarmjax.task.layouts import drawing
from swarmjax.task.layouts.drawing import Kind, LayoutArrays
from swarmjax.task.layouts.site import THICKNESS
from swarmjax.task.maps import MapArrays
from swarmjax.task.placement import UNITS
from swarmjax.task.stage_config import BUILT_IN, StageConfig

Array = Any


class Stage(NamedTuple):
    """One stage, with fields [], or all stages, with fields [S].

    Attributes:
      robots: number of robots, int32.
      obstacles: number of obstacles, int32.
      side: side of the arena, or the smallest side that the arena may have, m.
      largest_side: largest side, m; if it exceeds `side`, each level draws its own side.
      obstacle_size: edge of the boxes of a random level, m.
      fixed: whether the level is the paper's fixed level instead of a random level, bool.
      fence: whether a fixed level has the fence instead of boxes, bool.
      drawing: 1 + index of the extension drawing of the stage's levels, 0 for none, int32.
      map: the maps; None if no stage has one.
      layouts: numbers of the stages' layouts, by kind; None if no stage has one.
      distance: shortest and longest path from start to target, [2] units, int32; 0 for any; None
        if no stage has one.
      laid_out: true if all stages have a layout; None if any stage has none.
    """

    robots: Array
    obstacles: Array
    side: Array
    largest_side: Array
    obstacle_size: Array
    fixed: Array
    fence: Array
    drawing: Array
    map: MapArrays | None = None
    layouts: dict[Kind, LayoutArrays] | None = None
    distance: Array | None = None
    laid_out: Array | None = None


def stack(stages: Sequence[StageConfig], drawings: Sequence[LevelDrawing] = ()) -> Stage:
    """Stacks configured stages into NumPy arrays [S].

    Args:
      stages: the stages.
      drawings: level drawings of an extension.

    Raises:
      ConfigError: a level drawing is missing.
    """
    names = [piece.name for piece in drawings]
    return Stage(
        robots=np.array([s.robots for s in stages], np.int32),
        obstacles=np.array([s.obstacles for s in stages], np.int32),
        side=np.array([s.sides[0] for s in stages], np.float32),
        largest_side=np.array([s.sides[1] for s in stages], np.float32),
        obstacle_size=np.array([s.obstacle_size for s in stages], np.float32),
        fixed=np.array([s.level == "fixed" for s in stages]),
        fence=np.array([s.layout == "fence" for s in stages]),
        drawing=np.array([_drawing(s, names) for s in stages], np.int32),
        map=maps.stack([stage.drawn_map for stage in stages]),
        layouts=drawing.stack([stage.laid_out for stage in stages]) or None,
        distance=np.array([stage.distance_units for stage in stages], np.int32)
        if any(stage.distance for stage in stages)
        else None,
        laid_out=np.ones(len(stages), bool) if all(s.laid_out for s in stages) else None,
    )


def single(stage: StageConfig, drawings: Sequence[LevelDrawing] = ()) -> Stage:
    """Returns one configured stage, with NumPy fields [], after the same checks as `stack`."""
    return select(stack([stage], drawings), np.intp(0))


def select(stages: Stage, index: Array) -> Stage:
    """Picks stages [...] by index [...] out of [S]."""
    *fields, drawn, layouts, distance, laid_out = stages
    drawn = None if drawn is None else MapArrays(*(field[index] for field in drawn))
    if layouts is not None:
        layouts = {
            kind: LayoutArrays(*(field[index] for field in arrays))
            for kind, arrays in layouts.items()
        }
    distance = None if distance is None else distance[index]
    laid_out = None if laid_out is None else laid_out[index]
    values = (field[index] for field in fields)
    return Stage(*values, map=drawn, layouts=layouts, distance=distance, laid_out=laid_out)


def largest_half(stages: Sequence[StageConfig]) -> float:
    """Returns half the longest obstacle edge in these stages, m.

    The model is compiled for this length.
    """
    return max(_half(stage) for stage in stages)


def _drawing(stage: StageConfig, drawings: Sequence[str]) -> int:
    """Returns 1 + index of the extension drawing of a stage's levels; 0 without one."""
    if stage.level in BUILT_IN:
        return 0
    if stage.level not in drawings:
        known = ", ".join([*BUILT_IN, *drawings])
        raise ConfigError(
            f"stage {stage.name}: level is {show(stage.level)}: give one of {known}, or add "
            "extensions=FILE, the Python file that defines this level."
        )
    return 1 + list(drawings).index(stage.level)


def _half(stage: StageConfig) -> float:
    """Returns half the longest edge of a stage's obstacles, m."""
    if stage.laid_out is not None:
        return 0.5 * stage.sides[1] + THICKNESS / UNITS  # no wall is longer than the arena
    if (drawn := stage.drawn_map) is not None:
        return float(drawn.wall[:, 3:].max(initial=0.5 * stage.obstacle_size))
    if stage.layout == "fence":
        return fixed_level.FENCE_HALF_LENGTH * stage.sides[1]
    return fixed_level.BOX_HALF if stage.level == "fixed" else 0.5 * stage.obstacle_size
