"""The curriculum: who trains on which stage, and when that changes. All of it on device.

Success is the share of targets reached, over a cohort: all episodes that began within one step
limit. Its verdict falls another step limit later, when the last of them has ended; the short
episodes that end first are the lucky ones, and would promote too early.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from swarmjax.config import TrainConfig
from swarmjax.task import stage as task_stage
from swarmjax.task.stage import Stage

STAYED, BY_THRESHOLD, BY_BUDGET = 0, 1, 2
REASONS = ("stayed", "threshold", "budget")


class Schedule(NamedTuple):
    """The curriculum's numbers: an argument of the compiled program, so that none is fixed in it.

    Attributes:
      stages: [S], in order.
      deadline: [S] update at which the stage is left in any case, int32.
      threshold: [] share of targets reached that promotes.
      cohort_updates: [] updates that hold one step limit, int32.
    """

    stages: Stage
    deadline: Array | np.ndarray
    threshold: Array | np.float32
    cohort_updates: Array | np.int32


class Tally(NamedTuple):
    """Episodes of one cohort that have ended: targets given and reached, [] int32 each."""

    targets: Array
    reached: Array


@struct.dataclass
class Curriculum:
    """Where the curriculum stands.

    Attributes:
      stage: [] index of the stage that episodes now begin on, int32.
      cohort: [] number of the cohort that episodes now begin in, int32.
      age: [] updates since that cohort began, int32.
      current: episodes of this cohort that have ended.
      previous: those of the one before.
      success: [] share of targets reached by the last whole cohort of this stage; nan before.
    """

    stage: Array
    cohort: Array
    age: Array
    current: Tally
    previous: Tally
    success: Array


class Decision(NamedTuple):
    """What `advance` decided.

    Attributes:
      reason: [] `STAYED`, `BY_THRESHOLD` or `BY_BUDGET`, int32.
      stage: [] index of the stage that was judged, int32.
      success: [] share of targets of the last whole cohort of that stage; nan before.
    """

    reason: Array
    stage: Array
    success: Array


def schedule(config: TrainConfig) -> Schedule:
    """Works the curriculum's numbers out.

    The stages before the last share `curriculum.budget_share` of the updates in equal parts.
    """
    stages = len(config.stage)
    share = config.curriculum.budget_share * config.updates / max(stages - 1, 1)
    deadline = [math.ceil(share * (i + 1)) for i in range(stages - 1)]
    return Schedule(
        stages=task_stage.stack(config.stage),
        deadline=np.array([*deadline, np.iinfo(np.int32).max], np.int32),
        threshold=np.float32(config.curriculum.threshold),
        cohort_updates=np.int32(math.ceil(config.task.step_limit / config.algo.rollout)),
    )


def init() -> Curriculum:
    """Starts at the first stage."""
    return Curriculum(
        stage=jnp.zeros((), jnp.int32),
        cohort=jnp.zeros((), jnp.int32),
        age=jnp.zeros((), jnp.int32),
        current=_empty(),
        previous=_empty(),
        success=jnp.full((), jnp.nan, jnp.float32),
    )


def assign(curriculum: Curriculum, arenas: int) -> Array:
    """Says on which stage [A] the next episode of each arena begins."""
    return jnp.full((arenas,), curriculum.stage)


def count(curriculum: Curriculum, cohort: Array, targets: Array, reached: Array) -> Curriculum:
    """Adds episodes that have ended to the cohorts in which they began.

    Args:
      curriculum: before.
      cohort: [...] in which the episode began; any other number than the last two is left out.
      targets: [...] its targets, int32; 0 where no episode ended.
      reached: [...] how many of them were reached, int32.

    Returns:
      The curriculum with new tallies.
    """
    chex.assert_equal_shape([cohort, targets, reached])

    def add(tally: Tally, number: Array) -> Tally:
        mine = cohort == number
        return Tally(
            tally.targets + jnp.sum(jnp.where(mine, targets, 0)),
            tally.reached + jnp.sum(jnp.where(mine, reached, 0)),
        )

    return replace(
        curriculum,
        current=add(curriculum.current, curriculum.cohort),
        previous=add(curriculum.previous, curriculum.cohort - 1),
    )


def advance(
    curriculum: Curriculum, schedule: Schedule, update: Array
) -> tuple[Curriculum, Decision]:
    """Moves the cohorts on by one update, and the stage where it is time.

    A stage is left when a whole cohort reached `threshold` of its targets, or at its deadline.

    Args:
      curriculum: after `count`.
      schedule: the curriculum's numbers.
      update: [] the update that has just been done, from 0.

    Returns:
      The curriculum for the next update, and the decision.
    """
    age = curriculum.age + 1
    over = age >= schedule.cohort_updates
    whole = over & (curriculum.previous.targets > 0)
    share = curriculum.previous.reached / jnp.maximum(curriculum.previous.targets, 1)
    success = jnp.where(whole, share, curriculum.success)
    last = curriculum.stage >= schedule.deadline.shape[0] - 1
    passed = whole & (share >= schedule.threshold) & ~last
    late = (update + 1 >= jnp.asarray(schedule.deadline)[curriculum.stage]) & ~last
    reason = jnp.where(passed, BY_THRESHOLD, jnp.where(late, BY_BUDGET, STAYED))
    stayed = replace(curriculum, age=age, success=success)
    moved = _promote(curriculum)
    next_ = _select(reason != STAYED, moved, _select(over, _next_cohort(stayed), stayed))
    return next_, Decision(reason.astype(jnp.int32), curriculum.stage, success)


def _empty() -> Tally:
    return Tally(jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def _next_cohort(curriculum: Curriculum) -> Curriculum:
    """Begins a cohort on the same stage."""
    return replace(
        curriculum,
        cohort=curriculum.cohort + 1,
        age=jnp.zeros_like(curriculum.age),
        previous=curriculum.current,
        current=_empty(),
    )


def _promote(curriculum: Curriculum) -> Curriculum:
    """Begins the next stage; episodes of the old one, still running, count for no cohort of it."""
    return replace(
        curriculum,
        stage=curriculum.stage + 1,
        cohort=curriculum.cohort + 2,
        age=jnp.zeros_like(curriculum.age),
        previous=_empty(),
        current=_empty(),
        success=jnp.full_like(curriculum.success, jnp.nan),
    )


def _select(condition: Array, yes: Curriculum, no: Curriculum) -> Curriculum:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def log(rows: Sequence[dict], names: Sequence[str]) -> list[dict]:
    """Turns rows of metrics into the decision log.

    Args:
      rows: metrics of one update each, with `update`, `decision`, `decided_stage` and
        `stage_success`.
      names: of the stages.

    Returns:
      One entry a promotion: update, from, to, why, and the success that was measured.
    """
    return [
        {
            "update": row["update"],
            "from": names[row["decided_stage"]],
            "to": names[row["decided_stage"] + 1],
            "why": REASONS[row["decision"]],
            "targets_reached": row["stage_success"],
        }
        for row in rows
        if row["decision"] != STAYED
    ]
