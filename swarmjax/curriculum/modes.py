"""The modes of the curriculum: each decides which stages are trained, and how much.

A mode is one pure function of the signature `engine.Mode`. After each update a mode gets the
curriculum with its newest verdicts, and returns the newest stage, the share of the arenas on each
stage, and the reason. A mode is also called before the first update, without verdicts, and then
returns where a run begins.
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

_UNKNOWN_LEARNABILITY = 0.25  # largest value of p (1 - p), so that unknown stages are tried


def sequential(
    curriculum: Curriculum,
    schedule: Schedule,
    options: CurriculumConfig,
    verdict: CohortVerdict,
    update: Array,
) -> StageChoice:
    """Puts all arenas on the newest stage, and moves all of them on to the next stage or back.

    The next stage begins when a whole cohort of the current stage has reached `threshold`, or at
    the stage's deadline. If a whole cohort has stayed below `demotion`, the previous stage returns,
    unless its deadline is past. At least one step limit lies between two decisions.

    Args:
      curriculum: state of the curriculum; its record has the newest verdicts.
      schedule: the curriculum's numbers.
      options: settings of the curriculum.
      verdict: findings of the update.
      update: [] number of the finished update, from 0; -1 before the first.

    Returns:
      The choice from the next update on.
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
      schedule: as in `sequential`.
      options: as in `sequential`.
      verdict: as in `sequential`.
      update: as in `sequential`.

    Returns:
      The choice from the next update on.
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
    """Trains all stages at once, with weights from their `score` and a floor for every stage.

    The weights are computed again after every cohort. The score `learnability` is p (1 - p), where
    p is the success. The reason is that nothing is learned where every episode succeeds or none
    does (Tzannetos et al. 2023, "Proximal Curriculum for Reinforcement Learning Agents",
    arXiv:2304.12877; Rutherford et al. 2024, "No Regrets: Investigating and Improving Regret
    Approximations for Curriculum Discovery", arXiv:2408.15099). `progress` is how far success has
    recently risen or fallen, so that forgotten stages come back (Kanitscheider et al. 2021,
    arXiv:2106.14876). `failure` is 1 - p, so a stage that never succeeds is practised most.
    `learnability` gives such a stage only the floor. `failure` is useful if all stages can be
    solved.

    With `prerequisites` the first stages of the sequence are practised alone, until all of them
    reach `threshold` or the deadline is past. Their skills are then learned before the other stages
    teach different ones.

    Args:
      curriculum: as in `sequential`.
      schedule: as in `sequential`.
      options: as in `sequential`.
      verdict: as in `sequential`.
      update: as in `sequential`.

    Returns:
      The choice from the next update on; its newest stage is the last one that is practised.
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
    """Returns the last stage that is practised, and the reason for a change of weights."""
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
    """Returns the next, the previous or the same stage, and the reason."""
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
        jnp.isfinite(record.fast), record.fast * (1.0 - record.fast), _UNKNOWN_LEARNABILITY
    )


def _progress(record: Record) -> Array:
    """Returns |fast - slow|; stages without a verdict get the largest value of the other stages."""
    known = jnp.isfinite(record.progress)
    most = jnp.max(jnp.where(known, record.progress, 0.0))
    unknown = jnp.where(jnp.any(known), most, 1.0)
    return jnp.where(known, record.progress, unknown)


def _failure(record: Record) -> Array:
    return 1.0 - jnp.where(jnp.isfinite(record.fast), record.fast, 0.0)


_SCORES = {"learnability": _learnability, "progress": _progress, "failure": _failure}
MODES: dict[str, Mode] = {"sequential": sequential, "mixed": mixed, "adaptive": adaptive}
