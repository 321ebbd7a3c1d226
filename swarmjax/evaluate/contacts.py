"""The contacts of robots that MuJoCo's C engine finds."""

import numpy as np

from swarmjax.evaluate.judge import Judge
from swarmjax.sim import gaps


def touching(judge: Judge, data: np.ndarray) -> np.ndarray:
    """Finds which robots touch another robot, an obstacle or a wall.

    Args:
      judge: Data that the arenas share.
      data: [A] of `MjData`, positions up to date.

    Returns:
      [A, R, 3] bool, in the order of `gaps.KINDS`.
    """
    touches = np.zeros((len(data), judge.spacing.robots, len(gaps.KINDS)), bool)
    geoms = [each.contact.geom for each in data]
    arena = np.repeat(np.arange(len(data)), [len(each) for each in geoms])
    first, second = np.concatenate(geoms).T
    for mine, other in ((first, second), (second, first)):
        rows = np.flatnonzero(judge.geom_robot[mine] >= 0)
        robot, kind = judge.geom_robot[mine[rows]], judge.geom_kind[other[rows]]
        touches[arena[rows], robot, kind] = True
    return touches
