"""Rollouts: the learners drive many arenas.

Only this module lays arenas and robots out for the learners: [A, R, ...] becomes [L, A, N, ...],
where N is the number of robots of an arena that one learner drives.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from swarmjax.curriculum.engine import UNCOUNTED, Curriculum, Schedule
from swarmjax.ppo.batch import Batch, Trajectory
from swarmjax.ppo.memory import NO_MEMORY, Recall
from swarmjax.ppo.ppo import PPO, LearnerState
from swarmjax.shards import ALONE, Shards
from swarmjax.sim import drive, physics
from swarmjax.task import env, extended, level
from swarmjax.task import stage as task_stage
from swarmjax.task.env import EnvState
from swarmjax.task.episode import Ended
from swarmjax.task.stage import Stage
from swarmjax.task.world import World
from swarmjax.training import episodes
from swarmjax.training.config import ProgramConfig


@dataclass(frozen=True, eq=False)
class Program[C: ProgramConfig]:
    """The parts that determine the compiled program; `program.py` builds them.

    Attributes:
      config: settings of the program.
      world: the compiled environment.
      ppo: how the learners act and learn.
      curriculum: makes the curriculum for a `Schedule`.
      shards: how the arenas are spread over devices.
      by_robot: whether to report each episode robot by robot.
      waiting: episodes that are drawn for each arena before a rollout.
      rows: largest number of updates of one call.
    """

    config: C
    world: World
    ppo: PPO
    curriculum: Callable[[Schedule], Curriculum]
    shards: Shards
    by_robot: bool = False
    waiting: int = 1
    rows: int = 1


@struct.dataclass
class Arena(EnvState):
    """A training arena, with the stage and cohort of its episode.

    Attributes:
      stage: [] index of the stage on which the episode began, int32.
      cohort: [] the curriculum's cohort in which the episode began, int32.
      recall: memories of each robot's actor and critic before the observation, each [R, H], or ()
        without memory.
    """

    stage: Array
    cohort: Array
    recall: Recall = NO_MEMORY


def to_learners(x: Array, learners: int) -> Array:
    """Lays robots out by learner.

    Args:
      x: [A, R, ...].
      learners: L, 1 or R.

    Returns:
      [L, A, N, ...], N = R / L.
    """
    if learners == 1:
        return x[None]
    return jnp.moveaxis(x, 1, 0)[:, :, None]


def to_arenas(x: Array) -> Array:
    """Undoes `to_learners`.

    Args:
      x: [L, A, N, ...].

    Returns:
      [A, R, ...], R = L N.
    """
    if x.shape[0] == 1:
        return x[0]
    return jnp.moveaxis(x[:, :, 0], 0, 1)


def draw_starts(
    world: World,
    stages: Stage,
    stage: Array,
    cohort: Array,
    key: Array,
    shards: Shards = ALONE,
    memory: Recall = NO_MEMORY,
) -> Arena:
    """Draws the levels of episodes that wait until their arena is free.

    The levels are drawn before a rollout, `program.waiting` for each arena, and not at every step.
    An arena that runs out of levels repeats the last level. The learners also learn from repeats,
    but no cohort counts them: otherwise short episodes would count more often than long ones.

    Args:
      world: the compiled environment.
      stages: [S] stages of the curriculum.
      stage: [W, A] index of the stage of each waiting episode, W for each arena.
      cohort: [] number of the cohort for which the episodes count, int32.
      key: random key for the levels, consumed.
      shards: how the arenas are spread over devices; A is the number of arenas on this device.
      memory: memories of actor and critic as an episode begins, each [R, H], or () without memory.

    Returns:
      [W A] waiting episodes, packed.
    """
    waiting, arenas = stage.shape
    count = level.uniform_count(world.spacing)
    stages = jax.tree.map(jnp.asarray, stages)
    size = (waiting, arenas // shards.local_streams, count)
    uniforms = shards.draw(key, lambda key: jax.random.uniform(key, size), axis=1)

    def start(uniform: Array, index: Array) -> Arena:
        mine = task_stage.select(stages, index)
        drawn = extended.draw(uniform, mine, world.spacing, world.drawings)
        begun = vars(env.reset(world, drawn))
        return Arena(**begun, stage=index, cohort=cohort, recall=memory)

    return jax.vmap(start)(uniforms.reshape(-1, count), stage.astype(jnp.int32).ravel())


def collect(
    program: Program, learners: LearnerState, arenas: Arena, starts: Arena, key: Array
) -> tuple[Arena, Trajectory, Ended]:
    """Drives all arenas for one rollout; an arena whose episode ends begins a waiting episode.

    Args:
      program: the compiled program.
      learners: [L] the learners.
      arenas: [A] the arenas, packed.
      starts: [W A] waiting episodes in the order of `draw_starts`, packed.
      key: random key, consumed; the same on all devices.

    Returns:
      The arenas, packed; the trajectory; the episodes that ended.
    """
    waiting = starts, _value(program, learners, starts)
    step = functools.partial(_step, program, learners, waiting)
    unpack = functools.partial(physics.unpack, program.world.physics)
    arenas = replace(arenas, sim=jax.vmap(unpack)(arenas.sim))
    begun = jnp.zeros_like(arenas.clock)
    carry = (arenas, _value(program, learners, arenas), begun)
    steps = program.config.algo.rollout_length
    keys = jax.random.split(key, steps)
    carry, (trajectory, counts) = jax.lax.scan(step, carry, (keys, 1 + jnp.arange(steps)))
    arenas = carry[0]
    packed = jax.vmap(physics.pack)(arenas.sim)
    return replace(arenas, sim=packed), trajectory, _to_ended(*counts)


def batch(program: Program, trajectory: Trajectory, memory: Recall, ended: Ended) -> Batch:
    """Turns a rollout into the samples of an update.

    Args:
      program: the compiled program.
      trajectory: [T, L, A, N, ...].
      memory: memories of actor and critic before the rollout, each [A, R, H], or () without memory.
      ended: [T, A] episodes that ended in the rollout.

    Returns:
      [L] batches, each of A groups with T * N samples.
    """
    first = jax.tree.map(lambda x: to_learners(x, trajectory.valid.shape[1]), memory)
    each = jax.vmap(program.ppo.batch, in_axes=(1, 0, None))
    return each(trajectory, first, ended.episodes > 0)


class _Valued(NamedTuple):
    """The critics' outputs for the current observations, [L, A, N, ...].

    Attributes:
      value: value of the observation.
      memory: [.., H] the critic's memory after the observation; () without memory.
      state: [.., P], what the critic sees in addition to the observation; () if nothing.
    """

    value: Array
    memory: Any
    state: Any


# The counts of `Ended` that are one number per arena and step.
_COUNTS = (
    *("episodes", "stage", "cohort", "targets", "reached", "all_reached"),
    *("steps", "robot_steps", "sensed", "broken"),
)

# Waiting episodes [W A], packed, and the critics' results for their first observations.
_Waiting = tuple[Arena, _Valued]
_Counts = tuple[Array, Ended]  # counts [A, K]; the other results [A]
_Carry = tuple[Arena, _Valued, Array]  # arenas, critics' results, episodes begun by each arena


def _step(
    program: Program,
    learners: LearnerState,
    waiting: _Waiting,
    carry: _Carry,
    step: tuple[Array, Array],
) -> tuple[_Carry, tuple[Trajectory, _Counts]]:
    """Runs one control step of all arenas; the first step of a rollout has the number 1."""
    (arenas, before, begun), (key, number) = carry, step
    count = before.value.shape[0]
    observation = to_learners(arenas.observation, count)
    noise = _noise(program.shards, key, (*observation.shape[:-1], drive.ACTION_SIZE))
    acting = program.ppo.explore(learners, number * program.config.arenas)
    memory = jax.tree.map(lambda x: to_learners(x, count), arenas.recall.actor)
    action, log_prob, memory = jax.vmap(program.ppo.act)(acting, observation, noise, memory)
    arenas, timestep = jax.vmap(functools.partial(env.step, program.world))(
        arenas, to_arenas(action)
    )
    recall = jax.tree.map(to_arenas, Recall(memory, before.memory))
    arenas = replace(arenas, recall=recall)
    after = _value(program, learners, arenas)
    ended = _ended(arenas, timestep, by_robot=program.by_robot)
    starts, first = _next(waiting, begun)
    arenas = restart(arenas, starts, timestep.done)
    over = jnp.broadcast_to(timestep.done[None, :, None], after.value.shape)
    transition = Trajectory(
        observation=observation,
        action=action,
        log_prob=log_prob,
        value=before.value,
        next_value=after.value,
        reward=to_learners(timestep.reward, count),
        terminated=to_learners(timestep.terminated, count),
        truncated=to_learners(timestep.truncated, count),
        valid=to_learners(timestep.valid, count),
        state=before.state,
    )
    carry = (arenas, _pick(over, first, after), begun + timestep.done)
    return carry, (transition, _to_counts(ended))


def _noise(shards: Shards, key: Array, shape: tuple[int, ...]) -> Array:
    """Draws the noise of actions; `shape` is [L, A, N, U]."""
    learners, arenas, *rest = shape
    size = (learners, arenas // shards.local_streams, *rest)
    return shards.draw(key, lambda key: jax.random.normal(key, size), axis=1)


def _next(waiting: _Waiting, begun: Array) -> tuple[Arena, _Valued]:
    """Picks the next episode [A] of each arena, and the critics' results for it."""
    (starts, first), arenas = waiting, begun.shape[0]
    count = starts.cohort.shape[0] // arenas
    if count > 1:
        index = jnp.minimum(begun, count - 1) * arenas + jnp.arange(arenas)
        starts = jax.tree.map(lambda x: x[index], starts)
        first = jax.tree.map(lambda x: x[:, index], first)
    return replace(starts, cohort=jnp.where(begun < count, starts.cohort, UNCOUNTED)), first


