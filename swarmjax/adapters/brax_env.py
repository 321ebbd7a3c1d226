"""Brax: the robots of all arenas as a `brax.envs.base.Env`, for Brax's own PPO to train on."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from swarmjax.adapters.library import check, find
from swarmjax.adapters.robots import line_up
from swarmjax.environment import Swarm

_base: Any = find("brax.envs.base", "brax")
_DROPPED = "device_put_replicated"


class SwarmBraxEnv(_base.Env):
    """Each robot is an environment; all share the policy.

        environment = SwarmBraxEnv(swarmjax.make_env("s1", arenas=64))
        with mended_jax():
            ppo.train(
                environment, wrap_env=False, num_envs=environment.num_envs,
                num_eval_envs=environment.num_envs, max_devices_per_host=1, ...
            )

    `wrap_env=False`, since arenas are mapped and restarted here: where an episode ends, the
    observation is that of the next one. Brax's evaluator takes a robot's episode to end where it
    arrives; its `eval/episode_reached` is the share of targets reached.

    Brax has no mask for transitions that nothing is to be learned from, those of a robot that has
    arrived and waits for the others. They are marked as truncated, which makes Brax give them no
    advantage and no value error; they stay in its batch. Absent robots are left out.
    """

    def __init__(self, swarm: Swarm) -> None:
        self.robots = line_up(swarm)

    @property
    def num_envs(self) -> int:
        """Robots of all arenas, N."""
        return len(self.robots)

    @property
    def observation_size(self) -> int:
        """Numbers that a robot observes, O."""
        return self.robots.swarm.observation_space.shape[0]

    @property
    def action_size(self) -> int:
        """Numbers that a robot is commanded with."""
        return self.robots.action_size

    @property
    def backend(self) -> str:
        """Brax asks for one of its own names."""
        return "mjx"

    def reset(self, rng: Array) -> Any:
        """Starts an episode in every arena; returns Brax's state, its fields [N, ...].

        Args:
          rng: [N, 2] random keys, the first of which is used; else raises ValueError.
        """
        if len(rng) != self.num_envs:
            raise ValueError(f"num_envs is {len(rng)}: give {self.num_envs}, the robots there are.")
        now, zero = self.robots.swarm.reset(rng[0]), jnp.zeros(self.num_envs)
        info = dict.fromkeys(("truncation", "episode_done", "steps"), zero)
        seen, metrics = self.robots.observe(now), {"reached": zero}
        return _base.State(now, seen, zero, zero, metrics, info | {"episode_metrics": {}})

    def step(self, state: Any, action: Array) -> Any:
        """Makes a control step; returns the state after.

        Args:
          state: before.
          action: [N, U] floats; what is beyond -1..1 is clipped.

        Raises:
          ValueError: the action has a wrong shape; TypeError: a wrong dtype.
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
            info=state.info | noted,
        )


@contextlib.contextmanager
def mended_jax() -> Iterator[None]:
    """Gives JAX back `device_put_replicated` for a while, where it lacks it.

    Brax 0.14.2 calls it, and JAX 0.10 has dropped it. It put a copy on each device, stacked.
    """

    def replicate(tree: Any, devices: Sequence[Any]) -> Any:
        copy = jax.pmap(lambda _, one: one, axis_name="i", in_axes=(0, None), devices=devices)
        return copy(np.arange(len(devices)), tree)

    missing = not hasattr(jax, _DROPPED)
    if missing:
        setattr(jax, _DROPPED, replicate)
    try:
        yield
    finally:
        if missing:
            delattr(jax, _DROPPED)
