"""A scene worked out by hand for `task.arrival=hold`: one robot passes through its target."""

import numpy as np

from swarmjax.task.level import Level

PACE = 0.1256 * 0.032  # m per control step at full speed, 4.0192 mm.
AHEAD, LEFT, STILL = (1.0, 0.0), (-1.0, 1.0), (-1.0, 0.0)  # actions

# Robot 0 drives ahead through its target, which is 60 mm away and has a radius of 50 mm. The robot
# is within its target from step 3 (47.9 mm from the centre) to step 27 (48.5 mm beyond the centre),
# and outside from step 28 on (52.5 mm). It stops after 30 steps, 60.6 mm beyond the centre, and
# turns for 31 steps by 31 * 3.14 * 0.032 = 3.115 rad. Then it drives back. It is still outside
# after 2 more steps (52.5 mm), and within its target after the third, which is step 64.
ENTERS, LEAVES, STOPS, TURNED, RETURNS = 3, 28, 30, 61, 64
# Robot 1 drives ahead until it is within its target, after step 40, and stays.
OTHER = 40
TARGETS = ((0.06, 0.0), (0.05 + (OTHER - 0.5) * PACE - 0.2, 0.25))


def level(robots: int = 2, obstacles: int = 0) -> Level:
    """Returns the scene in an arena of 0.8 m; further robots and obstacles are parked outside."""
    parked = [[5.0 + 0.5 * i, 5.0, 0.0] for i in range(2, robots)]
    start = np.array([[0.0, 0.0, 0.0], [-0.2, 0.25, 0.0], *parked], np.float32)
    target = np.array([*TARGETS, *(place[:2] for place in parked)], np.float32)
    box = [[-5.0 - 0.5 * j, -5.0, 0.0, 0.05, 0.05] for j in range(obstacles)]
    return Level(
        side=np.float32(0.8),
        present=np.arange(robots) < 2,
        start=start,
        target=target,
        obstacle_present=np.zeros(obstacles, bool),
        obstacle=np.array(box, np.float32).reshape(obstacles, 5),
        seed=np.uint32(0),
    )


def actions(robots: int = 2, *, drives_on: bool = False) -> np.ndarray:
    """Returns the robots' actions [64, R, 2]; with `drives_on` robot 0 never turns round."""
    found = np.zeros((RETURNS, robots, 2), np.float32) + AHEAD
    if not drives_on:
        found[STOPS:TURNED, 0] = LEFT
    found[OTHER:, 1] = STILL
    return found


def arrived() -> np.ndarray:
    """Returns which robots are within their targets after each step, [64, 2]."""
    step = np.arange(1, RETURNS + 1)
    first = (step >= ENTERS) & (step < LEAVES) | (step >= RETURNS)
    return np.stack([first, step >= OTHER], axis=-1)