def _value(program: Program, learners: LearnerState, arenas: Arena) -> _Valued:
    """Computes the critics' outputs for the current observations of arenas [A]."""
    count, state = jax.tree.leaves(learners)[0].shape[0], ()
    memory = jax.tree.map(lambda x: to_learners(x, count), arenas.recall.critic)
    if program.ppo.sizes.state:
        around = jax.vmap(functools.partial(env.look_around, program.world))(arenas)
        state = to_learners(around, count)
    seen = to_learners(arenas.observation, count)
    value, memory = jax.vmap(program.ppo.value)(learners, seen, state, memory)
    return _Valued(value, memory, state)


def restart[S: EnvState](arenas: S, starts: S, done: Array) -> S:
    """Replaces episodes that are over with waiting ones.

    Args:
      arenas: [A] arenas, not packed: their `sim` holds all data of the physics.
      starts: [A] waiting episodes, packed.
      done: [A] whether the arena's episode is over.

    Returns:
      The arenas; in their `sim`, only the physical state has been replaced.
    """
    packed = physics.PhysicsState(arenas.sim.qpos, arenas.sim.qvel, arenas.sim.qacc_warmstart)
    chosen = _pick(done, starts, replace(arenas, sim=packed))
    return replace(chosen, sim=arenas.sim.replace(**chosen.sim._asdict()))


