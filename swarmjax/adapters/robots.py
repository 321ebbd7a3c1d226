"""Lists the robots of all arenas along one axis, for libraries with one agent per environment.

Axes: A arenas, R robots of an arena, O observation, N present robots of all arenas together.
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
      observation: [N, O] the observation to act on. Where `over` is True, this observation belongs
        to the next episode.
      last: [N, O] the observation after the step, before any reset.
      reward: [N] the reward; 0 for robots that had already arrived.
      terminated: [N] whether the robot arrived in this step.
      truncated: [N] whether the robot ran out of time.
      valid: [N] whether the robot was on its way. Learn only from steps where this is True.
      over: [N] whether the episode of the robot's arena ended.
    """

    observation: Any
    last: Any
    reward: Any
    terminated: Any
    truncated: Any
    valid: Any
    over: Any

    @property
    def is_success(self) -> Any:
        """[N] whether the robot's episode ended in this step with the robot at its target."""
        return self.over & ~self.truncated


@dataclass(frozen=True, eq=False)
class RobotRow:
    """The robots of all arenas along one axis, without absent robots.

    Attributes:
      swarm: the result of `swarmjax.make_env`.
      index: [N] indices of the present robots among the A * R places for robots, ascending.
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
        """Size of a robot's action, U."""
        return self.swarm.action_space.shape[0]

    def observe(self, state: SwarmState) -> Array:
        """Returns the [N, O] observations to act on."""
        return self._gather(state.observation)

    def step(
        self, state: SwarmState, action: Array, *, resets: bool = True
    ) -> tuple[SwarmState, RobotStep]:
        """Steps all arenas once. An arena whose episode ends starts its next episode.

        Args:
          state: the state before the step.
          action: [N, U] actions, clipped to -1..1; -1 and 1 are the ends of the range of commands.
          resets: whether episodes that end are followed by the next ones.

        Returns:
          The state after the step, and the outcome for each robot.
        """
        arenas, robots = self.swarm.num_arenas, self.swarm.num_robots
        places = jnp.zeros((arenas * robots, self.action_size)).at[self.index].set(action)
        move = self.swarm.step if resets else self.swarm.step_without_reset
        state, came = move(state, places.reshape(arenas, robots, -1))
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
        """Selects the present robots, from [A, R, ...] to [N, ...]."""
        return x.reshape(-1, *x.shape[2:])[self.index]


def line_up(swarm: Swarm) -> RobotRow:
    """Lists the present robots of a swarm. Arena i plays stage i modulo the number of stages."""
    stage = np.arange(swarm.num_arenas) % len(swarm.stages.robots)
    present = np.arange(swarm.num_robots) < np.asarray(swarm.stages.robots)[stage][:, None]
    return RobotRow(swarm, np.flatnonzero(present))


def line_up_arena(swarm: Swarm) -> RobotRow:
    """Lists the present robots of a swarm with one arena.

    Raises:
      ValueError: if the swarm has more than one arena.
    """
    if swarm.num_arenas != 1:
        raise ValueError(
            f"arenas is {swarm.num_arenas}, but this adapter steps a single arena: give arenas=1."
        )
    return line_up(swarm)
