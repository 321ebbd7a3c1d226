"""PettingZoo: the robots of one arena as a `pettingzoo.ParallelEnv`."""

from typing import Any

import numpy as np

from swarmjax.adapters.library import check, find
from swarmjax.adapters.robots import line_up_arena
from swarmjax.adapters.session import Session, errors, spaces
from swarmjax.environment import Swarm

_base: Any = find("pettingzoo", "pettingzoo", "ParallelEnv")
_Floats = dict[str, np.ndarray]


class SwarmParallelEnv(_base):
    """A parallel environment with one agent per robot: `robot_0`, `robot_1` and so on.

        env = SwarmParallelEnv(swarmjax.make_env("s1", arenas=1))
        observations, infos = env.reset(seed=0)
        while env.agents:
            actions = {agent: env.action_space(agent).sample() for agent in env.agents}
            observations, rewards, terminations, truncations, infos = env.step(actions)

    A robot that arrives is terminated and leaves `agents`. An arrived robot stays where it is, and
    the other robots drive around it. When the time runs out, the remaining agents are truncated.
    With `task.arrival=hold`, all robots leave `agents` in the same step. When a robot leaves, its
    info has `is_success`, which says whether the robot arrived. The environment never resets
    itself.

    Attributes:
      agents: the robots that are still on their way.
      possible_agents: all robots.
    """

    metadata = {"name": "swarmjax_v0", "render_modes": []}  # noqa: RUF012  # PettingZoo's form

    def __init__(self, swarm: Swarm) -> None:
        """Raises ValueError if the swarm has several arenas."""
        robots = line_up_arena(swarm)
        self._session = Session(robots)
        self._random = np.random.default_rng()
        self.possible_agents = [f"robot_{i}" for i in range(len(robots))]
        self.agents: list[str] = []
        made = {agent: spaces(robots) for agent in self.possible_agents}
        self.observation_spaces = {agent: seen for agent, (seen, _) in made.items()}
        self.action_spaces = {agent: action for agent, (_, action) in made.items()}
        self.render_mode = None

    def observation_space(self, agent: str) -> Any:  # noqa: D102
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:  # noqa: D102
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[_Floats, dict[str, dict[str, Any]]]:
        """Starts an episode.

        Args:
          seed: seed of all following levels. None continues the random numbers of the last seed.
          options: unused.

        Returns:
          [O] observations and empty infos, by agent.
        """
        if seed is not None:
            self._random = np.random.default_rng(seed)
        seen = self._session.reset(int(self._random.integers(2**31)))
        self.agents = list(self.possible_agents)
        return dict(zip(self.agents, seen, strict=True)), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[Any, Any, Any, Any, Any]:
        """Makes a control step.

        Args:
          actions: [2] floats by agent, for every agent in `agents`. Actions of robots that have
            left are ignored.

        Returns:
          Observations [O], rewards, terminations, truncations and infos, each by agent, for the
          agents that acted.

        Raises:
          InvalidAction: if an action is missing, names no agent, or has a wrong shape or dtype.
          ResetNeeded: if no agent is left.
        """
        if not self.agents:
            raise errors.ResetNeeded("No agent is left: call reset first.")
        came = self._session.step(self._stack(actions))
        acted = self.agents
        number = {agent: self.possible_agents.index(agent) for agent in acted}
        ended = came.terminated | came.truncated
        self.agents = [agent for agent in acted if not ended[number[agent]]]
        return (
            {agent: came.last[i] for agent, i in number.items()},
            {agent: float(came.reward[i]) for agent, i in number.items()},
            {agent: bool(came.terminated[i]) for agent, i in number.items()},
            {agent: bool(came.truncated[i]) for agent, i in number.items()},
            {
                agent: {"is_success": bool(came.terminated[i])} if ended[i] else {}
                for agent, i in number.items()
            },
        )

    def close(self) -> None:
        """Ends the session."""
        self.agents = []
        self._session.close()

    def _stack(self, actions: dict[str, Any]) -> np.ndarray:
        """Returns the actions of all robots, [N, U]; 0 for robots that have left."""
        size = self.action_spaces[self.possible_agents[0]].shape[0]
        stacked = np.zeros((len(self.possible_agents), size), np.float32)
        if wrong := (set(self.agents) - set(actions)) | (set(actions) - set(self.possible_agents)):
            raise errors.InvalidAction(f"actions are missing or not expected for {sorted(wrong)}.")
        for agent in self.agents:
            action = np.asarray(actions[agent])
            check(action, (size,), f"{agent}: ", errors.InvalidAction)
            stacked[self.possible_agents.index(agent)] = action
        return stacked
