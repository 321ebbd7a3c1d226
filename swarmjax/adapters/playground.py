"""MuJoCo Playground: one arena as an `MjxEnv`, for Playground's wrappers and Brax's PPO."""

import functools
from typing import Any

import jax.numpy as jnp
from jax import Array

from swarmjax.adapters.library import check, find
from swarmjax.adapters.robots import line_up_arena
from swarmjax.environment import Swarm

_playground: Any = find("mujoco_playground", "playground")
_state: Any = find("mujoco_playground", "playground", "State")
_config: Any = find("ml_collections.config_dict", "playground", "create")


class SwarmMjxEnv(_playground.MjxEnv):
    """One arena is one environment: a single policy sees and drives all of its robots.

        environment = SwarmMjxEnv(swarmjax.make_env("s1", arenas=1))
        wrap = functools.partial(wrapper.wrap_for_brax_training, full_reset=True)
        ppo.train(environment, wrap_env_fn=wrap, episode_length=environment.episode_length, ...)

    Playground has one agent an environment, and its wrappers map it. The observation is that of all
    robots in a row, [N O], and so is the action, [N 2]; the reward is the sum of theirs. A robot
    that has arrived stands and earns 0; what it is told is ignored. `done` says that all have
    arrived, or that the physics broke. That the time ran out is left to Playground's wrapper, as
    in its own environments: give it `episode_length`, no more. `full_reset=True` makes it draw new
    levels, but Playground 0.2.0 then forgets that time ran out, and does not bootstrap; by default
    it repeats the first level of each environment. To train a policy that each robot
    has to itself, take `swarmjax.adapters.brax_env`.

    `state.data` is a `SwarmState`, so `render` is not there: see `swarmjax.replay`.
    """

    def __init__(self, swarm: Swarm) -> None:
        """Raises ValueError if the swarm has several arenas."""
        self.robots = line_up_arena(swarm)
        task, physics = swarm.world.task, swarm.world.physics
        self.episode_length: int = task.step_limit
        settings = {
            "ctrl_dt": task.control_step,
            "sim_dt": task.control_step / physics.substeps,
            "episode_length": task.step_limit,
            "action_repeat": 1,
        }
        super().__init__(_config(**settings))

    def reset(self, rng: Array) -> Any:
        """Starts an episode.

        Args:
          rng: random key.

        Returns:
          Playground's state.
        """
        state, nothing = self.robots.swarm.reset(rng), jnp.zeros(())
        metrics = {"reached": nothing}
        seen = self.robots.observe(state).ravel()
        return _state(state, seen, nothing, nothing, metrics, {})

    def step(self, state: Any, action: Array) -> Any:
        """Makes a control step.

        Args:
          state: before.
          action: [N 2] speed and turn rate of each robot, floats; beyond -1..1 is clipped.

        Returns:
          The state after; `metrics["reached"]` is the share of the robots that arrived in it.

        Raises:
          ValueError: the action has a wrong shape.
          TypeError: the action is of a wrong dtype.
        """
        check(action, (self.action_size,))
        late = state.data.arenas.clock[0] + 1 >= self.episode_length
        now, came = self.robots.step(state.data, action.reshape(-1, self.robots.action_size))
        done = came.over[0] & ~(late & came.truncated.any())
        return state.replace(
            data=now,
            obs=came.observation.ravel(),
            reward=came.reward.sum(),
            done=done.astype(jnp.float32),
            metrics={"reached": came.terminated.mean(dtype=jnp.float32)},
        )

    @property
    def xml_path(self) -> str:
        """None: the model is made by code."""
        return ""

    @property
    def action_size(self) -> int:
        """Those of all robots: two each, and what they broadcast."""
        return self.robots.action_size * len(self.robots)

    @property
    def mj_model(self) -> Any:
        """The compiled model."""
        return self.robots.swarm.world.physics.host

    @functools.cached_property
    def mjx_model(self) -> Any:
        """The model on the device, made when it is first asked for."""
        return find("mujoco.mjx", "playground").put_model(self.mj_model)

    def render(self, *args: Any, **kwargs: Any) -> Any:
        """Raises NotImplementedError."""
        raise NotImplementedError("Pictures are drawn by swarmjax.replay.")
