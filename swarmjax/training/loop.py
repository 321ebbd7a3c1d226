"""The compiled training loop: rollout, advantages, PPO update and curriculum, repeated n times.

A call trains a chunk of n updates. n is an argument, so one program serves every chunk size. The
run is the same with any chunk size.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from swarmjax.curriculum import engine
from swarmjax.curriculum.engine import BY_BUDGET, BY_THRESHOLD, CurriculumState, Schedule
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.ppo import LearnerState
from swarmjax.shards import Shards
from swarmjax.sim import gaps
from swarmjax.task.episode import Ended
from swarmjax.task.goals.goal import MEASURED
from swarmjax.training import episodes, rollout
from swarmjax.training.config import ProgramConfig
from swarmjax.training.rollout import Arena, Program

Metrics = dict[str, Any]


@struct.dataclass
class TrainState:
    """The complete state of a run: a checkpoint holds exactly this.

    Attributes:
      learners: [L] the learners.
      arenas: [A] the arenas, packed.
      curriculum: state of the curriculum.
      key: random key of the next update.
      update: [] number of finished updates, int32.
    """

    learners: LearnerState
    arenas: Arena
    curriculum: CurriculumState
    key: Array
    update: Array


def init(program: Program, schedule: Schedule, seed: Array | None = None) -> TrainState:
    """Starts a run.

    Args:
      program: the compiled program.
      schedule: the curriculum's stages, deadlines and thresholds.
      seed: [] seed of the run, int32; None for the seed of the config.

    Returns:
      The state before the first update.
    """
    config = program.config
    start_key = jax.random.key(config.seed if seed is None else seed)
    run_key, learner_key, level_key = jax.random.split(start_key, 3)
    curriculum = engine.init(program.curriculum(schedule), schedule)
    starts = _draw(program, schedule, curriculum, level_key, waiting=1)
    learners = jax.vmap(program.ppo.init)(jax.random.split(learner_key, config.learners))
    return TrainState(learners, starts, curriculum, run_key, jnp.zeros((), jnp.int32))


def train_chunk(
    program: Program, schedule: Schedule, state: TrainState, n: Array
) -> tuple[TrainState, Metrics]:
    """Trains for `n` updates; `jit` it with `program` bound and `state` donated.

    Args:
      program: the compiled program.
      schedule: the curriculum's stages, deadlines and thresholds.
      state: state before these updates.
      n: [] number of updates, at most `program.rows`, int32.

    Returns:
      The state after these updates, and metrics with a leading axis of `program.rows`: the first n
      rows hold one update each.
    """
    # Traces the update once, for both the shapes and the loop.
    step = jax.jit(partial(update, program), inline=True)
    one = step.eval_shape(schedule, state)[1]
    blank = jax.tree.map(lambda x: jnp.zeros((program.rows, *x.shape), x.dtype), one)

    def body(i: Array, carry: tuple[TrainState, Metrics]) -> tuple[TrainState, Metrics]:
        state, metrics = step(schedule, carry[0])
        return state, jax.tree.map(lambda rows, x: rows.at[i].set(x), carry[1], metrics)

    return jax.lax.fori_loop(0, n, body, (state, blank))


def update(program: Program, schedule: Schedule, state: TrainState) -> tuple[TrainState, Metrics]:
    """Runs one update: the arenas drive for a rollout, the learners learn, the curriculum decides.

    Args:
      program: the compiled program.
      schedule: the curriculum's stages, deadlines and thresholds.
      state: state before this update.

    Returns:
      The state after this update, and its metrics.
    """
    config, shards, before = program.config, program.shards, state.curriculum
    key, level_key, rollout_key, learn_key = jax.random.split(state.key, 4)
    waiting = _draw(program, schedule, before, level_key, waiting=program.waiting)
    arenas, trajectory, ended = rollout.collect(
        program, state.learners, state.arenas, waiting, rollout_key
    )
    batch = rollout.batch(program, trajectory, state.arenas.recall, ended)
    steps = config.arenas * config.algo.rollout_length
    explored = program.ppo.explore(state.learners, steps)
    learn_keys = jax.random.split(learn_key, trajectory.valid.shape[1])
    learners, learned = jax.vmap(program.ppo.update)(explored, batch, learn_keys)
    success = config.curriculum.success
    curriculum = engine.observe(
        program.curriculum(schedule), schedule, success, before, ended, state.update, shards
    )
    learners = carry_over(learners, program, before, curriculum)
    stage, every_stage = before.chosen.stage, jnp.arange(len(schedule.deadline))[:, None]
    metrics = {
        "update": state.update,
        "stage": stage,
        **_curriculum_metrics(config, before, curriculum),
        **_learner_metrics(learned, batch, shards),
        **shards.sum(
            {
                "mix": jnp.sum(arenas.stage == every_stage, axis=-1, dtype=jnp.int32),
                "robots": jnp.sum(arenas.level.present),
                "transitions": jnp.sum(trajectory.valid),
                **_episode_metrics(ended, stage, program.world.goal.measures),
            }
        ),
    }
    if program.by_robot:
        every = jax.tree.map(partial(shards.gather, axis=1), ended)
        metrics[episodes.KEY] = episodes.pack(every, episodes.room(config))
    return TrainState(learners, arenas, curriculum, key, state.update + 1), metrics


def carry_over(
    learners: LearnerState, program: Program, before: CurriculumState, after: CurriculumState
) -> LearnerState:
    """Prepares the learners for the stage that begins with a promotion.

    If each robot has a learner and the swarm grows beyond its largest size so far, the learners of
    the new robots become copies of the other learners, in turn: parameters, optimiser and
    normaliser. Then the optimiser and the exploration of all learners are reset or kept, as
    `config.curriculum` says. Nothing is computed if there is nothing to copy or reset.

    Args:
      learners: [L] the learners.
      program: the compiled program.
      before: state of the curriculum before the update.
      after: state of the curriculum after the update. Without a promotion, the learners stay
        unchanged.

    Returns:
      The learners, [L].
    """
    options, carried = program.config.curriculum, learners
    count = jax.tree.leaves(learners)[0].shape[0]
    if count > 1:  # learner i % before.met is copied to the place of learner i
        index = jnp.arange(count)
        new = (index >= before.met) & (index < after.met)
        source = jnp.where(new, index % before.met, index)
        carried = jax.tree.map(lambda x: x[source], learners)
    carried = program.ppo.begin_again(
        carried,
        optimizer=options.optimizer == "reset",
        exploration=options.exploration == "reset",
    )
    if carried is learners:
        return learners
    reason = after.chosen.reason
    promoted = (reason == BY_THRESHOLD) | (reason == BY_BUDGET)
    return jax.tree.map(lambda new, old: jnp.where(promoted, new, old), carried, learners)


def _draw(
    program: Program, schedule: Schedule, curriculum: CurriculumState, key: Array, *, waiting: int
) -> Arena:
    """Draws `waiting` episodes for each arena of this device."""
    config, shards = program.config, program.shards
    choose, choose_key = program.curriculum(schedule).choose, jax.random.fold_in(key, 1)
    stage = choose(curriculum.own, choose_key, (waiting, config.arenas))
    stage, cohort = shards.local(stage, axis=1), curriculum.cohorts.number
    memory = program.ppo.begin_memory((program.world.spacing.robots,))
    return rollout.draw_starts(program.world, schedule.stages, stage, cohort, key, shards, memory)


def _curriculum_metrics(
    config: ProgramConfig, before: CurriculumState, after: CurriculumState
) -> Metrics:
    """Reports the decision, the stages' weights after it, and the record of each stage."""
    record, stage = after.cohorts.record, before.chosen.stage
    return {
        "decision": after.chosen.reason,
        "decided_stage": stage,
        "next_stage": after.chosen.stage,
        "stage_success": record.deciding(config.curriculum.success)[stage],
        "weights": after.chosen.weights,
        "episodes_by_stage": record.episodes,
        "success_by_stage": record.success,
        "complete_by_stage": record.complete,
        "contacts_by_stage": record.contacts,
        "return_by_stage": record.reward,
        "estimate_by_stage": record.fast,
    }


