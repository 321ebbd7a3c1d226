"""The curriculum's engine: it assigns stages to arenas, judges each stage, and times decisions.

All of it runs on the device, for any mode of `modes.py`. Episodes are counted in cohorts: a cohort
holds all episodes that began within one step limit. The verdict on a cohort comes one step limit
after that, when the cohort's last episode has ended. An earlier verdict would count only the short
episodes, which are the lucky ones, and would promote too early. An episode counts for the stage and
the cohort in which it began.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.curriculum.levels import LevelBuffer, LevelNumbers
from swarmjax.extension import LevelDrawing
from swarmjax.shards import ALONE, Shards
from swarmjax.task import stage as task_stage
from swarmjax.task.episode import Ended
from swarmjax.task.stage import Stage
from swarmjax.task.stage_config import StageConfig

STAYED, BY_THRESHOLD, BY_BUDGET, BY_DEMOTION, REWEIGHED = range(5)
REASONS = ("stayed", "threshold", "budget", "demotion", "reweighed")
NEVER = np.iinfo(np.int32).max  # as a deadline

# The golden ratio in steps of 2**-32: no other number has multiples that fill the circle more
# evenly (Knuth, The Art of Computer Programming 3, section 6.4, multiplicative hashing, theorem S).
_GOLDEN = np.uint32(2654435769)
# A verdict on n trials moves `fast` towards the success in these trials, by n / (n + 20) of the
# way. The old result then counts as much as 20 trials. A few episodes then cannot outweigh many
# earlier ones.
_PRIOR_TRIALS = 20.0
# Before the first verdict, these 20 trials count with a success of one half, where p (1 - p) is
# largest.
_PRIOR_SUCCESS = 0.5
# `slow` moves a fifth as fast, so it lags about five verdicts behind. |fast - slow| is how far
# success has moved since then. This is the learning progress of Kanitscheider et al. 2021
# ("Multi-task curriculum learning in a complex, visual, hard-exploration domain: Minecraft",
# arXiv:2106.14876): the difference of a fast and a slow mean, in both directions. The two rates
# are this project's choice.
_SLOWNESS = 0.2
# A figure that was not measured. It is not NaN, because JAX_DEBUG_NANS looks for NaN.
UNKNOWN = -math.inf


class Schedule(NamedTuple):
    """The curriculum's numbers: an argument of the compiled program, not constants in it.

    Numbers that a mode does not have are nan, or `NEVER`.

    Attributes:
      stages: [S], in order.
      deadline: [S] update at which the stage ends at the latest, int32.
      threshold: [] success that promotes.
      demotion: [] success below which the run returns to the previous stage; -1: never.
      earlier_share: [] share of the arenas on earlier stages.
      floor: [] share of the arenas that is spread evenly over all stages.
      cohort_updates: [] updates of one step limit, int32.
      levels: numbers of the curriculum over levels; None without one.
    """

    stages: Stage
    deadline: Array | np.ndarray
    threshold: Array | np.float32
    demotion: Array | np.float32
    earlier_share: Array | np.float32
    floor: Array | np.float32
    cohort_updates: Array | np.int32
    levels: LevelNumbers | None = None


class CohortTally(NamedTuple):
    """Ended episodes of one cohort, by the stage on which they began, [S] each.

    Attributes:
      episodes: number of episodes, int32.
      targets: robots that were present, int32.
      reached: robots that arrived, int32.
      complete: episodes in which every robot arrived, int32.
      contacts: contacts of all kinds, over all robots, int32.
      reward: sum over all robots, float32.
    """

    episodes: Array
    targets: Array
    reached: Array
    complete: Array
    contacts: Array
    reward: Array


class Record(NamedTuple):
    """The record of each stage, [S] each.

    Before a stage's first verdict, `episodes` is 0 and all other figures are `UNKNOWN`.

    Attributes:
      episodes: episodes of the newest verdict, int32.
      success: share of targets that were reached in these episodes.
      complete: share of these episodes in which every robot arrived.
      contacts: per robot.
      reward: per robot.
      fast: running mean of the deciding success.
      slow: another running mean of this success; it changes five times as slowly.
    """

    episodes: Array
    success: Array
    complete: Array
    contacts: Array
    reward: Array
    fast: Array
    slow: Array

    @property
    def progress(self) -> Array:
        """How far the deciding success has recently risen or fallen, [S], at least 0 if known."""
        known = jnp.isfinite(self.fast)
        fast, slow = (jnp.where(known, mean, 0.0) for mean in (self.fast, self.slow))
        return jnp.where(known, jnp.abs(fast - slow), UNKNOWN)


@struct.dataclass(kw_only=True)
class Curriculum:
    """The state of the curriculum.

    Attributes:
      stage: [] index of the newest stage, int32.
      weights: [S] share of the arenas on each stage, float32.
      cohort: [] number of the cohort in which episodes now begin, int32.
      age: [] updates since that cohort began, int32.
      since: [] cohort in which the newest decision took effect, int32.
      current: ended episodes of this cohort.
      previous: ended episodes of the cohort before.
      record: the record of each stage.
      met: [] most robots of any stage so far, int32.
      levels: the buffer of the curriculum over levels; None without one.
    """

    stage: Array
    weights: Array
    cohort: Array
    age: Array
    since: Array
    current: CohortTally
    previous: CohortTally
    record: Record
    met: Array
    levels: LevelBuffer | None = None


class CohortVerdict(NamedTuple):
    """The findings of an update.

    Attributes:
      over: [] whether a cohort is over. All episodes of the cohort before it have then ended.
      judged: [S] whether the cohort before had episodes on the stage; all False unless `over`.
      success: [S] deciding success of each stage's newest verdict; `UNKNOWN` before the first.
    """

    over: Array
    judged: Array
    success: Array


class StageChoice(NamedTuple):
    """The choice of a mode.

    Attributes:
      stage: [] index of the newest stage, int32.
      weights: [S] share of the arenas on each stage, float32; their sum is 1.
      reason: [] `STAYED` or another of `REASONS`, int32.
    """

    stage: Array
    weights: Array
    reason: Array


class Decision(NamedTuple):
    """What `advance` decided.

    Attributes:
      reason: [] one of `REASONS`, int32.
      stage: [] index of the newest stage before the decision, int32.
      next_stage: [] index of the newest stage after the decision, int32.
      success: [] deciding success of the newest verdict on `stage`; `UNKNOWN` before the first.
    """

    reason: Array
    stage: Array
    next_stage: Array
    success: Array

    @property
    def promoted(self) -> Array:
        """Whether the decision left a stage for the next one, []."""
        return (self.reason == BY_THRESHOLD) | (self.reason == BY_BUDGET)


Mode = Callable[[Curriculum, Schedule, CurriculumConfig, CohortVerdict, Array], StageChoice]


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

    The stages before the last share `budget_share` of the updates in equal parts. Prerequisites may
    use the whole of this share.

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
    deadline = [NEVER] * len(stages)
    if options.budget_share is not None:
        share = options.budget_share * updates / max(len(stages) - 1, 1)
        deadline[:-1] = [math.ceil(share * (i + 1)) for i in range(len(stages) - 1)]
    if options.prerequisites:
        deadline[:-1] = [deadline[-2]] * (len(stages) - 1)
    return Schedule(
        stages=task_stage.stack(stages, drawings),
        deadline=np.array(deadline, np.int32),
        threshold=_number(options.threshold, math.nan),
        demotion=_number(options.demotion, -1.0),
        earlier_share=_number(options.earlier_share, math.nan),
        floor=_number(options.floor, math.nan),
        cohort_updates=np.int32(math.ceil(step_limit / rollout)),
    )


def last_begins(schedule: Schedule) -> int:
    """Returns the update at which the last stage begins at the latest, from the deadlines alone.

    Each decision comes at least one step limit after the one before.

    Args:
      schedule: the curriculum's numbers.

    Returns:
      The update: 0 for a single stage, and `NEVER` or more if a stage has no deadline.
    """
    begins = 0
    for deadline in np.asarray(schedule.deadline)[:-1].tolist():
        begins = max(deadline, begins + int(schedule.cohort_updates))
    return begins


def _number(value: float | None, absent: float) -> np.float32:
    return np.float32(absent if value is None else value)


def init(schedule: Schedule, options: CurriculumConfig, mode: Mode) -> Curriculum:
    """Starts the curriculum with the mode's first choice.

    Args:
      schedule: the curriculum's numbers.
      options: settings of the curriculum.
      mode: one of `modes.MODES`.

    Returns:
      The curriculum before the first update.
    """
    stages = schedule.deadline.shape[0]
    zero, unknown = jnp.zeros((), jnp.int32), jnp.full(stages, UNKNOWN, jnp.float32)
    blank = Curriculum(
        stage=zero,
        weights=unknown,
        cohort=zero,
        age=zero,
        since=zero,
        current=_no_episodes(stages),
        previous=_no_episodes(stages),
        record=Record(jnp.zeros(stages, jnp.int32), *[unknown] * 6),
        met=zero,
    )
    begun = CohortVerdict(over=jnp.array(True), judged=jnp.zeros(stages, bool), success=unknown)
    return _settle(blank, schedule, mode(blank, schedule, options, begun, zero - 1))


def begin_cohort(curriculum: Curriculum) -> Curriculum:
    """Begins a cohort when all arenas are drawn again: their open episodes will never end.

    Args:
      curriculum: the curriculum before; its measurements and decisions are kept.

    Returns:
      The curriculum with empty tallies.
    """
    empty = _no_episodes(curriculum.weights.shape[0])
    return replace(
        curriculum,
        cohort=curriculum.cohort + 1,
        age=jnp.zeros_like(curriculum.age),
        previous=empty,
        current=empty,
    )


def assign(curriculum: Curriculum, arenas: int) -> Array:
    """Chooses the stage [A] on which the next episode of each arena begins.

    The weights divide a line into stages. Arena a is at the point (a + u) / A of this line. So a
    stage's weight is its share of the arenas, and also its share of the time. From cohort to
    cohort, u moves by the golden ratio. If there are few arenas, each arena visits every stage over
    time. If there are many arenas, most of them stay on their stage. That matters because an arena
    that moves must wait until its episode ends. If all arenas moved, stages with long episodes
    would get more than their share.

    Args:
      curriculum: its current state.
      arenas: A.

    Returns:
      [A] int32, never a stage with weight 0.
    """
    turned = curriculum.cohort.astype(jnp.uint32) * _GOLDEN >> 8  # a float32 holds 24 bits
    point = (jnp.arange(arenas) + turned * np.float32(2.0**-24)) / arenas
    ends = jnp.cumsum(curriculum.weights)
    inner = (ends / ends[-1])[:-1]
    stage = jnp.searchsorted(inner, point, side="right", method="compare_all")
    # The last point may round to 1. Without a limit it would lie behind all stages with a weight.
    last = jnp.max(jnp.where(curriculum.weights > 0.0, jnp.arange(ends.shape[0]), 0))
    return jnp.minimum(stage, last).astype(jnp.int32)


def count(curriculum: Curriculum, ended: Ended, shards: Shards = ALONE) -> Curriculum:
    """Adds ended episodes to the cohort and the stage in which they began.

    Args:
      curriculum: before.
      ended: [T, A]; only episodes of the last two cohorts count.
      shards: how the arenas are spread over devices.

    Returns:
      The curriculum with new tallies.
    """
    chex.assert_rank(ended.cohort, 2)
    chex.assert_equal_shape([ended.cohort, ended.stage, ended.targets, ended.reached])
    return replace(
        curriculum,
        current=_add(curriculum.current, ended, curriculum.cohort, shards),
        previous=_add(curriculum.previous, ended, curriculum.cohort - 1, shards),
    )


def advance(
    curriculum: Curriculum,
    schedule: Schedule,
    options: CurriculumConfig,
    mode: Mode,
    update: Array,
) -> tuple[Curriculum, Decision]:
    """Moves the cohorts on by one update, judges an ended cohort and lets the mode decide.

    A decision begins a new cohort at once.

    Args:
      curriculum: after `count`.
      schedule: the curriculum's numbers.
      options: settings of the curriculum.
      mode: one of `modes.MODES`.
      update: [] number of the finished update, from 0.

    Returns:
      The curriculum for the next update, and the decision.
    """
    curriculum = replace(curriculum, age=curriculum.age + 1)
    over = curriculum.age >= schedule.cohort_updates
    judged = over & (curriculum.previous.targets > 0)
    record = _judge(curriculum.record, curriculum.previous, judged, options)
    judging = replace(curriculum, record=record)
    verdict = CohortVerdict(over=over, judged=judged, success=_deciding(record, options))
    choice = mode(judging, schedule, options, verdict, update)
    decision = Decision(
        reason=choice.reason,
        stage=curriculum.stage,
        next_stage=choice.stage,
        success=verdict.success[curriculum.stage],
    )
    return _settle(_next_cohort(judging, choice.reason, over), schedule, choice), decision


def _no_episodes(stages: int) -> CohortTally:
    zero = jnp.zeros(stages, jnp.int32)
    return CohortTally(zero, zero, zero, zero, zero, jnp.zeros(stages, jnp.float32))


def _add(tally: CohortTally, ended: Ended, cohort: Array, shards: Shards) -> CohortTally:
    """Adds the episodes of one cohort to its tally."""
    stages = jnp.arange(tally.episodes.shape[0])[:, None, None]
    mine = (ended.cohort == cohort) & (ended.stage == stages)  # [S, T, A]

    def total(x: Array) -> Array:
        return jnp.sum(jnp.where(mine, x, 0), axis=(1, 2))

    new = CohortTally(
        episodes=total(ended.episodes),
        targets=total(ended.targets),
        reached=total(ended.reached),
        complete=total(ended.all_reached),
        contacts=total(jnp.sum(ended.contacts, axis=-1)),
        reward=total(ended.reward),
    )
    return CohortTally(*(a + b for a, b in zip(tally, shards.sum(new), strict=True)))


def _judge(record: Record, tally: CohortTally, judged: Array, options: CurriculumConfig) -> Record:
    """Records a whole cohort for the stages [S] on which it had episodes."""
    robots, episodes = jnp.maximum(tally.targets, 1), jnp.maximum(tally.episodes, 1)
    verdict = Record(
        episodes=tally.episodes,
        success=tally.reached / robots,
        complete=tally.complete / episodes,
        contacts=tally.contacts / robots,
        reward=tally.reward / robots,
        fast=record.fast,
        slow=record.slow,
    )
    success = _deciding(verdict, options)
    trials = {"targets": tally.targets, "all": tally.episodes}[options.success]
    rate = trials / (trials + _PRIOR_TRIALS)

    def moved(mean: Array, rate: Array) -> Array:
        return mean + rate * (success - mean)

    new = ~jnp.isfinite(record.fast)
    fast = moved(jnp.where(new, _PRIOR_SUCCESS, record.fast), rate)
    slow = jnp.where(new, fast, moved(jnp.where(new, fast, record.slow), _SLOWNESS * rate))
    verdict = verdict._replace(fast=fast, slow=slow)
    return jax.tree.map(lambda new, old: jnp.where(judged, new, old), verdict, record)


def _deciding(record: Record, options: CurriculumConfig) -> Array:
    """Returns the deciding success [S] of the newest verdicts."""
    return {"targets": record.success, "all": record.complete}[options.success]


def _next_cohort(curriculum: Curriculum, reason: Array, over: Array) -> Curriculum:
    """Begins a cohort if one is over or the mode decided something."""
    decided = reason != STAYED
    begins = over | decided
    empty = _no_episodes(curriculum.weights.shape[0])
    following = (curriculum.current, empty)
    current = (curriculum.previous, curriculum.current)
    previous, new = jax.tree.map(lambda a, b: jnp.where(begins, a, b), following, current)
    cohort = curriculum.cohort + begins
    return replace(
        curriculum,
        cohort=cohort,
        age=jnp.where(begins, 0, curriculum.age),
        since=jnp.where(decided, cohort, curriculum.since),
        previous=previous,
        current=new,
    )


def _settle(curriculum: Curriculum, schedule: Schedule, choice: StageChoice) -> Curriculum:
    """Applies a mode's choice."""
    robots = jnp.where(choice.weights > 0.0, jnp.asarray(schedule.stages.robots), 0)
    return replace(
        curriculum,
        stage=choice.stage,
        weights=choice.weights,
        met=jnp.maximum(curriculum.met, jnp.max(robots)),
    )
