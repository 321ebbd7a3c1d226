"""The curriculum over levels in a rollout: where episodes begin, and how they end.

`curriculum.levels` holds the buffer. This module deals the buffer's levels out to arenas, and reads
the results of a rollout's episodes. The steps of a rollout do not carry an arena's level source
along. The number of ended episodes in an arena tells which episode is under way.

Axes: W episodes that wait for each arena, J = 1 + W with the one under way, V numbers of a level.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from swarmjax.curriculum import levels
from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.curriculum.levels import FRESH, MUTATED, LevelBuffer, LevelNumbers, Play
from swarmjax.ppo.learner import Batch
from swarmjax.shards import Shards
from swarmjax.task import level, mutation
from swarmjax.task.episode import Ended
from swarmjax.task.level import Spacing
from swarmjax.training.config import ProgramConfig


class Gained(NamedTuple):
    """Positive value loss of an episode so far, [A].

    Attributes:
      total: sum of the advantages above 0, over the transitions of all robots.
      steps: transitions.
    """

    total: Array
    steps: Array


class LevelSource(NamedTuple):
    """The source of each arena's episode, [A].

    Attributes:
      slot: place in the buffer, or another source (`levels.FRESH`, ...), int32.
      stage: stage of the level, int32.
      numbers: [.., V] numbers that define the level.
      generation: generation of the level, int32.
      gained: value loss so far; None if the curriculum does not use it.
    """

    slot: Array
    stage: Array
    numbers: Array
    generation: Array
    gained: Gained | None


class Practice(NamedTuple):
    """The inputs for dealing levels out.

    Attributes:
      buffer: buffer of levels.
      options: the curriculum's numbers.
      by_loss: whether the curriculum uses value loss.
    """

    buffer: LevelBuffer
    options: LevelNumbers
    by_loss: bool


def spacing(config: ProgramConfig) -> Spacing:
    """Returns the sizes for drawing a run's levels."""
    size = config.sim.robots, config.sim.obstacles
    return Spacing(*size, config.robot.hull_radius, config.task.target_radius)


def number_count(config: ProgramConfig) -> int:
    """Returns V, the count of numbers that define a level of the buffer."""
    if config.curriculum.levels.mutates:
        return mutation.number_count(config.stage, spacing(config))
    return level.uniform_count(spacing(config))


def numbers(config: ProgramConfig) -> LevelNumbers | None:
    """Computes the numbers of the curriculum over levels; None without a buffer.

    Raises:
      ConfigError: the config mutates levels, but nothing in them can move.
    """
    options = config.curriculum.levels
    if not options.is_on:
        return None
    keys = ("replay", "mutation", "temperature", "staleness")
    movable = mutation.movable(config.stage, spacing(config)) if options.mutates else None
    return LevelNumbers(
        **{key: np.float32(getattr(options, key)) for key in keys},
        minimum_episodes=np.int32(options.minimum_episodes or 0),
        movable=movable,
    )


def init(config: ProgramConfig) -> LevelBuffer | None:
    """Returns an empty buffer; None without a curriculum over levels."""
    options = config.curriculum.levels
    if not options.is_on:
        return None
    return levels.init(len(config.stage), options.buffer or 0, number_count(config))


def of(
    buffer: LevelBuffer | None, options: LevelNumbers | None, config: CurriculumConfig
) -> Practice | None:
    """Collects the inputs for dealing levels out; None without a buffer."""
    if buffer is None or options is None:
        return None
    return Practice(buffer, options, config.levels.mode == "value_loss")


