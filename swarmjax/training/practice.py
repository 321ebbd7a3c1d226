"""The curriculum over levels in a rollout: what episodes begin on, and what they come to.

`curriculum.levels` has the buffer by itself. Here its levels are dealt out to arenas, and the
episodes of a rollout are read off again. An arena's source is not carried through the steps of a
rollout: how many episodes have ended in an arena says which one it is in.

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
    """What the episode of each arena began on, [A].

    Attributes:
      slot: place in the buffer, or what else it was (`levels.FRESH`, ...), int32.
      stage: that the level is of, int32.
      numbers: [.., V] that the level is drawn from.
      generation: of the level, int32.
      gained: value loss so far; None where it is not asked for.
    """

    slot: Array
    stage: Array
    numbers: Array
    generation: Array
    gained: Gained | None


class Practice(NamedTuple):
    """What levels are dealt out from.

    Attributes:
      buffer: of levels.
      options: the curriculum's numbers.
      by_loss: whether value loss is asked for.
    """

    buffer: LevelBuffer
    options: LevelNumbers
    by_loss: bool


def spacing(config: ProgramConfig) -> Spacing:
    """Returns the sizes that a run's levels are drawn with."""
    size = config.sim.robots, config.sim.obstacles
    return Spacing(*size, config.robot.hull_radius, config.task.target_radius)


def number_count(config: ProgramConfig) -> int:
    """Returns how many numbers a level of the buffer has, V."""
    if config.curriculum.levels.mutates:
        return mutation.number_count(config.stage, spacing(config))
    return level.uniform_count(spacing(config))


def numbers(config: ProgramConfig) -> LevelNumbers | None:
    """Works the numbers of the curriculum over levels out; None without a buffer.

    Raises:
      ConfigError: if levels are to be mutated that have nothing to move.
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
    """Starts without a level; None without a buffer."""
    options = config.curriculum.levels
    if not options.is_on:
        return None
    return levels.init(len(config.stage), options.buffer or 0, number_count(config))


def of(
    buffer: LevelBuffer | None, options: LevelNumbers | None, config: CurriculumConfig
) -> Practice | None:
    """Puts together what levels are dealt out from; None without a buffer."""
    if buffer is None or options is None:
        return None
    return Practice(buffer, options, config.levels.mode == "value_loss")


def deal(
    practice: Practice, uniforms: Array, stage: Array, key: Array, shards: Shards, spacing: Spacing
) -> LevelSource:
    """Says what each episode begins on.

    Args:
      practice: what levels are dealt out from.
      uniforms: [W, A, uniform_count(spacing)] of new levels.
      stage: [W, A] of each episode.
      key: random key, the same on all devices.
      shards: how the arenas are spread over devices.
      spacing: sizes.

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
    """Moves something in some of the levels [N] that are played again; picks are [N, 3]."""
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
    """Tells which episodes speak for their stage: those on levels that are drawn for them."""
    return source.slot == FRESH


def line_up(under_way: LevelSource, waiting: LevelSource) -> LevelSource:
    """Lists what every arena's episodes of a rollout begin on, in their order.

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
    """Picks what each arena is on after a rollout.

    Args:
      every: [J, A] as `line_up` lists them.
      ended: [A] how many episodes have ended in it; beyond W the last one is begun again.

    Returns:
      [A].
    """
    rows, arenas = every.slot.shape
    at = jnp.minimum(ended, rows - 1), jnp.arange(arenas)
    return jax.tree.map(lambda x: x[at], every)


def gain(before: Gained, batch: Batch, over: Array) -> tuple[Array, Gained]:
    """Adds the advantages above 0 of a rollout up, episode by episode.

    Args:
      before: [A] of the episodes that are under way.
      batch: [L] of A groups of T N samples.
      over: [T, A] whether the episode ended with the step.

    Returns:
      [T, A] positive value loss of the episode up to the step: the mean of max(advantage, 0) over
      its transitions; and [A] of those under way after it.
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
    """Reads off the outcomes of the episodes of a rollout.

    An arena that ends more episodes than waited for it begins the last one again; those count for
    no level: a short episode would count more often than a long one.

    Args:
      every: [J, A] as `line_up` lists them.
      ended: [T, A].
      loss: [T, A] value loss of episodes, by the step at which they ended; None: 0.
      config: says what success is.

    Returns:
      [J, A].
    """
    rows, arenas = every.slot.shape
    over = ended.episodes > 0
    number = jnp.cumsum(over, axis=0) - over
    at = jnp.where(over, jnp.minimum(number, rows), rows), jnp.arange(arenas)

    def read(x: Array) -> Array:
        # What counts for nothing goes to a row beyond the last.
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
    """Puts the episodes [J, A] of all devices on one axis, in the order of their arenas."""
    every = jax.tree.map(partial(shards.gather, axis=1), played)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), every)
