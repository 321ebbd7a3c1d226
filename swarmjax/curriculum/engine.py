"""The protocol of a curriculum, and how success is measured for every curriculum.

A curriculum chooses the stages of the next episodes, and observes how episodes ended. Choosing and
observing are pure functions of the curriculum's own state, and run on the device. `stages.py` has
the built-in modes.

Success is measured on each stage, without favouring short episodes. A cohort holds all episodes
that began within a period as long as the step limit of an episode. The verdict on a cohort comes
one step limit after this period, when the cohort's last episode has ended. An earlier verdict
would count only the short episodes, which are the lucky ones. An episode counts for the stage and
the cohort in which it began.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from swarmjax.shards import ALONE, Shards
from swarmjax.task.episode import Ended
from swarmjax.task.stage import Stage

STAYED, BY_THRESHOLD, BY_BUDGET, REWEIGHED = range(4)
REASONS = ("stayed", "threshold", "budget", "reweighed")
NEVER = np.iinfo(np.int32).max  # stands for no deadline
# Cohort number of an episode that does not count. Cohorts have numbers from 0, and -1 is the cohort
# before the first.
UNCOUNTED = -2
# A verdict on n trials moves `Record.fast` towards the success in these trials, by n / (n + 20) of
# the way. The value before the verdict thus counts as much as 20 trials, so that a few episodes
# cannot outweigh many earlier ones.
_PRIOR_TRIALS = 20.0
# At the first verdict, the value before it is a success of one half, where p (1 - p) is largest.
_PRIOR_SUCCESS = 0.5
# Value of a metric that was not measured. It is not NaN, because JAX_DEBUG_NANS looks for NaN.
UNKNOWN = -math.inf

Success = Literal["targets", "all"]


class Schedule(NamedTuple):
    """The curriculum's stages, deadlines and thresholds: an argument of the compiled program.

    Attributes:
      stages: [S], in order.
      deadline: [S] update at which the stage ends at the latest, int32.
      threshold: [S] success at which the stage is learned.
      floor: [] share of the arenas that is spread evenly over all stages.
      cohort_updates: [] how many updates last one step limit, int32.
      easier: [S, S] bool; entry (i, j): whether stage j has to be learned before stage i opens.
    """

    stages: Stage
    deadline: Array | np.ndarray
    threshold: Array | np.ndarray
    floor: Array | np.float32
    cohort_updates: Array | np.int32
    easier: Array | np.ndarray


class StageChoice(NamedTuple):
    """The stages that are trained now.

    Attributes:
      stage: [] index of the newest stage, int32.
      weights: [S] share of the arenas on each stage, float32; their sum is 1.
      reason: [] why the choice changed in this update, an index of `REASONS`, int32; `STAYED` if it
        did not change.
    """

    stage: Array
    weights: Array
    reason: Array


class CohortTally(NamedTuple):
    """Counts of the ended episodes of one cohort, by the stage on which the episodes began.

    Each field is [S].

    Attributes:
      episodes: number of episodes, int32.
      targets: robots that were present, int32.
      reached: robots that arrived, int32.
      complete: episodes in which every robot arrived, int32.
      contacts: contacts of all kinds, over all robots, int32.
      reward: sum of the rewards of all robots, float32.
    """

    episodes: Array
    targets: Array
    reached: Array
    complete: Array
    contacts: Array
    reward: Array


class Record(NamedTuple):
    """The record of each stage. Each field is [S].

    Before a stage's first verdict, `episodes` is 0 and all other fields are `UNKNOWN`.

    Attributes:
      episodes: episodes of the newest verdict, int32.
      success: share of targets that were reached in these episodes.
      complete: share of these episodes in which every robot arrived.
      contacts: contacts per robot in these episodes.
      reward: reward per robot in these episodes.
      fast: running mean of the deciding success, which `curriculum.success` selects.
    """

    episodes: Array
    success: Array
    complete: Array
    contacts: Array
    reward: Array
    fast: Array

    def deciding(self, success: Success) -> Array:
        """Returns the newest success [S] by the given measure: `success` or `complete`."""
        return {"targets": self.success, "all": self.complete}[success]


@struct.dataclass(kw_only=True)
class Cohorts:
    """The two newest cohorts, and the record of all stages.

    Attributes:
      number: [] number of the cohort in which episodes now begin, int32.
      age: [] updates since that cohort began, int32.
      current: ended episodes of that cohort.
      previous: ended episodes of the cohort before that cohort.
      record: the record of each stage.
    """

    number: Array
    age: Array
    current: CohortTally
    previous: CohortTally
    record: Record


class CohortVerdict(NamedTuple):
    """What the cohorts show after an update.

    Attributes:
      over: [] whether the current cohort is over. All episodes of the previous cohort have then
        ended.
      judged: [S] whether the stage has a new verdict, because the previous cohort had episodes on
        it; all False unless `over`.
      success: [S] deciding success of each stage's newest verdict; `UNKNOWN` before the first.
      record: the record of each stage.
    """

    over: Array
    judged: Array
    success: Array
    record: Record


class CurriculumOutcomes(NamedTuple):
    """What a curriculum observes after an update.

    Attributes:
      ended: [T, A] episodes that ended, of all devices.
      verdict: what the cohorts show so far.
      update: [] number of the finished update, from 0, int32.
    """

    ended: Ended
    verdict: CohortVerdict
    update: Array


class Curriculum(NamedTuple):
    """A curriculum for a given schedule.

    Attributes:
      init: returns the curriculum's own state before the first update. The field `chosen` of
        a state is a `StageChoice`.
      choose: (state, key, free) -> [W, A] stage on which the next episodes of each arena begin,
        int32. free is (W, A): the next W episodes of A arenas. The key is the same on all
        devices.
      observe: (state, outcomes) -> state.
    """

    init: Callable[[], Any]
    choose: Callable[[Any, Array, tuple[int, int]], Array]
    observe: Callable[[Any, CurriculumOutcomes], Any]


@struct.dataclass(kw_only=True)
class CurriculumState:
    """The state of a run's curriculum.

    Attributes:
      own: the curriculum's own state, as `Curriculum.init` makes it.
      cohorts: the two newest cohorts, and the record of all stages.
      met: [] largest number of robots of the stages trained so far, int32.
    """

    own: Any
    cohorts: Cohorts
    met: Array

    @property
    def chosen(self) -> StageChoice:
        """The stages that are trained now."""
        return self.own.chosen


def init(curriculum: Curriculum, schedule: Schedule) -> CurriculumState:
    """Starts a curriculum.

    Args:
      curriculum: the curriculum.
      schedule: the curriculum's stages, deadlines and thresholds.

    Returns:
      The state before the first update.
    """
    own, cohorts = curriculum.init(), init_cohorts(schedule.deadline.shape[0])
    return CurriculumState(own=own, cohorts=cohorts, met=_robots(own.chosen, schedule))


def observe(
    curriculum: Curriculum,
    schedule: Schedule,
    success: Success,
    state: CurriculumState,
    ended: Ended,
    update: Array,
    shards: Shards = ALONE,
) -> CurriculumState:
    """Measures the episodes that ended in an update, and lets the curriculum decide.

    A decision begins a new cohort at once.

    Args:
      curriculum: the curriculum.
      schedule: the curriculum's stages, deadlines and thresholds.
      success: the measure of success by which the curriculum decides.
      state: the state before these episodes are counted.
      ended: [T, A] episodes that ended, of this device.
      update: [] number of the finished update, from 0.
      shards: how the arenas are spread over devices.

    Returns:
      The state for the next update.
    """
    counted = count(state.cohorts, ended, shards)
    judged, verdict = conclude(counted, schedule.cohort_updates, success)
    every = jax.tree.map(partial(shards.gather, axis=1), ended)
    own = curriculum.observe(state.own, CurriculumOutcomes(every, verdict, update))
    return CurriculumState(
        own=own,
        cohorts=begin_cohort(judged, verdict.over | (own.chosen.reason != STAYED)),
        met=jnp.maximum(state.met, _robots(own.chosen, schedule)),
    )


def init_cohorts(stages: int) -> Cohorts:
    """Returns the cohorts and the record of S stages before the first episode."""
    zero, unknown = jnp.zeros((), jnp.int32), jnp.full(stages, UNKNOWN, jnp.float32)
    return Cohorts(
        number=zero,
        age=zero,
        current=_no_episodes(stages),
        previous=_no_episodes(stages),
        record=Record(jnp.zeros(stages, jnp.int32), *[unknown] * 5),
    )


def no_verdict(stages: int) -> CohortVerdict:
    """Returns the verdict on S stages before the first update, which is empty."""
    record = init_cohorts(stages).record
    return CohortVerdict(jnp.array(True), jnp.zeros(stages, bool), record.success, record)


def count(cohorts: Cohorts, ended: Ended, shards: Shards = ALONE) -> Cohorts:
    """Adds ended episodes to the cohort and the stage in which they began.

    Args:
      cohorts: the cohorts before.
      ended: [T, A]; only episodes of the last two cohorts count.
      shards: how the arenas are spread over devices.

    Returns:
      The cohorts with new tallies.
    """
    chex.assert_rank(ended.cohort, 2)
    chex.assert_equal_shape([ended.cohort, ended.stage, ended.targets, ended.reached])
    return replace(
        cohorts,
        current=_add(cohorts.current, ended, cohorts.number, shards),
        previous=_add(cohorts.previous, ended, cohorts.number - 1, shards),
    )


def conclude(
    cohorts: Cohorts, updates: Array | np.int32, success: Success
) -> tuple[Cohorts, CohortVerdict]:
    """Ends an update; if the current cohort is over, records the previous one.

    Args:
      cohorts: the cohorts, as `count` returns them.
      updates: [] how many updates a cohort lasts, int32.
      success: the measure of success that the running mean follows.

    Returns:
      The cohorts with the new record, and the verdict.
    """
    age = cohorts.age + 1
    over = age >= updates
    judged = over & (cohorts.previous.targets > 0)
    record = _record(cohorts.record, cohorts.previous, judged, success)
    verdict = CohortVerdict(over, judged, record.deciding(success), record)
    return replace(cohorts, age=age, record=record), verdict


def begin_cohort(cohorts: Cohorts, begins: Array) -> Cohorts:
    """Begins a new cohort where `begins` [] is true."""
    empty = _no_episodes(cohorts.record.success.shape[0])
    following = (cohorts.current, empty)
    tallies = (cohorts.previous, cohorts.current)
    previous, current = jax.tree.map(lambda a, b: jnp.where(begins, a, b), following, tallies)
    return replace(
        cohorts,
        number=cohorts.number + begins,
        age=jnp.where(begins, 0, cohorts.age),
        previous=previous,
        current=current,
    )


def _no_episodes(stages: int) -> CohortTally:
    zero = jnp.zeros(stages, jnp.int32)
    return CohortTally(zero, zero, zero, zero, zero, jnp.zeros(stages, jnp.float32))


def _add(tally: CohortTally, ended: Ended, cohort: Array, shards: Shards) -> CohortTally:
    """Adds the episodes of one cohort to its tally."""
    stages = jnp.arange(tally.episodes.shape[0])[:, None, None]
    mine = (ended.cohort == cohort) & (ended.stage == stages)  # [S, T, A]

    def total(x: Array) -> Array:
        return jnp.sum(jnp.where(mine, x, 0), axis=(1, 2))

    contacts = jnp.sum(ended.contacts, axis=-1)
    counts = (ended.episodes, ended.targets, ended.reached, ended.all_reached, contacts)
    new = CohortTally(*map(total, (*counts, ended.reward)))
    return CohortTally(*(a + b for a, b in zip(tally, shards.sum(new), strict=True)))


def _record(record: Record, tally: CohortTally, judged: Array, success: Success) -> Record:
    """Records a cohort whose episodes have all ended, for the stages [S] where it had any."""
    robots, episodes = jnp.maximum(tally.targets, 1), jnp.maximum(tally.episodes, 1)
    newest = Record(
        episodes=tally.episodes,
        success=tally.reached / robots,
        complete=tally.complete / episodes,
        contacts=tally.contacts / robots,
        reward=tally.reward / robots,
        fast=record.fast,
    )
    trials = {"targets": tally.targets, "all": tally.episodes}[success]
    mean = jnp.where(jnp.isfinite(record.fast), record.fast, _PRIOR_SUCCESS)
    rate = trials / (trials + _PRIOR_TRIALS)
    newest = newest._replace(fast=mean + rate * (newest.deciding(success) - mean))
    return jax.tree.map(lambda new, old: jnp.where(judged, new, old), newest, record)


def _robots(chosen: StageChoice, schedule: Schedule) -> Array:
    """Returns the largest number of robots of any stage that is trained now."""
    return jnp.max(jnp.where(chosen.weights > 0.0, jnp.asarray(schedule.stages.robots), 0))
