"""Obstacles with shapes other than the trained box; they consist of boxes in its outer circle.

A level keeps distances from an obstacle's outer circle, so these distances hold for any shape
inside the circle. The shapes consist of boxes because both engines and the analytic sensors support
boxes. NumPy only.
"""

import math
from typing import Literal, NamedTuple

import numpy as np

from swarmjax.task.level import Level

# Shapes of a random level's obstacles in an evaluation; training uses boxes only.
Shape = Literal["box", "bar", "cross", "ell", "pillar"]

HALF_THICKNESS = 0.005  # m, for plates; we chose the thickness of a board that stands upright
# Coordinates are rounded to binary fractions of a metre, which float32 holds exactly. A level is
# then identical to the last bit, even on machines that round sine and cosine differently.
_GRID = 2.0**20


class _Part(NamedTuple):
    """A box of a shape, in the obstacle's own frame; m and rad."""

    x: float
    y: float
    turn: float
    half_length: float
    half_width: float


def _parts(shape: Shape, half: float) -> list[_Part]:
    """Returns the boxes of a shape, within the outer circle of a square of half edge `half`, m."""
    outer, thin = half * math.sqrt(2.0), min(HALF_THICKNESS, 0.5 * half)
    bar = _Part(0.0, 0.0, 0.0, math.sqrt(outer**2 - thin**2), thin)
    quarter = 0.5 * math.pi
    if shape == "bar":
        return [bar]
    if shape == "cross":
        return [bar, bar._replace(turn=quarter)]
    if shape == "ell":  # two sides of the square form an L
        aside = half - thin
        return [_Part(0.0, -aside, 0.0, half, thin), _Part(-aside, 0.0, quarter, half, thin)]
    if shape == "pillar":  # four boxes form a regular octagon; its edges are the boxes' ends
        length, width = outer * math.cos(math.pi / 8), outer * math.sin(math.pi / 8)
        return [_Part(0.0, 0.0, 0.25 * math.pi * i, length, width) for i in range(4)]
    return [_Part(0.0, 0.0, 0.0, half, half)]


def boxes_of(shape: Shape) -> int:
    """Returns how many boxes an obstacle of a shape consists of."""
    return len(_parts(shape, 1.0))


def expand(level: Level, shape: Shape) -> Level:
    """Replaces the boxes of a random level with obstacles of another shape.

    Args:
      level: level of one arena, as drawn; NumPy.
      shape: shape of the obstacles; `box` changes nothing.

    Returns:
      The level with P boxes for each of its M obstacles, [M * P, 5]. The boxes of an obstacle are
      consecutive.
    """
    if shape == "box":
        return level
    boxes = [_place(box, part) for box in level.obstacle for part in _parts(shape, float(box[3]))]
    return level._replace(
        obstacle_present=np.repeat(level.obstacle_present, boxes_of(shape)),
        obstacle=np.array(boxes, np.float32).reshape(-1, 5),
    )


def _place(box: np.ndarray, part: _Part) -> list[float]:
    """Places a part at the obstacle [5]."""
    x, y, yaw = (float(value) for value in box[:3])
    cos, sin = math.cos(yaw), math.sin(yaw)
    place = (x + cos * part.x - sin * part.y, y + sin * part.x + cos * part.y)
    exact = [round(value * _GRID) / _GRID for value in (*place, yaw + part.turn)]
    return [*exact, part.half_length, part.half_width]
