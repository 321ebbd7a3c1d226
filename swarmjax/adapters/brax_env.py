"""Brax: the robots of all arenas as a `brax.envs.base.Env`, for training with Brax's PPO."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from swarmjax.adapters.library import check, find
from swarmjax.adapters.robots import line_up
from swarmjax.environment import Swarm

_base: Any = find("brax.envs.base", "brax")


class SwarmBraxEnv(_base.Env):
    """Each robot is one Brax environment, and all robots share one policy.

        environment = SwarmBraxEnv(swarmjax.make_env("s1", arenas=64))
        with mended_jax():
            ppo.train(
                environment, wrap_env=False, num_envs=environment.num_envs,
                num_eval_envs=environment.num_envs, max_devices_per_host=1, ...
            )

    Use `wrap_env=False`, because this class already maps and restarts the arenas. When an episode
    ends, the returned observation belongs to the next episode. Brax's evaluator ends a robot's
    episode when the robot arrives. The evaluator's metric `eval/episode_reached` is the share of
    targets reached. `info["is_success"]` is True in the step in which a robot arrives.

    A robot that has arrived waits for the others, and nothing must be learned from its transitions
    while it waits. Brax cannot mask transitions, so this class marks these transitions as
    truncated. Marked transitions stay in Brax's batch without value error, and with the advantage
    0. Brax then normalises advantages, which makes this one the negative mean of the batch, in
    units of its standard deviation. Marked transitions also stay in Brax's statistics of
    observations and in its entropy bonus. Absent robots have no Brax environment.
    """

    def __init__(self, swarm: Swarm) -> None:
        self.robots = line_up(swarm)

    @property
    def num_envs(self) -> int:
        """Number of robots in all arenas, N."""
        return len(self.robots)

    @property
    def observation_size(self) -> int:
        """Size of a robot's observation, O."""
        return self.robots.swarm.observation_space.shape[0]

    @property
    def action_size(self) -> int:
        """Size of a robot's action."""
        return self.robots.action_size

    @property
    def backend(self) -> str:
        """Name of the backend, which must be a name that Brax knows."""
        return "mjx"

    def reset(self, rng: Array) -> Any:
        """Starts an episode in every arena, and returns Brax's state with fields [N, ...].

        Args:
          rng: [N, 2] random keys. Only the first one is used.

        Raises:
          ValueError: if there are not N keys.
        """
        if len(rng) != self.num_envs:
            raise ValueError(f"num_envs is {len(rng)}: give {self.num_envs}, the number of robots.")
        now, zero = self.robots.swarm.reset(rng[0]), jnp.zeros(self.num_envs)
        info = dict.fromkeys(("truncation", "episode_done", "steps"), zero)
        info |= {"is_success": jnp.zeros(self.num_envs, bool), "episode_metrics": {}}
        seen, metrics = self.robots.observe(now), {"reached": zero}
        return _base.State(now, seen, zero, zero, metrics, info)

    def step(self, state: Any, action: Array) -> Any:
        """Makes a control step, and returns the state after it.

        Args:
          state: the state before the step.
          action: [N, U] floats, clipped to -1..1.

        Raises:
          ValueError: if the action has a wrong shape or dtype.
        """
        check(action, (self.num_envs, self.action_size))
        steps = state.pipeline_state.arenas.clock[self.robots.arena] + 1.0
        now, came = self.robots.step(state.pipeline_state, action)
        idle = came.truncated | ~came.valid
        done = jnp.float32(came.terminated | idle)
        noted = {"truncation": jnp.float32(idle), "episode_done": done, "steps": steps}
        return state.replace(
            pipeline_state=now,
            obs=came.observation,
            reward=came.reward,
            done=done,
            metrics={"reached": jnp.float32(came.terminated)},
            info=state.info | noted | {"is_success": came.terminated},
        )


def mended_jax() -> AbstractContextManager:
    """Restores the function `jax.device_put_replicated` in a `with` block.

    Brax 0.14.2 calls this function, but JAX 0.10 has removed it. The function put one copy of an
    array on each device, stacked along a new axis.
    """

    def replicate(tree: Any, devices: Sequence[Any]) -> Any:
        copy = jax.pmap(lambda _, one: one, axis_name="i", in_axes=(0, None), devices=devices)
        return copy(np.arange(len(devices)), tree)

    return mock.patch.object(jax, "device_put_replicated", replicate, create=True)
