"""The curriculum's engine: where each arena begins, how each stage goes, when something is decided.

All of it on device, for any mode of `modes.py`. Episodes are counted in cohorts: all those
that began within one step limit. A cohort's verdict falls another step limit later, when the last
of its episodes has ended; the short episodes that end first are the lucky ones, and would promote
too early. An episode counts for the stage and the cohort in which it began.
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
NEVER = np.iinfo(np.int32).max  # a deadline

# Of the golden ratio, in steps of 2**-32: the multiples of it fill the circle as evenly as any
# (Knuth, The Art of Computer Programming 3, section 6.4, multiplicative hashing, theorem S).
_GOLDEN = np.uint32(2654435769)
# A verdict on n trials moves `fast` by n / (n + 20) of the way: as if 20 trials had been seen that
# came out as before, so that a few episodes do not overturn what many have said.
_PRIOR_TRIALS = 20.0
# What those trials are before the first verdict: half a success, where p (1 - p) is largest.
_PRIOR_SUCCESS = 0.5
# `slow` moves a fifth as fast: it lags about five verdicts behind, and |fast - slow| is how far
# success has come since (the learning progress of Kanitscheider et al. 2021, "Multi-task
# curriculum learning in a complex, visual, hard-exploration domain: Minecraft", arXiv:2106.14876,
# which takes it between a fast and a slow mean, in both directions). The two rates are this
# project's choice.
_SLOWNESS = 0.2


class Schedule(NamedTuple):
    """The curriculum's numbers: an argument of the compiled program, so that none is fixed in it.

    Those that a mode does not have are nan, or `NEVER`.

    Attributes:
      stages: [S], in order.
      deadline: [S] update at which the stage is left in any case, int32.
      threshold: [] success that promotes.
      demotion: [] success below which the stage before returns; -1: never.
      earlier_share: [] share of the arenas on earlier stages.
      floor: [] share of the arenas that is spread evenly over all stages.
      cohort_updates: [] updates that hold one step limit, int32.
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
    """Episodes of one cohort that have ended, by the stage on which they began, [S] each.

    Attributes:
      episodes: how many, int32.
      targets: robots that took part, int32.
      reached: robots that arrived, int32.
      complete: episodes in which every robot arrived, int32.
      contacts: of all kinds, over all robots, int32.
      reward: sum over all robots, float32.
    """

    episodes: Array
    targets: Array
    reached: Array
    complete: Array
    contacts: Array
    reward: Array


class Record(NamedTuple):
    """How each stage goes, [S] each; nan, and 0 episodes, before its first verdict.

    Attributes:
      episodes: of the newest verdict, int32.
      success: share of its targets that were reached.
      complete: share of its episodes in which every robot arrived.
      contacts: per robot.
      reward: per robot.
      fast: running mean of the success that decides.
      slow: the same, five times as slow.
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
        """How far the success that decides has come, or gone back, of late, [S]."""
        return jnp.abs(self.fast - self.slow)


@struct.dataclass(kw_only=True)
class Curriculum:
    """Where the curriculum stands.

    Attributes:
      stage: [] index of the newest stage, int32.
      weights: [S] share of the arenas on each stage, float32.
      cohort: [] number of the cohort that episodes now begin in, int32.
      age: [] updates since that cohort began, int32.
      since: [] cohort with which the newest decision took effect, int32.
      current: episodes of this cohort that have ended.
      previous: those of the one before.
      record: how each stage goes.
      met: [] the most robots that any stage has had so far, int32.
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
    """What an update brought to light.

    Attributes:
      over: [] whether a cohort is over, and with it all episodes of the one before.
      judged: [S] whether the cohort before had episodes on the stage, all False unless `over`.
      success: [S] the success that decides, of each stage's newest verdict; nan before.
    """

    over: Array
    judged: Array
    success: Array


