"""The paper's fixed level: the same starts, targets and obstacles at every reset.

The paper gives no coordinates. The coordinates here come from the published example that the
paper's task is based on: find_and_avoid of deepworlds. The example has a 0.7 m arena, and one robot
that drives from (-0.26, 0.27), facing +x, to (0.26, -0.23). A fence of 0.50 x 0.06 m is centred on
(-0.10, 0.16).

The coordinates are scaled with the arena. The swarm starts in a row. Its targets are clustered
0.1 m apart on the far side.
"""

from typing import Any

import numpy as np

Array = Any

EXAMPLE_SIDE = 0.7  # m; deepworlds find_and_avoid
START = (-0.26, 0.27)  # m, position in the example's arena
TARGET = (0.26, -0.23)  # m, position in the example's arena
FENCE = (-0.10, 0.16)  # m, position of the centre in the example's arena
FENCE_HALF_LENGTH = 0.25 / EXAMPLE_SIDE  # share of the arena's side
FENCE_HALF_WIDTH = 0.03  # m; not scaled, since a real wall keeps its thickness
BOX_HALF = 0.05  # m; the 0.1 m boxes of the stock e-puck world
SPACING = 0.1  # m; between starts, and between targets: wider than a robot
# Centres of the boxes in the example's arena, in order of use. The boxes lie between starts and
# targets. In arenas of 1 m and more, at least 0.10 m is free between two boxes. This project chose
# the positions.
BOXES = ((0.0, 0.02), (-0.17, -0.12), (0.17, 0.1), (0.02, -0.2))


def most_robots(side: float) -> int:
    """Returns how many robots fit into the row of starts in an arena of `side` m."""
    scale = side / EXAMPLE_SIDE
    return 1 + int((0.5 * side - 0.06 - START[0] * scale) // SPACING)


def starts(robots: int, side: Array, xp: Any) -> Array:
    """Places the starts: a row along the upper wall, facing +x.

    Args:
      robots: R.
      side: [] side of the arena, m.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [R, 3] x (m), y (m), yaw (rad).
    """
    scale = side / EXAMPLE_SIDE
    row = SPACING * np.arange(robots, dtype=np.float32)
    x = START[0] * scale + row
    return xp.stack([x, xp.zeros_like(x) + START[1] * scale, xp.zeros_like(x)], axis=-1)


def targets(robots: int, side: Array, xp: Any) -> Array:
    """Places the targets: columns of two, from the far corner back along the wall.

    Args:
      robots: R.
      side: [] side of the arena, m.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [R, 2] x (m), y (m).
    """
    scale = side / EXAMPLE_SIDE
    index = np.arange(robots)
    back = (SPACING * (index // 2)).astype(np.float32)
    up = (SPACING * (index % 2)).astype(np.float32)
    return xp.stack([TARGET[0] * scale - back, TARGET[1] * scale + up], axis=-1)


def obstacles(count: int, side: Array, fenced: Array, xp: Any) -> Array:
    """Places the obstacles: `count` boxes, or `count` copies of the fence.

    Args:
      count: M.
      side: [] side of the arena, m.
      fenced: [] whether the obstacles are the fence.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [M, 5] x (m), y (m), yaw (rad), half edges (m).
    """
    if not count:
        return xp.zeros((0, 5), dtype=xp.float32)
    scale = side / EXAMPLE_SIDE
    centres = np.resize(np.array(BOXES, np.float32), (count, 2))
    one = xp.ones_like(xp.asarray(centres[:, 0]))
    boxes = [centres[:, 0] * scale, centres[:, 1] * scale, 0 * one, BOX_HALF * one, BOX_HALF * one]
    half_length = FENCE_HALF_LENGTH * side
    fence = [FENCE[0] * scale, FENCE[1] * scale, 0.0, half_length, FENCE_HALF_WIDTH]
    fence = xp.stack([xp.asarray(value, dtype=xp.float32) for value in fence])
    return xp.where(fenced, fence * one[:, None], xp.stack(boxes, axis=-1))
