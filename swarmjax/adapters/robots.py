"""The robots of all arenas in a row, as libraries for one agent an environment want them.

Axes: A arenas, R robots of an arena, O observation, N robots that take part, of all arenas.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from swarmjax.environment import Swarm, SwarmState


class RobotStep(NamedTuple):
    """The outcome of a control step, robot by robot.

    Attributes:
      observation: [N, O] act on this: of the next episode where `over`.
      last: [N, O] the observation after the step, before any reset.
      reward: [N] 0 for robots that had arrived and stand.
      terminated: [N] the robot arrived in this step.
      truncated: [N] the time ran out on its way.
      valid: [N] the robot was on its way: learn from these.
      over: [N] the episode of the robot's arena ended.
    """

    observation: Any
    last: Any
    reward: Any
    terminated: Any
    truncated: Any
    valid: Any
    over: Any


@dataclass(frozen=True, eq=False)
class RobotRow:
    """The robots of a swarm, without the places of absent ones.

    Attributes:
      swarm: of `swarmjax.make_env`.
      index: [N] of the places [A R] where there is a robot, ascending.
    """

    swarm: Swarm
    index: np.ndarray

    def __len__(self) -> int:
        return len(self.index)

    @property
    def arena(self) -> np.ndarray:
        """[N] the arena of each robot."""
        return self.index // self.swarm.num_robots

    @property
    def action_size(self) -> int:
        """Numbers of one robot's action, U: the command, then what it broadcasts, if it does."""
        return self.swarm.world.action_size

    def observe(self, state: SwarmState) -> Array:
        """[N, O] what to act on."""
        return self._gather(state.observation)

    def step(self, state: SwarmState, action: Array) -> tuple[SwarmState, RobotStep]:
        """Moves all arenas on by one control step; those whose episode ends start another.

        Args:
          state: before.
          action: [N, U], -1..1 spans the commands; what is beyond is clipped.

        Returns:
          The state after, and the outcome.
        """
        arenas, robots = self.swarm.num_arenas, self.swarm.num_robots
        places = jnp.zeros((arenas * robots, self.action_size)).at[self.index].set(action)
        state, came = self.swarm.step(state, places.reshape(arenas, robots, -1))
        return state, RobotStep(
            observation=self.observe(state),
            last=self._gather(came.observation),
            reward=self._gather(came.reward),
            terminated=self._gather(came.terminated),
            truncated=self._gather(came.truncated),
            valid=self._gather(came.valid),
            over=came.done[self.arena],
        )

    def _gather(self, x: Array) -> Array:
        """[A, R, ...] to [N, ...]."""
        return x.reshape(-1, *x.shape[2:])[self.index]


def line_up(swarm: Swarm) -> RobotRow:
    """Lists the robots of a swarm; arena i plays stage i modulo their number."""
    stage = np.arange(swarm.num_arenas) % len(swarm.stages.robots)
    present = np.arange(swarm.num_robots) < np.asarray(swarm.stages.robots)[stage][:, None]
    return RobotRow(swarm, np.flatnonzero(present))


def line_up_arena(swarm: Swarm) -> RobotRow:
    """Lists the robots of a swarm of one arena.

    Raises:
      ValueError: there are more arenas.
    """
    if swarm.num_arenas != 1:
        raise ValueError(
            f"arenas is {swarm.num_arenas}, but this adapter steps one: make_env(..., arenas=1)."
        )
    return line_up(swarm)
