"""The task of swarmjax as an environment of Brax, for Brax's own PPO to train on.

Brax knows one agent an environment, so each robot is one of its environments: what it calls
`num_envs` is arenas times robots, and `wrap_env=False`, since arenas are mapped and restarted
here, exactly as in `rollout`: an arena whose episode ends takes the fresh level that waits for it,
and new ones are drawn once a rollout. The physics' data is carried from step to step.

Brax has no mask for transitions that nothing is to be learned from, those of a robot that has
arrived and waits for the others. They are marked as truncated, which makes Brax give them no
advantage and no value error; they stay in its batch.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State
from flax import struct
from jax import Array

from swarmjax.curriculum.engine import Schedule
from swarmjax.sim import physics
from swarmjax.task import env
from swarmjax.task.env import EnvState, TimeStep
from swarmjax.training import program as programs
from swarmjax.training import rollout
from swarmjax.training.program import Program


@struct.dataclass
class BraxArenas:
    """What Brax carries as `pipeline_state`.

    Attributes:
      now: [A] the arenas, `sim` the physics' data.
      starts: [W A] episodes that wait, packed.
      begun: [A] episodes that each arena has begun since they were drawn.
      key: random key of the next draw.
      clock: [] control steps since the start, int32.
    """

    now: EnvState
    starts: EnvState
    begun: Array
    key: Array
    clock: Array


class SwarmEnv(Env):
    """All arenas of a world, a robot an environment.

    Attributes:
      program: the compiled side.
      schedule: with the stages, of which the first is played.
    """

    def __init__(self, program: Program, schedule: Schedule) -> None:
        self.program, self.world, self.stages = program, program.world, schedule.stages

    @property
    def observation_size(self) -> int:
        """Numbers that a robot observes."""
        return self.world.observation_size

    @property
    def action_size(self) -> int:
        """Numbers that a robot is commanded with."""
        return programs.ACTION_SIZE

    @property
    def backend(self) -> str:
        """Brax asks; it simulates nothing itself."""
        return "mjx"

    def reset(self, rng: Array) -> State:
        """Starts all arenas.

        Args:
          rng: [A R, 2] random keys, the first of which is used.

        Returns:
          The state, its fields [A R, ...].
        """
        key, level_key = jax.random.split(rng[0])
        arenas = self.program.config.arenas
        drawn = self._draw(level_key, 1 + self._waiting)
        now = jax.tree.map(lambda x: x[:arenas], drawn)
        starts = jax.tree.map(lambda x: x[arenas:], drawn)
        unpack = partial(physics.unpack, self.world.physics)
        inner = BraxArenas(
            now=replace(now, sim=jax.vmap(unpack)(now.sim)),
            starts=starts,
            begun=jnp.zeros(arenas, jnp.int32),
            key=key,
            clock=jnp.zeros((), jnp.int32),
        )
        nothing = jnp.zeros(arenas * self.program.config.sim.max_robots)
        return _state(inner, nothing, nothing, nothing)

    def step(self, state: State, action: Array) -> State:
        """Moves all arenas on by one control step.

        Args:
          state: before.
          action: [A R, 2].

        Returns:
          The state after; where an arena began anew, it is observed there.
        """
        inner: BraxArenas = state.pipeline_state  # pyright: ignore[reportAssignmentType]  # ours
        arenas, robots = inner.now.arrived.shape
        moved, came = jax.vmap(partial(env.step, self.world))(
            inner.now, action.reshape(arenas, robots, -1)
        )
        index = jnp.minimum(inner.begun, self._waiting - 1) * arenas + jnp.arange(arenas)
        starts = jax.tree.map(lambda x: x[index], inner.starts)
        moved = rollout.restart(moved, starts, came.done)
        begun, clock = inner.begun + came.done, inner.clock + 1
        inner = self._refill(replace(inner, now=moved, begun=begun, clock=clock))
        return _state(inner, came.reward.ravel(), *_ends(came))

    @property
    def _waiting(self) -> int:
        return self.program.config.waiting

    def _draw(self, key: Array, each: int) -> EnvState:
        """Draws so many fresh episodes for each arena, packed."""
        index = jnp.zeros((each, self.program.config.arenas), jnp.int32)
        return rollout.draw_starts(self.world, self.stages, index, jnp.int32(0), key)

    def _refill(self, inner: BraxArenas) -> BraxArenas:
        """Draws the episodes that wait anew, once a rollout."""
        begun, (next_key, key) = inner.begun, jax.random.split(inner.key)

        def draw(inner: BraxArenas) -> BraxArenas:
            starts = self._draw(key, self._waiting)
            return replace(inner, starts=starts, begun=jnp.zeros_like(begun), key=next_key)

        due = inner.clock % self.program.config.algo.rollout_length == 0
        return jax.lax.cond(due, draw, lambda inner: inner, inner)


def _ends(came: TimeStep) -> tuple[Array, Array]:
    """Where a robot's way ended or none was made, and where Brax is to learn nothing, [A R]."""
    idle = came.truncated | ~came.valid
    ended, cut = came.terminated | idle, idle
    return ended.ravel().astype(jnp.float32), cut.ravel().astype(jnp.float32)


def _state(inner: BraxArenas, reward: Array, done: Array, truncation: Array) -> State:
    """What Brax sees of a step."""
    info: dict[str, Any] = {
        "truncation": truncation,
        "episode_done": done,
        "episode_metrics": {},
    }
    seen = inner.now.observation
    return State(
        pipeline_state=inner,  # pyright: ignore[reportArgumentType]  # any tree will do
        obs=seen.reshape(-1, seen.shape[-1]),
        reward=reward,
        done=done,
        metrics={},
        info=info,
    )
