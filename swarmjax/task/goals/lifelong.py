"""`lifelong`: a robot that reaches its target gets another one, until the time is out.

This is lifelong multi-agent path finding (Ma et al. 2017, "Lifelong Multi-Agent Path Finding for
Online Pickup and Delivery Tasks"). A robot has arrived once it has reached its first target.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from swarmjax.sim import noise
from swarmjax.sim.noise import Stream
from swarmjax.task.goals.goal import Goal, Measure, Turn
from swarmjax.task.level import Level
from swarmjax.task.observation import View

Array = Any


class Errands(NamedTuple):
    """The places that robots are sent to, and how many targets they have reached.

    Attributes:
      start: [..., R, 2] the starts of the level, m. Robots are sent to the starts and targets of
        the level, since all of them can be reached.
      target: [..., R, 2] the targets of the level, m.
      taken: [..., R] index of each robot's target; 2 i is robot i's own target, and
        2 i + 1 its start.
      count: [..., R] targets reached.
    """

    start: Array
    target: Array
    taken: Array
    count: Array


class Lifelong(Goal):
    """Every robot is sent from place to place; no two robots have the same place at a time."""

    ends = "never"
    measures: Mapping[str, Measure] = {
        "targets_per_minute": Measure("targets a minute, each robot", "", is_good=True)
    }

    def begin(self, level: Level) -> tuple[Errands, Array]:
        """Begins with the level's own targets; see `Goal.begin`."""
        xp = level.target.__array_namespace__()
        taken = xp.broadcast_to(2 * xp.arange(level.target.shape[-2]), level.present.shape)
        none = xp.zeros_like(taken)
        return Errands(level.start[..., :2], level.target, taken, none), level.target

    def advance(self, state: Errands, level: Level, view: View) -> Turn:
        """Sends the robots that are at their targets to free places; see `Goal.advance`."""
        xp = level.target.__array_namespace__()
        reached = view.present & self.is_near(view)
        robots = level.target.shape[-2]
        pairs = xp.stack([state.target, state.start], axis=-2)
        place = pairs.reshape(*pairs.shape[:-3], 2 * robots, 2)
        number = xp.arange(2 * robots)
        is_taken = (state.taken[..., None] == number).any(axis=-2)
        there = xp.repeat(view.present, 2, axis=-1)
        # The random numbers of a robot's two places do not depend on how many robots there are.
        drawn = noise.uniform(level.seed, view.clock, Stream.NEXT_TARGET, (2 * robots,), xp)
        # Free places come first, in random order. The k-th robot that arrives takes the k-th place.
        order = xp.argsort(xp.where(there & ~is_taken, drawn, 2.0), axis=-1, stable=True)
        rank = xp.maximum(xp.cumsum(reached, axis=-1) - 1, 0)
        taken = xp.where(reached, xp.take_along_axis(order, rank, axis=-1), state.taken)
        target = xp.where(
            reached[..., None],
            xp.take_along_axis(place, taken[..., None], axis=-2),
            level.target,
        )
        count = state.count + reached
        minutes = view.clock * self.sizes.control_step / 60.0
        share = count.sum(axis=-1) / view.present.sum(axis=-1)
        return Turn(
            state=state._replace(taken=taken, count=count),
            target=target,
            arrived=count > 0,
            earns=reached,
            measured={"targets_per_minute": share / minutes},
        )
