"""`navigate`: each robot drives to its own target, which may move.

`task.arrival` says when a robot has arrived:

- `latch`: a robot that reaches its target has arrived and stops for good.
- `hold`: a robot counts as arrived while it is at its target, but it keeps driving and may leave.
  An episode is over once all robots are at their targets in the same control step.
  Multi-agent path finding calls this condition "stay at target" (Stern et al. 2019, "Multi-Agent
  Pathfinding: Definitions, Variants, and Benchmarks").
"""

import math
from typing import Any

from swarmjax.sim import noise
from swarmjax.sim.noise import Stream
from swarmjax.task.config import Arrival
from swarmjax.task.goals.goal import Goal, GoalSizes, Turn
from swarmjax.task.level import Level
from swarmjax.task.observation import View

Array = Any


class Navigate(Goal):
    """Every robot has a target that stays where it is."""

    moves = False

    def __init__(self, sizes: GoalSizes, arrival: Arrival = "latch") -> None:
        super().__init__(sizes)
        self.ends = "all" if arrival == "hold" else "each"


class Moving(Navigate):
    """Targets drive straight on at one speed, and bounce off the walls. Boxes don't stop them."""

    moves = True

    def begin(self, level: Level) -> tuple[Array, Array]:
        """Draws the velocities [..., R, 2], m/s; see `Goal.begin`."""
        xp, robots = level.target.__array_namespace__(), level.target.shape[-2]
        angle = noise.uniform(level.seed, 0, Stream.TARGET_COURSE, (robots,), xp)
        angle = angle * (2.0 * math.pi)
        course = xp.stack([xp.cos(angle), xp.sin(angle)], axis=-1)
        return course * self.sizes.target_speed, level.target

    def advance(self, state: Array, level: Level, view: View) -> Turn:
        """Moves the targets; see `Goal.advance`."""
        xp = level.target.__array_namespace__()
        turn = super().advance(state, level, view)
        moved = level.target + state * self.sizes.control_step
        # A target turns back where a robot could not follow.
        most = (level.side / 2.0 - self.sizes.hull_radius)[..., None, None]
        velocity = xp.where(xp.abs(moved) > most, -xp.sign(moved) * xp.abs(state), state)
        target = xp.where(view.present[..., None], xp.clip(moved, -most, most), level.target)
        return turn._replace(state=velocity, target=target)
