"""Gymnasium: the robots of all arenas as one `gymnasium.vector.VectorEnv`."""

from typing import Any

import numpy as np

from swarmjax.adapters.library import find
from swarmjax.adapters.robots import line_up
from swarmjax.adapters.session import Session, spaces
from swarmjax.environment import Swarm

_vector: Any = find("gymnasium.vector", "gymnasium")
_modes: Any = find("gymnasium.vector", "gymnasium", "AutoresetMode")
_batch_space: Any = find("gymnasium.vector.utils", "gymnasium", "batch_space")


class SwarmVectorEnv(_vector.VectorEnv):
    """A vector environment with one sub-environment per robot. All robots may share one policy.

        envs = SwarmVectorEnv(swarmjax.make_env("s1", arenas=64))
        observation, info = envs.reset(seed=0)
        observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())

    The sub-environments of an arena all end together, when the arena's episode ends. A robot that
    has arrived stands still until then: its reward is 0, `info["valid"]` is False, and its actions
    are ignored. An arrived robot is `terminated` in the last step of the episode. Robots that ran
    out of time are `truncated` in that step.

    Autoreset is `SAME_STEP`. When an episode ends, the returned observation belongs to the next
    episode, and `info["final_obs"]` holds the last observation of the old one.
    `info["final_info"]["is_success"]` says which robots arrived. Absent robots have no
    sub-environment.

    Attributes:
      arena: [N] the arena of each sub-environment.
    """

    metadata = {  # noqa: RUF012  # Gymnasium's form
        "autoreset_mode": _modes.SAME_STEP,
        "render_modes": [],
    }

    def __init__(self, swarm: Swarm) -> None:
        robots = line_up(swarm)
        self._session = Session(robots)
        self.arena = robots.arena
        self.num_envs = len(robots)
        self.single_observation_space, self.single_action_space = spaces(robots)
        self.observation_space = _batch_space(self.single_observation_space, self.num_envs)
        self.action_space = _batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode in every arena.

        Args:
          seed: seed of all following levels. None continues the random numbers of the last seed.
          options: unused, because arenas reset themselves.

        Returns:
          [N, O] observations, and an empty info.
        """
        super().reset(seed=seed)
        return self._session.reset(int(self.np_random.integers(2**31))), {}

    def step(
        self, actions: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Makes a control step.

        Args:
          actions: [N, 2] speed and turn rate, floats, clipped to -1..1.

        Returns:
          Observations [N, O]; rewards, terminations and truncations, each [N]; and the info.

        Raises:
          InvalidAction: if the actions have a wrong shape or dtype.
          ResetNeeded: if the environment was never reset.
        """
        came = self._session.step(actions)
        every = np.ones(self.num_envs, bool)
        info: dict[str, Any] = {"valid": came.valid, "_valid": every}
        if came.over.any():
            final = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(came.over):
                final[i] = came.last[i]
            ended = {"valid": came.valid & came.over, "is_success": came.is_success}
            ended |= dict.fromkeys(("_valid", "_is_success"), came.over)
            info |= {"final_obs": final, "_final_obs": came.over}
            info |= {"final_info": ended, "_final_info": came.over}
        reward = came.reward.astype(np.float64)  # as in Gymnasium's own vector environments
        return came.observation, reward, came.is_success, came.truncated, info

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the session. `close` calls this method."""
        self._session.close()
