"""JaxMARL: the robots of one arena as a `MultiAgentEnv`. Use `vmap` for several arenas."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from swarmjax.adapters.library import check, find
from swarmjax.adapters.robots import RobotStep, line_up_arena
from swarmjax.environment import Swarm, SwarmState

_base: Any = find("jaxmarl.environments.multi_agent_env", "jaxmarl", "MultiAgentEnv")
_box: Any = find("jaxmarl.environments.spaces", "jaxmarl", "Box")
_ByAgent = dict[str, Array]


class SwarmMultiAgentEnv(_base):
    """A JaxMARL environment with one agent per robot: `agent_0`, `agent_1` and so on.

        env = SwarmMultiAgentEnv(swarmjax.make_env("s1", arenas=1))
        observations, state = jax.vmap(env.reset)(jax.random.split(key, 64))
        observations, state, rewards, dones, info = jax.vmap(env.step)(keys, state, actions)

    A robot that arrives is done. The episode ends, and `__all__` is done, when all robots are done
    or the time runs out. Until then an arrived robot stands still: its reward is 0, `info["valid"]`
    is False, and none of its actions is available. `info` has arrays [N] over agents: `valid`,
    `terminated` (the robot arrived in this step), `truncated` (it ran out of time) and `is_success`
    (the episode ended and the robot had arrived). `step` starts the next episode automatically.
    """

    def __init__(self, swarm: Swarm) -> None:
        """Raises ValueError if the swarm has several arenas."""
        self.robots = line_up_arena(swarm)
        super().__init__(num_agents=len(self.robots))
        seen, action = swarm.observation_space, swarm.action_space
        endless = _box(-jnp.inf, jnp.inf, seen.shape)
        bounded = _box(action.low, action.high, action.shape)
        self.observation_spaces = dict.fromkeys(self.agents, endless)
        self.action_spaces = dict.fromkeys(self.agents, bounded)

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """Classes of agents: all are robots of one kind."""
        return {"robot": self.agents}

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: Array) -> tuple[_ByAgent, SwarmState]:
        """Starts an episode, and returns [O] observations by agent and the state."""
        state = self.robots.swarm.reset(key)
        return self.get_obs(state), state

    @partial(jax.jit, static_argnums=0)
    def step(
        self,
        key: Array,
        state: SwarmState,
        actions: _ByAgent,
        reset_state: SwarmState | None = None,
    ) -> tuple[_ByAgent, SwarmState, _ByAgent, _ByAgent, _ByAgent]:
        """Makes a control step, and starts the next episode if this one ends.

        Args:
          key: unused; the state has its own key.
          state: the state before the step.
          actions: [2] floats by agent, clipped to -1..1.
          reset_state: the state from which the next episode starts. With None, the next episode
            has a new level.

        Returns:
          The observations [O] by agent, the state after the step, the rewards and the dones by
          agent, and the info. If `__all__` is done, the observations belong to the next episode.

        Raises:
          ValueError: if an action is missing, or has a wrong shape or dtype.
        """
        given = reset_state is not None
        state, came = self.robots.step(state, self._stack(actions), resets=not given)
        if given:
            state = jax.tree.map(partial(jnp.where, came.over[0]), reset_state, state)
        return self.get_obs(state), state, *self._outcome(came)

    def step_env(
        self, key: Array, state: SwarmState, actions: _ByAgent
    ) -> tuple[_ByAgent, SwarmState, _ByAgent, _ByAgent, _ByAgent]:
        """Makes a step as `step` does, but does not start the next episode."""
        state, came = self.robots.step(state, self._stack(actions), resets=False)
        return self.get_obs(state), state, *self._outcome(came)

    def _outcome(self, came: RobotStep) -> tuple[_ByAgent, _ByAgent, _ByAgent]:
        """Returns the rewards and the dones by agent, and the info."""
        names = ("valid", "terminated", "truncated", "is_success")
        info = {name: getattr(came, name) for name in names}
        dones = self._by_agent(_is_done(came)) | {"__all__": came.over[0]}
        return self._by_agent(came.reward), dones, info

    def get_obs(self, state: SwarmState) -> _ByAgent:
        """Returns the [O] observations by agent."""
        return self._by_agent(self.robots.observe(state))

    def get_avail_actions(self, state: SwarmState) -> _ByAgent:
        """Returns for each agent which of its actions [U] are available: none after its arrival."""
        arrived = state.arenas.arrived[0, self.robots.index]
        free = self.robots.swarm.world.goal.drives(arrived)
        return self._by_agent(jnp.repeat(free[:, None], self.robots.action_size, axis=1))

    def _by_agent(self, x: Array) -> _ByAgent:
        return {agent: x[i] for i, agent in enumerate(self.agents)}

    def _stack(self, actions: _ByAgent) -> Array:
        """Returns the actions of all agents, [N, U]."""
        if missing := sorted(set(self.agents) - set(actions)):
            raise ValueError(f"actions lack {missing}: give an action for each agent.")
        for agent in self.agents:
            check(actions[agent], (self.robots.action_size,), f"{agent}: ")
        return jnp.stack([actions[agent] for agent in self.agents])


def _is_done(came: RobotStep) -> Array:
    """Returns, for each robot [N], whether it is done: it has arrived, or has run out of time."""
    return came.terminated | came.truncated | ~came.valid | came.over
