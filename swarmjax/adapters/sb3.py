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
    """Each robot is an environment of the VecEnv; all share the policy.

        model = PPO("MlpPolicy", SwarmVecEnv(swarmjax.make_env("s1", arenas=16)))
        model.learn(500_000)

    That is what SuperSuit makes of robots that leave, with `black_death`. The robots of an arena
    are done together, when its episode ends. One that has arrived stands until then: its reward is
    0, and what it is told is ignored; its steps stay in the batch. In the last step, `infos` have
    `terminal_observation`, and `TimeLimit.truncated` where the time ran out on the robot's way.
    The observation is then that of the next episode. Absent robots are left out.

    Attributes:
      arena: [N] the arena of each environment.
      valid: [N] whether the robot was on its way in the last step.
    """

    render_mode = None  # the base class overwrites it with itself

    def __init__(self, swarm: Swarm) -> None:
        robots = line_up(swarm)
        self._session = Session(robots)
        self._random = np.random.default_rng()
        self._came: RobotStep | None = None
        self.arena = robots.arena
        self.valid = np.ones(len(robots), bool)
        super().__init__(len(robots), *spaces(robots))

    def reset(self) -> np.ndarray:
        """Starts an episode in every arena, by the seed given to `seed`, if any.

        Returns:
          [N, O] observations.

        Raises:
          ClosedEnvironmentError: of Gymnasium; it was closed.
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
          actions: [N, 2] speed and turn rate, floats; what is beyond -1..1 is clipped.

        Raises:
          InvalidAction: of Gymnasium; the actions have a wrong shape or dtype.
          ResetNeeded: of Gymnasium; it was never reset.
          ClosedEnvironmentError: of Gymnasium; it was closed.
        """
        self._came = self._session.begin(actions)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Waits for the step.

        Returns:
          [N, O] observations, [N] rewards, [N] dones and the infos.

        Raises:
          NoAsyncCallError: of Gymnasium; no step was started.
        """
        self._session.check_open()
        if self._came is None:
            raise errors.NoAsyncCallError("step_wait: call step_async first.", "step")
        came, self._came = fetch(self._came), None
        self.valid = came.valid
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(came.over):
            infos[i] = {
                "terminal_observation": came.last[i],
                "TimeLimit.truncated": bool(came.truncated[i]),
            }
        return came.observation, came.reward, came.over, infos

    def close(self) -> None:
        """Ends the session."""
        self._session.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Reads an attribute, the same for all environments."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raises AttributeError: the environments are one program."""
        raise AttributeError(f"{attr_name} cannot be set: the robots are stepped by one program.")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Raises AttributeError: the environments are one program."""
        raise AttributeError(f"{method_name} cannot be called: one program steps the robots.")

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> Sequence[bool]:
        """None is."""
        return [False for _ in self._get_indices(indices)]
