"""Stages of the curriculum as arrays: a stage is values, never shapes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from swarmjax.config import StageConfig

Array = Any
FENCE_HALF_LENGTH = 0.25 / 0.7  # of the side; deepworlds find_and_avoid: 0.50 m in a 0.7 m arena


class Stage(NamedTuple):
    """One stage ([]) or all of them ([S]).

    Attributes:
      robots: how many are there, int32.
      obstacles: how many are there, int32.
      side: of the arena, m.
      obstacle_size: edge of the boxes of a random level, m.
      fixed: the paper's fixed level instead of a random one, bool.
      fence: the obstacle of a fixed level is the fence instead of boxes, bool.
    """

    robots: Array
    obstacles: Array
    side: Array
    obstacle_size: Array
    fixed: Array
    fence: Array


def stack(stages: Sequence[StageConfig]) -> Stage:
    """Stacks configured stages into NumPy arrays [S]."""
    return Stage(
        robots=np.array([s.robots for s in stages], np.int32),
        obstacles=np.array([s.obstacles for s in stages], np.int32),
        side=np.array([s.side for s in stages], np.float32),
        obstacle_size=np.array([s.obstacle_size for s in stages], np.float32),
        fixed=np.array([s.level == "fixed" for s in stages]),
        fence=np.array([s.layout == "fence" for s in stages]),
    )


def select(stages: Stage, index: Array) -> Stage:
    """Picks stages [...] by index [...] out of [S]."""
    return Stage(*(field[index] for field in stages))


def largest_half(stages: Sequence[StageConfig]) -> float:
    """Half the longest edge of any obstacle of these stages, m: what the model is compiled for."""
    return max(
        FENCE_HALF_LENGTH * s.side if s.layout == "fence" else 0.5 * s.obstacle_size for s in stages
    )
