"""The built-in curricula over stages: `sequential`, `mixed`, `adaptive` and `frontier`.

A mode is one pure function. After each update it gets the newest verdicts and returns the newest
stage, the share of the arenas on each stage, and the reason. A mode is also called before the first
update, without verdicts, and then returns the choice with which a run begins.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from swarmjax.config.foreign_code import explained
from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.curriculum.engine import (
    BY_BUDGET,
    BY_THRESHOLD,
    REWEIGHED,
    STAYED,
    CohortVerdict,
    Curriculum,
    CurriculumOutcomes,
    Record,
    Schedule,
    StageChoice,
    no_verdict,
)
from swarmjax.extension import OwnCurriculum
from swarmjax.task import extended

# Share of the arenas on earlier stages with `mixed`, and on learned stages with `frontier`. This
# project chose the value.
_EARLIER = 0.2
_UNKNOWN_LEARNABILITY = 0.25  # largest value of p (1 - p), so that unknown stages are tried
# The golden ratio in steps of 2**-32: no other number has multiples that fill the circle more
# evenly (Knuth, The Art of Computer Programming 3, section 6.4, multiplicative hashing, theorem S).
_GOLDEN = np.uint32(2654435769)


@struct.dataclass(kw_only=True)
class StagesState:
    """The state of a mode.

    Attributes:
      chosen: the stages that are trained now.
      turn: [] number of cohorts so far, int32.
      since: [] value of `turn` from which the newest decision holds, int32.
    """

    chosen: StageChoice
    turn: Array
    since: Array


Mode = Callable[[StagesState, Schedule, CurriculumConfig, CohortVerdict, Array], StageChoice]


def make(
    schedule: Schedule, options: CurriculumConfig, own: Sequence[OwnCurriculum] = ()
) -> Curriculum:
    """Makes the curriculum that the settings select.

    Args:
      schedule: the curriculum's stages, deadlines and thresholds.
      options: settings of the curriculum.
      own: curricula of an extension.
    """
    piece = {each.name: each for each in own}.get(options.mode)
    if piece is None:
        return _of_mode(schedule, options)
    guard = explained(f"{extended.label(piece)} fails")
    return Curriculum(*map(guard, guard(piece.function)(schedule)))


def _of_mode(schedule: Schedule, options: CurriculumConfig) -> Curriculum:
    """Makes a built-in curriculum."""
    mode, stages = MODES[options.mode], schedule.deadline.shape[0]

    def init() -> StagesState:
        zero = jnp.zeros((), jnp.int32)
        nothing = StageChoice(zero, jnp.zeros(stages), zero)
        blank = StagesState(chosen=nothing, turn=zero, since=zero)
        chosen = mode(blank, schedule, options, no_verdict(stages), zero - 1)
        return replace(blank, chosen=chosen)

    def choose(state: StagesState, key: Array, free: tuple[int, int]) -> Array:
        return jnp.tile(assign(state.chosen.weights, state.turn, free[1]), (free[0], 1))

    def observe(state: StagesState, outcomes: CurriculumOutcomes) -> StagesState:
        verdict = outcomes.verdict
        chosen = mode(state, schedule, options, verdict, outcomes.update)
        decided = chosen.reason != STAYED
        turn = state.turn + (verdict.over | decided)
        since = jnp.where(decided, turn, state.since)
        return StagesState(chosen=chosen, turn=turn, since=since)

    return Curriculum(init, choose, observe)


def assign(weights: Array, turn: Array, arenas: int) -> Array:
    """Chooses the stage [A] on which the next episode of each arena begins.

    The weights divide a line into stages. Arena a is at the point (a + u) / A of this line,
    with u within 0..1. So a stage's weight is its share of the arenas, and also its share of time.
    From cohort to cohort, u moves by the golden ratio. If there are few arenas, each arena visits
    every stage over time. If there are many arenas, most of them stay on their stage. Few arenas
    should move, because an arena that moves must wait until its episode ends. If all arenas moved,
    stages with long episodes would get more than their share.

    Args:
      weights: [S] share of the arenas on each stage.
      turn: [] number of cohorts so far.
      arenas: A.

    Returns:
      [A] int32, never a stage with weight 0.
    """
    turned = turn.astype(jnp.uint32) * _GOLDEN >> 8  # a float32 holds 24 bits
    point = (jnp.arange(arenas) + turned * np.float32(2.0**-24)) / arenas
    ends = jnp.cumsum(weights)
    inner = (ends / ends[-1])[:-1]
    stage = jnp.searchsorted(inner, point, side="right", method="compare_all")
    # The last point may round to 1. Without a limit it would lie behind all stages with a weight.
    last = jnp.max(jnp.where(weights > 0.0, jnp.arange(ends.shape[0]), 0))
    return jnp.minimum(stage, last).astype(jnp.int32)


def promoting(
    state: StagesState,
    schedule: Schedule,
    options: CurriculumConfig,
    verdict: CohortVerdict,
    update: Array,
) -> StageChoice:
    """Moves the arenas on to the next stage; `mixed` spreads some over earlier stages.

    The next stage begins when a whole cohort of the current stage has reached the threshold of this
    stage, or at the deadline of this stage. At least one step limit lies between two decisions.

    Args:
      state: state of the mode.
      schedule: the curriculum's stages, deadlines and thresholds.
      options: settings of the curriculum.
      verdict: what the cohorts show after the update.
      update: [] number of the finished update, from 0; -1 before the first.

    Returns:
      The choice from the next update on.
    """
    now, deadline = state.chosen.stage, jnp.asarray(schedule.deadline)
    last = now == deadline.shape[0] - 1
    whole = verdict.judged[now] & (state.turn - 1 >= state.since)
    settled = verdict.over | (state.turn > state.since)
    passed = whole & (verdict.success >= schedule.threshold)[now] & ~last
    expired = settled & (update + 1 >= deadline)[now] & ~last
    reason = jnp.where(passed, BY_THRESHOLD, jnp.where(expired, BY_BUDGET, STAYED))
    stage = now + (passed | expired)
    index = jnp.arange(state.chosen.weights.shape[0])
    share = jnp.where(stage > 0, _EARLIER if options.mode == "mixed" else 0.0, 0.0)
    earlier = jnp.where(index < stage, share / jnp.maximum(stage, 1), 0.0)
    weights = jnp.where(index == stage, 1.0 - share, earlier)
    return StageChoice(stage=stage, weights=weights, reason=reason.astype(jnp.int32))


def adaptive(
    state: StagesState,
    schedule: Schedule,
    options: CurriculumConfig,
    verdict: CohortVerdict,
    update: Array,
) -> StageChoice:
    """Trains all stages at once, with weights from their `score` and a floor for every stage.

    The weights are computed again after every cohort. The score `learnability` is p (1 - p), where
    p is the success. The reason is that nothing is learned where every episode succeeds or none
    does (Tzannetos et al. 2023, "Proximal Curriculum for Reinforcement Learning Agents",
    arXiv:2304.12877; Rutherford et al. 2024, "No Regrets: Investigating and Improving Regret
    Approximations for Curriculum Discovery", arXiv:2408.15099). `failure` is 1 - p, so a stage that
    never succeeds is practised most. `learnability` gives such a stage only the floor. `failure` is
    useful if all stages can be solved.

    Args:
      state: as in `promoting`.
      schedule: as in `promoting`.
      options: as in `promoting`.
      verdict: as in `promoting`.
      update: as in `promoting`.

    Returns:
      The choice from the next update on; its field `stage` is the last stage.
    """
    stages = state.chosen.weights.shape[0]
    score = _score(verdict.record, options.score)
    total = jnp.sum(score)
    share = jnp.where(total > 0.0, score / jnp.where(total > 0.0, total, 1.0), 1.0 / stages)
    floor = jnp.asarray(schedule.floor)
    weights = floor / stages + (1.0 - floor) * share
    if options.shares == "robots":
        # Choose shares of arenas so that each stage's share of the robots equals its weight.
        arenas = weights / jnp.asarray(schedule.stages.robots).astype(jnp.float32)
        weights = arenas / jnp.sum(arenas)
    judged = verdict.over & jnp.any(verdict.judged)
    return StageChoice(
        stage=jnp.full_like(state.chosen.stage, stages - 1),
        weights=jnp.where(verdict.over, weights, state.chosen.weights),
        reason=jnp.where(judged, REWEIGHED, STAYED).astype(jnp.int32),
    )


def frontier(
    state: StagesState,
    schedule: Schedule,
    options: CurriculumConfig,
    verdict: CohortVerdict,
    update: Array,
) -> StageChoice:
    """Trains the open stages that are not learned, and keeps some arenas on learned stages.

    A stage is learned while its running success is at least its `threshold`. It is open while all
    stages one step easier are learned. So success widens the frontier, failure narrows it, and the
    budget does not move it. The last stage stays in training once it is open. Widening each axis by
    its own success is the idea of automatic domain randomization (OpenAI 2019, "Solving Rubik's
    Cube with a Robot Hand", arXiv:1910.07113, section 5).

    Args:
      state: as in `promoting`.
      schedule: as in `promoting`.
      options: as in `promoting`.
      verdict: as in `promoting`.
      update: as in `promoting`.

    Returns:
      The choice from the next update on; its field `stage` is the last stage of the frontier.
    """
    stages = state.chosen.weights.shape[0]
    index, easier = jnp.arange(stages), jnp.asarray(schedule.easier)
    learned = (verdict.record.fast >= schedule.threshold) & (index < stages - 1)
    front = ~jnp.any(easier & ~learned, axis=-1) & ~learned
    kept = jnp.where(jnp.any(learned), _EARLIER, 0.0)
    weights = (1.0 - kept) * _evenly(front) + kept * _evenly(learned)
    floor = jnp.asarray(schedule.floor)
    weights = floor / stages + (1.0 - floor) * weights
    changed = verdict.over & jnp.any(weights != state.chosen.weights)
    return StageChoice(
        stage=jnp.max(jnp.where(front, index, 0)).astype(jnp.int32),
        weights=jnp.where(verdict.over, weights, state.chosen.weights),
        reason=jnp.where(changed & (update >= 0), REWEIGHED, STAYED).astype(jnp.int32),
    )


def _evenly(chosen: Array) -> Array:
    """Divides 1 evenly among the chosen stages [S]; all 0 if none is chosen."""
    return chosen / jnp.maximum(jnp.sum(chosen), 1)


def _score(record: Record, score: str) -> Array:
    """Returns the score [S] of each stage; a stage without a verdict has the largest score."""
    known, success = jnp.isfinite(record.fast), record.fast
    if score == "failure":
        return 1.0 - jnp.where(known, success, 0.0)
    return jnp.where(known, success * (1.0 - success), _UNKNOWN_LEARNABILITY)


MODES: dict[str, Mode] = {
    "sequential": promoting,
    "mixed": promoting,
    "adaptive": adaptive,
    "frontier": frontier,
}
