"""The swarm as an environment: many arenas stepped together by pure functions.

`make_env` creates one. The axes of arrays are A arenas, R robots (as many as the largest stage has)
and O observation entries.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from swarmjax import policy_file
from swarmjax.sim import drive, physics
from swarmjax.task import env, extended, level
from swarmjax.task import stage as task_stage
from swarmjax.task.env import EnvState, TimeStep
from swarmjax.task.stage import Stage
from swarmjax.task.world import World
from swarmjax.training import program as programs
from swarmjax.training import rollout
from swarmjax.training.config import ProgramConfig

# All waiting levels are drawn again when arenas have begun to play this share of them. A draw takes
# about as long for thousands of arenas as for one.
_PLAYED = 1 / 16


class Space(NamedTuple):
    """Description of one robot's observation or action.

    Attributes:
      shape: shape of the array.
      names: names of its entries.
      units: units of its entries.
      low: smallest value of each entry; None if there is no limit.
      high: largest value of each entry; None if there is no limit.
    """

    shape: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    low: np.ndarray | None
    high: np.ndarray | None


@struct.dataclass
class SwarmState:
    """The complete state: a JAX tree to carry through `jit`, `vmap` and `scan`.

    Attributes:
      arenas: [A] the arenas; `arenas.observation` [A, R, O] is the policy's input, and
        `arenas.level` the levels that the episodes started from.
      waiting: [A] the episode that begins next in each arena.
      played: [A] whether the arena has begun the waiting episode since it was drawn.
      key: random key of future levels.
    """

    arenas: EnvState
    waiting: EnvState
    played: Array
    key: Array

    @property
    def observation(self) -> Array:
        """Input of the policy, [A, R, O]. After an episode's end, the next one's first."""
        return self.arenas.observation

    @property
    def present(self) -> Array:
        """[A, R] whether the robot is present."""
        return self.arenas.level.present


@dataclass(frozen=True, eq=False)
class Swarm:
    """An environment of many arenas, created by `make_env`.

    Attributes:
      config: settings of the environment.
      world: the compiled arena.
      stages: [S] the stages; arena i plays stage i modulo S.
    """

    config: ProgramConfig
    world: World
    stages: Stage

    @property
    def num_arenas(self) -> int:
        """Number of arenas, A."""
        return self.config.arenas

    @property
    def num_robots(self) -> int:
        """Robots per arena, R; where a stage has fewer, `state.present` marks the present ones."""
        return self.world.spacing.robots

    @property
    def observation_space(self) -> Space:
        """One robot's observation, [O]."""
        layout = self.world.electronics.layout
        return Space((layout.size,), layout.names, layout.units, None, None)

    @property
    def action_space(self) -> Space:
        """One robot's action, [U]: -1..1 spans the range of the command."""
        ones = np.ones(drive.ACTION_SIZE, np.float32)
        names = policy_file.ACTION_NAMES
        return Space(ones.shape, names, ("1",) * len(names), -ones, ones)

    def pose(self, state: SwarmState) -> Array:
        """Returns poses [A, R, 3]: x (m), y (m), yaw (rad). Absent robots are parked outside."""
        return jax.vmap(partial(physics.poses, self.world.physics))(state.arenas.sim)

    def reset(self, key: Array) -> SwarmState:
        """Starts an episode in every arena.

        Args:
          key: random key, consumed.

        Returns:
          The state; pass its `observation` to the policy.
        """
        key, first, second = jax.random.split(key, 3)
        every = jnp.arange(self.num_arenas)
        return SwarmState(
            arenas=self._draw(first, every),
            waiting=self._draw(second, every),
            played=jnp.zeros(self.num_arenas, bool),
            key=key,
        )

    def step(self, state: SwarmState, action: Array) -> tuple[SwarmState, TimeStep]:
        """Advances all arenas by one control step; an arena whose episode ends starts a new one.

        Where `done` is true, the returned state belongs to the next episode, while the observation
        in the returned outcome is the last one of the old episode. The levels of the next episodes
        are drawn ahead. When a sixteenth of the arenas has begun theirs, all are drawn again. An
        arena that ends two episodes before this plays the same level again. Under `vmap`, levels
        are drawn in every step, which is slow: give `make_env` more arenas instead.

        Args:
          state: the state before the step.
          action: [A, R, U], clipped to -1..1; -1 and 1 are the ends of each command's range.

        Returns:
          The new state, and the outcome of the step: observation [A, R, O], reward, terminated,
          truncated and valid [A, R], done and sound [A].
        """
        arenas, came = self._advance(state.arenas, action)
        arenas = _pack(rollout.restart(arenas, state.waiting, came.done))
        played = state.played | came.done
        next_up = state.waiting, played, state.key
        enough = jnp.mean(played) >= _PLAYED
        next_up = jax.lax.cond(enough, self._redraw, lambda *same: same, *next_up)
        return SwarmState(arenas, *next_up), came

    def step_without_reset(self, state: SwarmState, action: Array) -> tuple[SwarmState, TimeStep]:
        """Advances all arenas as `step` does, but starts no new episodes and draws no levels."""
        arenas, came = self._advance(state.arenas, action)
        return replace(state, arenas=_pack(arenas)), came

    def _advance(self, arenas: EnvState, action: Array) -> tuple[EnvState, TimeStep]:
        unpack = partial(physics.unpack, self.world.physics)
        arenas = replace(arenas, sim=jax.vmap(unpack)(arenas.sim))
        return jax.vmap(partial(env.step, self.world))(arenas, action)

    def _redraw(
        self, waiting: EnvState, played: Array, key: Array
    ) -> tuple[EnvState, Array, Array]:
        """Draws the next episode of every arena again, and returns the new arguments."""
        key, drawn = jax.random.split(key)
        return self._draw(drawn, jnp.arange(self.num_arenas)), jnp.zeros_like(played), key

    def _draw(self, key: Array, arena: Array) -> EnvState:
        """Starts one episode in each of the arenas [N]. The result's `sim` is a `PhysicsState`."""
        spacing, stages = self.world.spacing, jax.tree.map(jnp.asarray, self.stages)
        count = len(self.stages.robots)

        def start(uniform: Array, index: Array) -> EnvState:
            stage = task_stage.select(stages, index % count)
            drawn = extended.draw(uniform, stage, spacing, self.world.drawings)
            return env.reset(self.world, drawn)

        uniforms = jax.random.uniform(key, (len(arena), level.uniform_count(spacing)))
        return jax.vmap(start)(uniforms, arena)


def _pack(arenas: EnvState) -> EnvState:
    return replace(arenas, sim=jax.vmap(physics.pack)(arenas.sim))


def load(config: ProgramConfig) -> Swarm:
    """Builds the environment that a config describes.

    Args:
      config: provides stages, robot, task, realism, simulation, arenas and extensions.

    Returns:
      The environment.

    Raises:
      ConfigError: a piece of an extension does not fit, or `task.world.load` refuses a setting.
    """
    world = programs.load_world(config)
    stages = task_stage.stack(config.stage, world.drawings)
    return Swarm(config=config, world=world, stages=stages)
