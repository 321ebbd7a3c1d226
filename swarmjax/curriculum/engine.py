"""The protocol of a curriculum, and what runs around every curriculum.

A curriculum chooses the stage and the level of the next episodes, and observes how episodes ended.
Both are pure functions of its own state, on the device. `stages.py` has the built-in modes, and
`levels.py` replays levels of any of them. The engine measures success in cohorts
(`cohorts.py`) for all of them.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from swarmjax.curriculum import cohorts as cohorts_of
from swarmjax.curriculum.cohorts import UNCOUNTED, Cohorts, CohortVerdict, Success
from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.extension import LevelDrawing
from swarmjax.shards import ALONE, Shards
from swarmjax.task import stage as task_stage
from swarmjax.task.episode import Ended
from swarmjax.task.stage import Stage
from swarmjax.task.stage_config import StageConfig

STAYED, BY_THRESHOLD, BY_BUDGET, REWEIGHED = range(4)
REASONS = ("stayed", "threshold", "budget", "reweighed")
NEVER = np.iinfo(np.int32).max  # as a deadline


class Schedule(NamedTuple):
    """The curriculum's numbers: an argument of the compiled program, not constants in it.

    Attributes:
      stages: [S], in order.
      deadline: [S] update at which the stage ends at the latest, int32.
      threshold: [] success that promotes.
      floor: [] share of the arenas that is spread evenly over all stages.
      cohort_updates: [] updates of one step limit, int32.
    """

    stages: Stage
    deadline: Array | np.ndarray
    threshold: Array | np.float32
    floor: Array | np.float32
    cohort_updates: Array | np.int32


class StageChoice(NamedTuple):
    """What is trained now.

    Attributes:
      stage: [] index of the newest stage, int32.
      weights: [S] share of the arenas on each stage, float32; their sum is 1.
      reason: [] why it changed, an index of `REASONS`, int32; `STAYED` if it did not.
    """

    stage: Array
    weights: Array
    reason: Array


class Next(NamedTuple):
    """The next episodes of each arena, [W, A].

    Attributes:
      stage: stage on which the episode begins, int32.
      level: seed of the episode's level, uint32; None: a new level for each episode.
      replayed: whether the level was played before, so that the episode does not count for its
        stage; None: it was not.
    """

    stage: Array
    level: Array | None = None
    replayed: Array | None = None


class CurriculumOutcomes(NamedTuple):
    """What a curriculum observes after an update.

    Attributes:
      ended: [T, A] episodes that ended, of all devices.
      value_loss: [T, A] mean of max(advantage, 0) over the episode's transitions in this update.
      verdict: what the cohorts show so far.
      update: [] number of the finished update, int32.
    """

    ended: Ended
    value_loss: Array
    verdict: CohortVerdict
    update: Array


class Curriculum(NamedTuple):
    """A curriculum, with the numbers of its schedule.

    Attributes:
      init: returns its state before the first update. The field `chosen` of a state is a
        `StageChoice`.
      choose: (state, key, free) -> `Next`; free is (W, A), and the key is the same on all devices.
      observe: (state, outcomes) -> state.
    """

    init: Callable[[], Any]
    choose: Callable[[Any, Array, tuple[int, int]], Next]
    observe: Callable[[Any, CurriculumOutcomes], Any]


@struct.dataclass(kw_only=True)
class CurriculumState:
    """The state of a run's curriculum.

    Attributes:
      own: state of the curriculum itself.
      cohorts: measurement of all stages.
      met: [] most robots of any stage so far, int32.
    """

    own: Any
    cohorts: Cohorts
    met: Array

    @property
    def chosen(self) -> StageChoice:
        """What is trained now."""
        return self.own.chosen


def schedule(
    stages: Sequence[StageConfig],
    options: CurriculumConfig,
    *,
    updates: int,
    step_limit: int,
    rollout: int,
    drawings: Sequence[LevelDrawing] = (),
) -> Schedule:
    """Computes the curriculum's numbers.

    The stages before the last share `budget_share` of the updates in equal parts.

    Args:
      stages: S, in order.
      options: settings of the curriculum.
      updates: updates of the whole run.
      step_limit: most control steps of an episode.
      rollout: control steps of an update.
      drawings: an extension's ways of drawing levels.

    Returns:
      The numbers, an argument of the compiled program.
    """
    share = options.budget_share * updates / max(len(stages) - 1, 1)
    deadline = [math.ceil(share * (i + 1)) for i in range(len(stages) - 1)]
    if options.mode not in ("sequential", "mixed"):
        deadline = [NEVER] * len(deadline)
    return Schedule(
        stages=task_stage.stack(stages, drawings),
        deadline=np.array([*deadline, NEVER], np.int32),
        threshold=np.float32(options.threshold),
        floor=np.float32(options.floor),
        cohort_updates=np.int32(math.ceil(step_limit / rollout)),
    )


def init(curriculum: Curriculum, schedule: Schedule) -> CurriculumState:
    """Starts a curriculum.

    Args:
      curriculum: the curriculum.
      schedule: its numbers.

    Returns:
      The state before the first update.
    """
    own, cohorts = curriculum.init(), cohorts_of.init(schedule.deadline.shape[0])
    return CurriculumState(own=own, cohorts=cohorts, met=_robots(own.chosen, schedule))


def choose(
    curriculum: Curriculum, state: CurriculumState, key: Array, free: tuple[int, int]
) -> tuple[Next, Array]:
    """Chooses the next episodes of all arenas, on all devices alike.

    Args:
      curriculum: the curriculum.
      state: its state.
      key: random key, the same on all devices.
      free: W, how many episodes wait for each arena, and A.

    Returns:
      The episodes [W, A], and the cohort [W, A] for which each counts.
    """
    following = curriculum.choose(state.own, key, free)
    cohort = jnp.broadcast_to(state.cohorts.number, free)
    if following.replayed is not None:
        cohort = jnp.where(following.replayed, UNCOUNTED, cohort)
    return following, cohort


def observe(
    curriculum: Curriculum,
    schedule: Schedule,
    success: Success,
    state: CurriculumState,
    ended: Ended,
    value_loss: Array,
    update: Array,
    shards: Shards = ALONE,
) -> CurriculumState:
    """Measures the episodes that ended in an update, and lets the curriculum decide.

    A decision begins a new cohort at once.

    Args:
      curriculum: the curriculum.
      schedule: its numbers.
      success: the deciding success.
      state: its state.
      ended: [T, A] episodes that ended, of this device.
      value_loss: [T, A] mean of max(advantage, 0) over the episode's transitions in this update.
      update: [] number of the finished update, from 0.
      shards: how the arenas are spread over devices.

    Returns:
      The state for the next update.
    """
    counted = cohorts_of.count(state.cohorts, ended, shards)
    judged, verdict = cohorts_of.judge(counted, schedule.cohort_updates, success)
    every, loss = jax.tree.map(partial(shards.gather, axis=1), (ended, value_loss))
    outcomes = CurriculumOutcomes(every, loss, verdict, update)
    own = curriculum.observe(state.own, outcomes)
    return CurriculumState(
        own=own,
        cohorts=cohorts_of.begin(judged, verdict.over | (own.chosen.reason != STAYED)),
        met=jnp.maximum(state.met, _robots(own.chosen, schedule)),
    )


def _robots(chosen: StageChoice, schedule: Schedule) -> Array:
    """Returns the most robots of the stages that are trained now."""
    return jnp.max(jnp.where(chosen.weights > 0.0, jnp.asarray(schedule.stages.robots), 0))
