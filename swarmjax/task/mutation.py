"""Selects the numbers of a level that a mutation may change: places and sizes.

A mutated level is drawn like any other, after one of its numbers has changed. It therefore keeps
all rules of placement: nothing overlaps, and targets stay reachable as in any drawn level.
"""

from collections.abc import Sequence

import numpy as np

from swarmjax.config import ConfigError
from swarmjax.task import level
from swarmjax.task.layouts import LAYOUTS, drawing
from swarmjax.task.layouts.site import NUMBERS
from swarmjax.task.level import Spacing
from swarmjax.task.stage_config import BUILT_IN, StageConfig

# Parts of a layout's numbers that may change. The numbers of the first group may all change. The
# numbers of the second group may change only for robots that are present.
_WHOLE, _BY_ROBOT = ("wall", "room"), ("target", "start")


def layout_count(stages: Sequence[StageConfig], robots: int) -> int:
    """Returns the largest count of layout numbers among stages.

    Args:
      stages: stages of a run.
      robots: largest number of robots, R.
    """
    kinds = [stage.kind for stage in stages if stage.kind is not None]
    return max((drawing.uniform_count(kind, robots) for kind in kinds), default=0)


def number_count(stages: Sequence[StageConfig], spacing: Spacing) -> int:
    """Returns how many numbers `level.write_out` writes for a level, V."""
    return level.uniform_count(spacing) + layout_count(stages, spacing.robots)


def movable(stages: Sequence[StageConfig], spacing: Spacing) -> np.ndarray:
    """Marks the numbers that place or size walls, boxes, starts and targets.

    Args:
      stages: stages of a run.
      spacing: sizes.

    Returns:
      [S, V] float32: 1 for each number that may change, else 0.

    Raises:
      ConfigError: a stage has no such number.
    """
    found = np.zeros((len(stages), number_count(stages, spacing)), np.float32)
    for row, stage in zip(found, stages, strict=True):
        check(stage)
        row[_places(stage, spacing)] = 1.0
    return found


def check(stage: StageConfig) -> None:
    """Refuses a stage with levels that cannot be mutated.

    Raises:
      ConfigError: nothing in its levels may change.
    """
    if stage.level == "fixed":
        why = "always the same"
    elif stage.level not in BUILT_IN:
        why = "drawn by an extension"
    elif (drawn := stage.drawn_map) is not None and stage.robots <= len(drawn.pair):
        why = "a map that gives every robot its place"
    else:
        return
    raise ConfigError(
        f"curriculum.levels.mutation is given, but stage {stage.name} has level={stage.level}, "
        f"which is {why} and has nothing to move: give mutation=0, or leave the stage out."
    )


def _places(stage: StageConfig, spacing: Spacing) -> np.ndarray:
    """Lists which numbers of a stage may change."""
    if stage.kind is not None:
        return level.uniform_count(spacing) + np.array(_of_layout(stage, spacing.robots))
    many, few = spacing.obstacles, spacing.robots
    drawn = stage.drawn_map
    boxes, settled = (stage.obstacles, 0) if drawn is None else (0, len(drawn.pair))
    # `level.sample` has this order: three shifts, boxes and their turns, targets, starts.
    first = np.cumsum([6, many, many, few])
    parts = ((0, boxes), (0, boxes), (settled, stage.robots), (settled, stage.robots))
    return np.concatenate([at + np.arange(*part) for at, part in zip(first, parts, strict=True)])


def _of_layout(stage: StageConfig, robots: int) -> list[int]:
    """Lists which numbers of a layout may change."""
    layout = LAYOUTS[stage.level]
    # The two extents come first. Numbers with equal lower and upper limits do not vary, so a
    # mutation skips them.
    lengths = ("side", "breadth", *NUMBERS)
    found = [i for i, key in enumerate(lengths) if isinstance(getattr(stage, key), tuple)]
    at = drawing.before_own(robots)
    for name, count in layout.parts(robots, stage.cells or 0):
        moving = count if name in _WHOLE else stage.robots if name in _BY_ROBOT else 0
        found += range(at, at + moving)
        at += count
    return found
