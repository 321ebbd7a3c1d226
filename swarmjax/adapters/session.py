"""Steps the robots of a swarm from the host with NumPy arrays, for libraries that use NumPy.

All errors have Gymnasium's types, even if PettingZoo or Stable-Baselines3 drives the robots.
"""

from typing import Any

import jax
import numpy as np

from swarmjax.adapters.library import check, find
from swarmjax.adapters.robots import RobotRow, RobotStep
from swarmjax.environment import SwarmState

errors: Any = find("gymnasium.error", "gymnasium")


def spaces(robots: RobotRow) -> tuple[Any, Any]:
    """Makes the Gymnasium spaces for one robot's observation [O] and action [2]."""
    box = find("gymnasium.spaces", "gymnasium").Box
    seen, action = robots.swarm.observation_space, robots.swarm.action_space
    return box(-np.inf, np.inf, seen.shape, np.float32), box(action.low, action.high)


class Session:
    """Steps the robots, and checks that the environment was reset."""

    def __init__(self, robots: RobotRow) -> None:
        self._robots = robots
        self._reset, self._step = jax.jit(robots.swarm.reset), jax.jit(robots.step)
        self._state: SwarmState | None = None

    def reset(self, seed: int) -> np.ndarray:
        """Starts an episode in every arena.

        Args:
          seed: seed of the levels, 0 or more.

        Returns:
          [N, O] observations to act on.
        """
        state: SwarmState = self._reset(jax.random.key(seed))
        self._state = state
        return np.array(self._robots.observe(state))

    def begin(self, action: Any) -> RobotStep:
        """Starts a control step, and does not wait for its end.

        Args:
          action: [N, U] floats, clipped to -1..1.

        Returns:
          The outcome, on the device.

        Raises:
          ResetNeeded: if the environment was never reset, or was closed.
          InvalidAction: if the action has a wrong shape or dtype.
        """
        if self._state is None:
            raise errors.ResetNeeded("step was called before reset: call reset first.")
        action = np.asarray(action)
        shape = (len(self._robots), self._robots.action_size)
        check(action, shape, error=errors.InvalidAction)
        self._state, came = self._step(self._state, action.astype(np.float32))
        return came

    def step(self, action: Any) -> RobotStep:
        """Makes a control step as `begin` does, and returns NumPy arrays that the caller owns."""
        return fetch(self.begin(action))

    def close(self) -> None:
        """Releases the state."""
        self._state = None


def fetch(came: RobotStep) -> RobotStep:
    """Copies the outcome of a step from the device."""
    return RobotStep(*(np.array(each) for each in jax.device_get(came)))