class StageChoice(NamedTuple):
    """What a mode chose.

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
      reason: [] of `REASONS`, int32.
      stage: [] index of the stage that was the newest, int32.
      next_stage: [] index of the one that is now, int32.
      success: [] the success that decides, of the newest verdict on `stage`; nan before.
    """

    reason: Array
    stage: Array
    next_stage: Array
    success: Array

    @property
    def promoted(self) -> Array:
        """Whether a stage was left for the next one, []."""
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
    """Works the curriculum's numbers out.

    The stages before the last share `budget_share` of the updates in equal parts; prerequisites
    may take all of it.

    Args:
      stages: S, in order.
      options: what the config says of the curriculum.
      updates: of the whole run.
      step_limit: control steps of an episode, at most.
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
    """After how many updates the last stage begins at the latest: by the deadlines alone.

    Each decision waits for one step limit after the one before.

    Args:
      schedule: the curriculum's numbers.

    Returns:
      Updates; 0 for a single stage, `NEVER` or more where a stage has no deadline.
    """
    begins = 0
    for deadline in np.asarray(schedule.deadline)[:-1].tolist():
        begins = max(deadline, begins + int(schedule.cohort_updates))
    return begins


def _number(value: float | None, absent: float) -> np.float32:
    return np.float32(absent if value is None else value)


def init(schedule: Schedule, options: CurriculumConfig, mode: Mode) -> Curriculum:
    """Starts where the mode puts those of whom nothing is known.

    Args:
      schedule: the curriculum's numbers.
      options: what the config says of the curriculum.
      mode: one of `modes.MODES`.

    Returns:
      The curriculum before the first update.
    """
    stages = schedule.deadline.shape[0]
    zero, unknown = jnp.zeros((), jnp.int32), jnp.full(stages, jnp.nan, jnp.float32)
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
    """Begins a cohort where all arenas are drawn again, so that open episodes are not waited for.

    Args:
      curriculum: where it stands; what it has measured and decided stays.

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
    """Says on which stage [A] the next episode of each arena begins.

    The arenas are spread over the stages like the points (a + u) / A of a line that the weights
    divide, so that the share of arenas on a stage, and with it of the time, is its weight. From
    cohort to cohort u moves on by the golden ratio: few arenas come round to every stage, while
    many stay where they are. (An arena that moves waits for its episode to end; if all moved, the
    stages of long episodes would hold more than their share.)

    Args:
      curriculum: where it stands.
      arenas: A.

    Returns:
      [A] int32, never a stage without weight.
    """
    turned = curriculum.cohort.astype(jnp.uint32) * _GOLDEN >> 8  # what a float32 holds of it
    point = (jnp.arange(arenas) + turned * np.float32(2.0**-24)) / arenas
    ends = jnp.cumsum(curriculum.weights)
    inner = (ends / ends[-1])[:-1]
    stage = jnp.searchsorted(inner, point, side="right", method="compare_all")
    # The last point may round to 1, and would fall behind all stages that have weight.
    last = jnp.max(jnp.where(curriculum.weights > 0.0, jnp.arange(ends.shape[0]), 0))
    return jnp.minimum(stage, last).astype(jnp.int32)


def count(curriculum: Curriculum, ended: Ended, shards: Shards = ALONE) -> Curriculum:
    """Adds episodes that have ended to the cohort and the stage in which they began.

    Args:
      curriculum: before.
      ended: [T, A]; episodes of any other cohort than the last two are left out.
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
    """Moves the cohorts on by one update, judges the one that has ended and lets the mode decide.

    A decision begins a new cohort at once.

    Args:
      curriculum: after `count`.
      schedule: the curriculum's numbers.
      options: what the config says of the curriculum.
      mode: one of `modes.MODES`.
      update: [] the update that has just been done, from 0.

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
    """Writes a whole cohort down for the stages [S] that it had episodes on."""
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

    new = jnp.isnan(record.fast)
    fast = moved(jnp.where(new, _PRIOR_SUCCESS, record.fast), rate)
    slow = jnp.where(new, fast, moved(record.slow, _SLOWNESS * rate))
    verdict = verdict._replace(fast=fast, slow=slow)
    return jax.tree.map(lambda new, old: jnp.where(judged, new, old), verdict, record)


def _deciding(record: Record, options: CurriculumConfig) -> Array:
    """Returns the success [S] of the newest verdicts that the curriculum decides by."""
    return {"targets": record.success, "all": record.complete}[options.success]


def _next_cohort(curriculum: Curriculum, reason: Array, over: Array) -> Curriculum:
    """Begins a cohort, where one is over or something was decided."""
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
    """Takes a mode's choice over."""
    robots = jnp.where(choice.weights > 0.0, jnp.asarray(schedule.stages.robots), 0)
    return replace(
        curriculum,
        stage=choice.stage,
        weights=choice.weights,
        met=jnp.maximum(curriculum.met, jnp.max(robots)),
    )
