"""Stable-Baselines3: the robots of all arenas as one `VecEnv`."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from swarmjax.adapters.library import find
from swarmjax.adapters.robots import RobotStep, line_up
from swarmjax.adapters.session import Session, errors, fetch, spaces
from swarmjax.environment import Swarm

_base: Any = find("stable_baselines3.common.vec_env", "sb3", "VecEnv")


class SwarmVecEnv(_base):
    """A VecEnv with one environment per robot. All robots share one policy.

        model = PPO("MlpPolicy", SwarmVecEnv(swarmjax.make_env("s1", arenas=16)))
        model.learn(500_000)

    Robots that have arrived are handled as SuperSuit's `black_death` handles them. All robots of an
    arena are done together, when the arena's episode ends. A robot that has arrived stands still
    until then: its reward is 0, its actions are ignored, and its steps stay in the batch. In the
    last step of the episode, the info of each robot has `terminal_observation`. The info's entry
    `TimeLimit.truncated` says whether the robot ran out of time, and `is_success` whether it
    arrived. The observation that this step returns belongs to the next episode. Absent robots have
    no environment.

    Attributes:
      arena: [N] the arena of each environment.
      valid: [N] whether the robot was on its way in the last step.
    """

    render_mode = None  # the base class reads this attribute and assigns it again

    def __init__(self, swarm: Swarm) -> None:
        robots = line_up(swarm)
        self._session = Session(robots)
        self._random = np.random.default_rng()
        self._came: RobotStep | None = None
        self.arena = robots.arena
        self.valid = np.ones(len(robots), bool)
        super().__init__(len(robots), *spaces(robots))

    def reset(self) -> np.ndarray:
        """Starts an episode in every arena. The method `seed` sets the seed of the levels.

        Returns:
          [N, O] observations.
        """
        if self._seeds[0] is not None:
            self._random = np.random.default_rng(self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self._came = None
        return self._session.reset(int(self._random.integers(2**31)))

    def step_async(self, actions: np.ndarray) -> None:
        """Starts a control step.

        Args:
          actions: [N, 2] speed and turn rate, floats, clipped to -1..1.

        Raises:
          gymnasium.error.InvalidAction: if the actions have a wrong shape or dtype.
          gymnasium.error.ResetNeeded: if the environment was never reset.
        """
        self._came = self._session.begin(actions)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Waits for the step.

        Returns:
          [N, O] observations, [N] rewards, [N] dones and the infos.

        Raises:
          gymnasium.error.NoAsyncCallError: if no step was started.
        """
        if self._came is None:
            raise errors.NoAsyncCallError("step_wait: call step_async first.", "step")
        came, self._came = fetch(self._came), None
        self.valid = came.valid
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(came.over):
            infos[i] = {
                "terminal_observation": came.last[i],
                "TimeLimit.truncated": bool(came.truncated[i]),
                "is_success": bool(came.is_success[i]),
            }
        return came.observation, came.reward, came.over, infos

    def close(self) -> None:
        """Ends the session."""
        self._session.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Reads an attribute, which is the same for all environments."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raises AttributeError, because one program steps all environments."""
        raise AttributeError(f"{attr_name} cannot be set: one program steps all robots.")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Raises AttributeError, because one program steps all environments."""
        raise AttributeError(f"{method_name} cannot be called: one program steps all robots.")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> Sequence[bool]:
        """Returns False for each environment: none is wrapped."""
        return [False for _ in self._get_indices(indices)]