def deal(
    practice: Practice, uniforms: Array, stage: Array, key: Array, shards: Shards, spacing: Spacing
) -> LevelSource:
    """Chooses the level source of each episode.

    Args:
      practice: inputs for dealing levels out.
      uniforms: [W, A, uniform_count(spacing)] uniform numbers of new levels.
      stage: [W, A] stage of each episode.
      key: random key, the same on all devices.
      shards: how the arenas are spread over devices.
      spacing: sizes for drawing levels.

    Returns:
      [W A].
    """
    waiting, arenas = stage.shape
    size = (waiting, arenas // shards.local_streams)
    picks = shards.draw(key, lambda key: levels.split_picks(key, size), axis=1).reshape(-1, 5)
    buffer, stage = practice.buffer, stage.ravel()
    count = buffer.numbers.shape[-1]
    fresh = uniforms.reshape(-1, uniforms.shape[-1])
    if count > fresh.shape[-1]:
        added = count - fresh.shape[-1]
        fresh = jax.vmap(lambda each: level.write_out(each, spacing, added, jnp))(fresh)
    slot = levels.choose(buffer, practice.options, stage, picks[:, :2])
    again, at = slot >= 0, jnp.maximum(slot, 0)
    source = LevelSource(
        slot=slot,
        stage=stage.astype(jnp.int32),
        numbers=jnp.where(again[:, None], buffer.numbers.reshape(-1, count)[at], fresh),
        generation=jnp.where(again, buffer.generation.ravel()[at], 0),
        gained=_nothing(slot) if practice.by_loss else None,
    )
    return _mutate(practice, source, picks[:, 2:])


def _nothing(slot: Array) -> Gained:
    return Gained(jnp.zeros(slot.shape), jnp.zeros(slot.shape))


def _mutate(practice: Practice, source: LevelSource, picks: Array) -> LevelSource:
    """Moves something in some of the replayed levels [N]; picks are [N, 3]."""
    buffer, options = practice.buffer, practice.options
    if options.movable is None:
        return source
    known = buffer.episodes.ravel()[jnp.maximum(source.slot, 0)] >= options.minimum_episodes
    changes = (source.slot >= 0) & known & (picks[:, 0] < options.mutation)
    movable = jnp.asarray(options.movable)[source.stage]
    moved = jax.vmap(levels.mutate)(source.numbers, movable, picks[:, 1:])
    return source._replace(
        slot=jnp.where(changes, MUTATED, source.slot),
        numbers=jnp.where(changes[:, None], moved, source.numbers),
        generation=source.generation + changes,
    )


def is_fresh(source: LevelSource) -> Array:
    """Tells which episodes count for their stage: only those on newly drawn levels."""
    return source.slot == FRESH


def line_up(under_way: LevelSource, waiting: LevelSource) -> LevelSource:
    """Lists the level sources of every arena's episodes of a rollout, in their order.

    Args:
      under_way: [A].
      waiting: [W A].

    Returns:
      [J, A].
    """

    def join(first: Array, rest: Array) -> Array:
        return jnp.concatenate([first[None], rest.reshape(-1, *first.shape)])

    return jax.tree.map(join, under_way, waiting)


def current(every: LevelSource, ended: Array) -> LevelSource:
    """Picks the level source of each arena after a rollout.

    Args:
      every: [J, A] from `line_up`.
      ended: [A] number of episodes that have ended in the arena; beyond W the last one repeats.

    Returns:
      [A].
    """
    rows, arenas = every.slot.shape
    at = jnp.minimum(ended, rows - 1), jnp.arange(arenas)
    return jax.tree.map(lambda x: x[at], every)


def gain(before: Gained, batch: Batch, over: Array) -> tuple[Array, Gained]:
    """Sums the positive advantages of a rollout, episode by episode.

    Args:
      before: [A] sums of the episodes under way.
      batch: [L] batches of A groups of T N samples.
      over: [T, A] whether the episode ended with the step.

    Returns:
      [T, A] positive value loss of the episode up to the step, and [A] the sums of the episodes
      under way afterwards. The loss is the mean of max(advantage, 0) over the episode's
      transitions.
    """
    steps = over.shape[0]

    def by_step(x: Array) -> Array:
        return jnp.sum(x.reshape(*x.shape[:2], steps, -1), axis=(0, 3)).T

    positive = by_step(jnp.where(batch.valid, jnp.maximum(batch.advantage, 0.0), 0.0))
    valid = by_step(batch.valid.astype(jnp.float32))

    def step(so_far: Gained, now: tuple[Array, Array, Array]) -> tuple[Gained, Array]:
        more, count, ends = now
        total, steps = so_far.total + more, so_far.steps + count
        mean = total / jnp.maximum(steps, 1.0)
        return Gained(jnp.where(ends, 0.0, total), jnp.where(ends, 0.0, steps)), mean

    after, mean = jax.lax.scan(step, before, (positive, valid, over))
    return mean, after


def plays(every: LevelSource, ended: Ended, loss: Array | None, config: CurriculumConfig) -> Play:
    """Reads the outcomes of a rollout's episodes.

    An arena that runs out of waiting episodes repeats the last one. The repeats count for no level:
    otherwise a short episode would count more often than a long one.

    Args:
      every: [J, A] from `line_up`.
      ended: [T, A].
      loss: [T, A] value loss of episodes, at the step where they ended; None: 0.
      config: defines success.

    Returns:
      [J, A].
    """
    rows, arenas = every.slot.shape
    over = ended.episodes > 0
    number = jnp.cumsum(over, axis=0) - over
    at = jnp.where(over, jnp.minimum(number, rows), rows), jnp.arange(arenas)

    def read(x: Array) -> Array:
        # Repeats go to a row beyond the last, which is dropped.
        return jnp.zeros((rows + 1, arenas), x.dtype).at[at].set(x)[:rows]

    whole = config.success == "all"
    begun = jnp.arange(rows)[:, None]
    return Play(
        slot=every.slot,
        stage=every.stage,
        begun=(begun > 0) & (jnp.sum(over, axis=0) >= begun),
        ended=read(over),
        successes=read(ended.all_reached if whole else ended.reached),
        trials=read(ended.episodes if whole else ended.targets),
        loss=jnp.zeros((rows, arenas)) if loss is None else read(loss),
        numbers=every.numbers,
        generation=every.generation,
    )


def together(played: Play, shards: Shards) -> Play:
    """Joins the episodes [J, A] of all devices on one axis, in the order of their arenas."""
    every = jax.tree.map(partial(shards.gather, axis=1), played)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), every)
