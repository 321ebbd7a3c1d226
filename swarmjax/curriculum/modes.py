"""The modes of the curriculum: each says from the record which stages are trained, and how much.

A mode is one pure function of the signature `engine.Mode`. It sees the curriculum with the
verdicts of the update just done, and returns the newest stage, the share of the arenas on each,
and why; asked before the first update, when nothing is known, it says where a run begins.
"""

import jax
import jax.numpy as jnp
from jax import Array

from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.curriculum.engine import (
    BY_BUDGET,
    BY_DEMOTION,
    BY_THRESHOLD,
    REWEIGHED,
    STAYED,
    CohortVerdict,
    Curriculum,
    Mode,
    Record,
    Schedule,
    StageChoice,
)

_UNKNOWN_LEARNABILITY = 0.25  # the most that p (1 - p) can be, so that what is unknown is tried


def sequential(
    curriculum: Curriculum,
    schedule: Schedule,
    options: CurriculumConfig,
    verdict: CohortVerdict,
    update: Array,
) -> StageChoice:
    """All arenas are on the newest stage, and go on to the next together, or back.

    A stage is left for the next when a whole cohort of it has reached `threshold`, or at its
    deadline; it gives way to the one before when a whole cohort has stayed below `demotion`, if
    that one's deadline is not past. No decision falls within a step limit of the last.

    Args:
      curriculum: where it stands, the newest verdicts in its record.
      schedule: the curriculum's numbers.
      options: what the config says of the curriculum.
      verdict: what the update brought to light.
      update: [] the update that has just been done, from 0; -1 before the first.

    Returns:
      What to do from the next update on.
    """
    stage, reason = _step(curriculum, schedule, verdict, update)
    weights = jax.nn.one_hot(stage, curriculum.weights.shape[0], dtype=jnp.float32)
    return StageChoice(stage=stage, weights=weights, reason=reason)


def mixed(
    curriculum: Curriculum,
    schedule: Schedule,
    options: CurriculumConfig,
    verdict: CohortVerdict,
    update: Array,
) -> StageChoice:
    """Decides as `sequential`, but keeps `earlier_share` of the arenas on earlier stages, evenly.

    Args:
      curriculum: as in `sequential`.
      schedule: likewise.
      options: likewise.
      verdict: likewise.
      update: likewise.

    Returns:
      What to do from the next update on.
    """
    stage, reason = _step(curriculum, schedule, verdict, update)
    index = jnp.arange(curriculum.weights.shape[0])
    share = jnp.where(stage > 0, jnp.asarray(schedule.earlier_share), 0.0)
    earlier = jnp.where(index < stage, share / jnp.maximum(stage, 1), 0.0)
    return StageChoice(
        stage=stage, weights=jnp.where(index == stage, 1.0 - share, earlier), reason=reason
    )


def adaptive(
    curriculum: Curriculum,
    schedule: Schedule,
    options: CurriculumConfig,
    verdict: CohortVerdict,
    update: Array,
) -> StageChoice:
    """All stages at once, weighed anew after every cohort by their `score`, none below the floor.

    `learnability` is p (1 - p), p the success: nothing is learned where all or nothing succeeds
    (Tzannetos et al. 2023, "Proximal Curriculum for Reinforcement Learning Agents",
    arXiv:2304.12877; Rutherford et al. 2024, "No Regrets: Investigating and Improving Regret
    Approximations for Curriculum Discovery", arXiv:2408.15099). `progress` is how far success has
    changed of late, for better or worse, so that what is forgotten comes back (Kanitscheider et
    al. 2021, arXiv:2106.14876). `failure` is 1 - p: where all stages can be solved, the one that
    never succeeds is practised most, which `learnability` leaves to the floor.

    With `prerequisites` the first stages of the sequence are practised alone, until all of them
    succeed at `threshold` or the deadline is past. What they teach is then there before the rest
    teaches something else.

    Args:
      curriculum: as in `sequential`.
      schedule: likewise.
      options: likewise.
      verdict: likewise.
      update: likewise.

    Returns:
      What to do from the next update on; the newest stage is the last that is practised.
    """
    assert options.score is not None  # an option of this mode: the config has filled it in
    stage, reason = _unlock(curriculum, schedule, options, verdict, update)
    practised = jnp.arange(curriculum.weights.shape[0]) <= stage
    count = jnp.sum(practised, dtype=jnp.float32)
    found = jnp.where(practised, _SCORES[options.score](curriculum.record), 0.0)
    total = jnp.sum(found)
    share = jnp.where(total > 0.0, found / jnp.where(total > 0.0, total, 1.0), 1.0 / count)
    floor = jnp.asarray(schedule.floor)
    weights = jnp.where(practised, floor / count + (1.0 - floor) * share, 0.0)
    if options.shares == "robots":
        weights = _per_robot(weights, jnp.asarray(schedule.stages.robots))
    return StageChoice(
        stage=stage,
        weights=jnp.where(verdict.over, weights, curriculum.weights),
        reason=reason,
    )