def _learner_metrics(learned: Metrics, batch: Batch, shards: Shards) -> Metrics:
    """Averages metrics [L] over the learners that had a valid sample."""
    learns = shards.any(jnp.any(batch.valid, axis=(1, 2)))
    count = jnp.maximum(jnp.sum(learns), 1)
    return {name: jnp.sum(jnp.where(learns, x, 0.0)) / count for name, x in learned.items()}


def _episode_metrics(ended: Ended, stage: Array, measures: Iterable[str]) -> Metrics:
    """Sums results of the episodes that ended in this update on the current training stage."""
    mine = ended.stage == stage

    def total(x: Array) -> Array:
        keep = mine.reshape(mine.shape + (1,) * (x.ndim - mine.ndim))
        return jnp.sum(jnp.where(keep, x, 0), axis=(0, 1))

    contacts = total(ended.contacts)
    own = () if ended.measured is None else total(ended.measured)
    sums = ("episodes", "targets", "reached", "steps", "robot_steps", "sensed", "reward")
    return {
        **{name: total(getattr(ended, name)) for name in sums},
        "complete": total(ended.all_reached),
        **{f"contacts_{kind}": contacts[i] for i, kind in enumerate(gaps.KINDS)},
        **{f"{MEASURED}{name}": each for name, each in zip(measures, own, strict=True)},
        "broken_arenas": jnp.sum(ended.broken),
    }