def _pick[Tree](done: Array, yes: Tree, no: Tree) -> Tree:
    """Takes `yes` where `done` is true, otherwise `no`; their arrays may have further axes."""

    def pick(a: Array, b: Array) -> Array:
        return jnp.where(done.reshape(done.shape + (1,) * (b.ndim - done.ndim)), a, b)

    return jax.tree.map(pick, yes, no)


def _ended(arenas: Arena, timestep: env.TimeStep, *, by_robot: bool) -> Ended:
    """Counts the episodes that ended in this step, [A], and sums their results."""
    done, episode = timestep.done, arenas.episode
    present = arenas.level.present
    targets, reached = jnp.sum(present, axis=-1), jnp.sum(present & arenas.arrived, axis=-1)

    def mine(x: Array) -> Array:
        return _pick(done, x, jnp.zeros_like(x))

    return Ended(
        episodes=done.astype(jnp.int32),
        stage=mine(arenas.stage),
        cohort=jnp.where(done, arenas.cohort, -1),
        targets=mine(targets),
        reached=mine(reached),
        all_reached=mine((reached == targets).astype(jnp.int32)),
        steps=mine(arenas.clock),
        robot_steps=mine(jnp.sum(episode.moving, axis=-1)),
        sensed=mine(jnp.sum(episode.sensed, axis=-1)),
        contacts=mine(jnp.sum(episode.contacts, axis=-2)),
        reward=mine(jnp.sum(episode.reward, axis=-1)),
        broken=(~timestep.sound).astype(jnp.int32),
        measured=mine(timestep.measured) if timestep.measured.shape[-1] else None,
        robots=jax.tree.map(mine, episodes.robots(arenas)) if by_robot else None,
    )


def _to_counts(ended: Ended) -> _Counts:
    """Lays the counts [A, ...] of a step side by side [A, K], to write one array instead of 11."""
    columns = [getattr(ended, name)[:, None] for name in _COUNTS]
    rest = ended._replace(contacts=None, **dict.fromkeys(_COUNTS))
    return jnp.concatenate([*columns, ended.contacts], axis=1), rest


def _to_ended(counts: Array, rest: Ended) -> Ended:
    """Undoes `_to_counts` for all steps of a rollout, [T, A, ...]."""
    columns = {name: counts[..., i] for i, name in enumerate(_COUNTS)}
    return rest._replace(contacts=counts[..., len(_COUNTS) :], **columns)