def _unlock(
    curriculum: Curriculum,
    schedule: Schedule,
    options: CurriculumConfig,
    verdict: CohortVerdict,
    update: Array,
) -> tuple[Array, Array]:
    """Returns the last stage that is practised, and why the weights change."""
    reweighed = jnp.where(verdict.over & jnp.any(verdict.judged), REWEIGHED, STAYED)
    last = jnp.full_like(curriculum.stage, curriculum.weights.shape[0] - 1)
    if not options.prerequisites:
        return last, reweighed.astype(jnp.int32)
    first = options.prerequisites
    passed = jnp.all(curriculum.record.fast[:first] >= schedule.threshold)
    late = update + 1 >= jnp.asarray(schedule.deadline)[first - 1]
    unlocked = curriculum.stage == last
    opens = verdict.over & (passed | late) & ~unlocked
    reason = jnp.where(opens, jnp.where(passed, BY_THRESHOLD, BY_BUDGET), reweighed)
    return jnp.where(unlocked | opens, last, first - 1), reason.astype(jnp.int32)


def _step(
    curriculum: Curriculum, schedule: Schedule, verdict: CohortVerdict, update: Array
) -> tuple[Array, Array]:
    """Returns the stage, one further or back or the same, and why."""
    stage, deadline = curriculum.stage, jnp.asarray(schedule.deadline)
    first, last = stage == 0, stage == deadline.shape[0] - 1
    whole = verdict.judged[stage] & (curriculum.cohort - 1 >= curriculum.since)
    success = verdict.success[stage]
    settled = verdict.over | (curriculum.cohort > curriculum.since)
    late = update + 1 >= deadline
    passed = whole & (success >= schedule.threshold) & ~last
    expired = settled & late[stage] & ~last
    failed = whole & (success < schedule.demotion) & ~first & ~late[stage - 1]
    reason = jnp.where(
        passed,
        BY_THRESHOLD,
        jnp.where(expired, BY_BUDGET, jnp.where(failed, BY_DEMOTION, STAYED)),
    ).astype(jnp.int32)
    return stage + (passed | expired) - (reason == BY_DEMOTION), reason


def _per_robot(weights: Array, robots: Array) -> Array:
    """Turns shares of robots [S] into the shares of arenas that give them."""
    arenas = weights / robots.astype(jnp.float32)
    return arenas / jnp.sum(arenas)


def _learnability(record: Record) -> Array:
    return jnp.where(
        jnp.isnan(record.fast), _UNKNOWN_LEARNABILITY, record.fast * (1.0 - record.fast)
    )


def _progress(record: Record) -> Array:
    """Returns |fast - slow|, and the most that is known for stages that nothing is known of."""
    known = ~jnp.isnan(record.progress)
    most = jnp.max(jnp.where(known, record.progress, 0.0))
    unknown = jnp.where(jnp.any(known), most, 1.0)
    return jnp.where(known, record.progress, unknown)


def _failure(record: Record) -> Array:
    return 1.0 - jnp.where(jnp.isnan(record.fast), 0.0, record.fast)


_SCORES = {"learnability": _learnability, "progress": _progress, "failure": _failure}
MODES: dict[str, Mode] = {"sequential": sequential, "mixed": mixed, "adaptive": adaptive}
