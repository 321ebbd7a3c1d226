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
    """A Playground environment of one arena.

    A single policy observes and drives all robots of the arena.

        environment = SwarmMjxEnv(swarmjax.make_env("s1", arenas=1))
        wrap = functools.partial(wrapper.wrap_for_brax_training, full_reset=True)
        ppo.train(environment, wrap_env_fn=wrap, episode_length=environment.episode_length, ...)

    Playground has one agent per environment, and its wrappers map over environments. So an
    observation here joins the observations of all robots, [N O], and an action joins their actions,
    [N 2]. The reward is the sum over robots. A robot that has arrived stands still: it earns 0, and
    its actions are ignored. `done` means that all robots have arrived, or that the physics broke.

    Playground's wrapper handles the time limit, as it does for Playground's own environments. Give
    the wrapper an `episode_length` no larger than that of this class. With `full_reset=True` the
    wrapper draws new levels, but Playground 0.2.0 then ignores time-outs and does not bootstrap
    after them. By default the wrapper repeats the first level of each environment. For a policy
    that controls one robot, use `swarmjax.adapters.brax_env`.

    `state.data` is a `SwarmState`, so `render` is not supported. Use `swarmjax.replay`.
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
        return _state(state, seen, nothing, nothing, metrics, {"is_success": nothing > 0})

    def step(self, state: Any, action: Array) -> Any:
        """Makes a control step.

        Args:
          state: the state before the step.
          action: [N 2] speed and turn rate of each robot, floats, clipped to -1..1.

        Returns:
          The state after the step. Its `metrics["reached"]` is the share of robots that arrived in
          this step. Its `info["is_success"]` says whether the episode ended with all robots at
          their targets.

        Raises:
          ValueError: if the action has a wrong shape or dtype.
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
            info=state.info | {"is_success": came.is_success.all()},
        )

    @property
    def xml_path(self) -> str:
        """Empty, because no XML file holds the model: code builds it."""
        return ""

    @property
    def action_size(self) -> int:
        """Size of the joint action: two numbers per robot."""
        return self.robots.action_size * len(self.robots)

    @property
    def mj_model(self) -> Any:
        """The compiled MuJoCo model."""
        return self.robots.swarm.world.physics.host

    @functools.cached_property
    def mjx_model(self) -> Any:
        """The MuJoCo model on the device. This model is made when it is first asked for."""
        return find("mujoco.mjx", "playground").put_model(self.mj_model)
