"""The curriculum's decisions, worked out by hand."""

import dataclasses
import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax import curriculum
from swarmjax.config import CurriculumConfig, StageConfig, TaskConfig, TrainConfig
from swarmjax.curriculum import BY_BUDGET, BY_THRESHOLD, STAYED, Curriculum, Schedule

LATE = np.iinfo(np.int32).max


class Row(NamedTuple):
    """What one update saw and decided."""

    reason: int
    judged: int
    success: float
    stage: int
    cohort: int


def _config(base: TrainConfig, stages: int, **changes: object) -> TrainConfig:
    """Stages of 16 steps at 8 steps an update: a cohort is two updates. 20 updates in all."""
    chosen = tuple(StageConfig(name=f"s{i}", robots=1 + i % 3, side=0.8) for i in range(stages))
    return dataclasses.replace(base, stage=chosen, **changes)


@pytest.fixture
def schedule(tiny_config: TrainConfig) -> Schedule:
    """Three stages, left after updates 5 and 10 at the latest."""
    return curriculum.schedule(_config(tiny_config, 3))


def _late(schedule: Schedule) -> Schedule:
    """The same without deadlines."""
    return schedule._replace(deadline=np.full(len(schedule.deadline), LATE, np.int32))


def _run(
    schedule: Schedule, seen: list[list[tuple[int, int, int]]], first: int = 0
) -> tuple[Curriculum, list[Row]]:
    """Updates that each see episodes of (cohort, targets, reached); a negative cohort counts
    from the one that is current."""
    state, rows = curriculum.init(), []
    for update, episodes in enumerate(seen, first):
        number = [c if c >= 0 else int(state.cohort) + c + 1 for c, _, _ in episodes]
        cohort = jnp.array(number, jnp.int32)
        targets = jnp.array([t for _, t, _ in episodes], jnp.int32)
        reached = jnp.array([r for _, _, r in episodes], jnp.int32)
        state = curriculum.count(state, cohort, targets, reached)
        state, decision = curriculum.advance(state, schedule, jnp.int32(update))
        rows.append(
            Row(
                int(decision.reason),
                int(decision.stage),
                float(decision.success),
                int(state.stage),
                int(state.cohort),
            )
        )
    return state, rows


NOW, BEFORE = -1, -2  # the current cohort, and the one before
PERFECT = [(NOW, 10, 10)]


def test_schedule(tiny_config: TrainConfig) -> None:
    found = curriculum.schedule(_config(tiny_config, 3))
    assert found.stages.robots.tolist() == [1, 2, 3]
    # Half of 20 updates in two equal parts; the last stage has no end.
    assert found.deadline.tolist() == [5, 10, LATE]
    assert found.threshold == np.float32(0.8)
    assert found.cohort_updates == 2  # 16 steps, 8 an update


def test_schedule_rounds_up(tiny_config: TrainConfig) -> None:
    config = _config(
        tiny_config,
        4,
        task=TaskConfig(step_limit=17),
        curriculum=CurriculumConfig(budget_share=0.4, threshold=0.5),
    )
    found = curriculum.schedule(config)
    # 0.4 of 20 updates, 8, in three parts: 2.67, 5.33, 8.
    assert found.deadline.tolist() == [3, 6, 8, LATE]
    assert found.cohort_updates == 3  # 17 steps take more than two updates of 8
    assert found.threshold == 0.5


def test_schedule_of_one_stage(tiny_config: TrainConfig) -> None:
    assert curriculum.schedule(_config(tiny_config, 1)).deadline.tolist() == [LATE]


def test_start_and_assignment() -> None:
    state = curriculum.init()
    assert (int(state.stage), int(state.cohort), int(state.age)) == (0, 0, 0)
    assert math.isnan(float(state.success))
    assert curriculum.assign(state, 3).tolist() == [0, 0, 0]
    assert curriculum.assign(dataclasses.replace(state, stage=jnp.int32(2)), 2).tolist() == [2, 2]


def test_episodes_count_for_the_cohort_in_which_they_began() -> None:
    state = dataclasses.replace(curriculum.init(), cohort=jnp.int32(5))
    cohort = jnp.array([[5, 4, 3], [5, -1, 6]])
    targets = jnp.array([[2, 3, 5], [2, 0, 7]])
    reached = jnp.array([[1, 3, 5], [2, 0, 7]])
    state = curriculum.count(state, cohort, targets, reached)
    state = curriculum.count(state, cohort, targets, reached)
    assert [int(x) for x in state.current] == [2 * (2 + 2), 2 * (1 + 2)]
    assert [int(x) for x in state.previous] == [2 * 3, 2 * 3]


def test_no_decision_before_two_step_limits(schedule: Schedule) -> None:
    # Cohort 0 begins in updates 0 and 1; the last of its episodes end in updates 2 and 3.
    _, rows = _run(_late(schedule), [PERFECT] * 4)
    assert [row.reason for row in rows] == [STAYED, STAYED, STAYED, BY_THRESHOLD]
    assert [row.stage for row in rows] == [0, 0, 0, 1]
    assert [row.cohort for row in rows] == [0, 1, 1, 3]
    assert [math.isnan(row.success) for row in rows] == [True, True, True, False]
    assert rows[3].success == 1.0
    assert [row.judged for row in rows] == [0, 0, 0, 0]


@pytest.mark.parametrize(("reached", "reason"), [(8, BY_THRESHOLD), (7, STAYED)])
def test_threshold(schedule: Schedule, reached: int, reason: int) -> None:
    # 8 of 10 are the threshold itself.
    _, rows = _run(_late(schedule), [[(NOW, 10, reached)], [], [], []])
    assert rows[3].reason == reason
    assert rows[3].success == np.float32(reached / 10)


def test_late_episodes_of_a_cohort_count_for_it(schedule: Schedule) -> None:
    # The lucky ones end first: 9 of 10 in update 0; then 0 of 10 in update 3, of cohort 0 too.
    seen = [[(NOW, 10, 9)], [], [(NOW, 50, 50)], [(BEFORE, 10, 0)]]
    state, rows = _run(_late(schedule), seen)
    assert rows[3].reason == STAYED
    assert rows[3].success == np.float32(9 / 20)
    # The next cohort, which saw 50 of 50, is judged a step limit later.
    assert [int(x) for x in state.previous] == [50, 50]
    _, rows = _run(_late(schedule), [*seen, [], []])
    assert [row.reason for row in rows[4:]] == [STAYED, BY_THRESHOLD]
    assert [row.success for row in rows[4:]] == [np.float32(9 / 20), 1.0]


def test_a_cohort_without_episodes_decides_nothing(schedule: Schedule) -> None:
    _, rows = _run(_late(schedule), [[]] * 8)
    assert {row.reason for row in rows} == {STAYED}
    assert all(math.isnan(row.success) for row in rows)
    assert [row.cohort for row in rows] == [0, 1, 1, 2, 2, 3, 3, 4]


def test_episodes_of_the_stage_that_was_left_count_no_more(schedule: Schedule) -> None:
    # Left in update 3, from cohort 1. Its perfect episodes go on ending for a step limit.
    old = [(0, 10, 10), (1, 10, 10)]
    state, rows = _run(_late(schedule), [PERFECT] * 4 + [old, old])
    assert rows[3].stage == 1
    assert [int(x) for x in (*state.current, *state.previous)] == [0, 0, 0, 0]
    assert math.isnan(rows[4].success)
    # Nothing of the new stage is judged before two step limits of its own, and then only it.
    new = [*old, (NOW, 10, 3)]
    _, rows = _run(_late(schedule), [PERFECT] * 4 + [new] * 4)
    assert [row.reason for row in rows[4:]] == [STAYED] * 4
    assert [row.judged for row in rows[4:]] == [1] * 4
    assert all(math.isnan(row.success) for row in rows[4:7])
    assert rows[7].success == np.float32(6 / 20)


def test_deadline(schedule: Schedule) -> None:
    _, rows = _run(schedule, [[]] * 12)
    # After 5 and 10 updates, which are numbers 4 and 9.
    expected = [BY_BUDGET if update in (4, 9) else STAYED for update in range(12)]
    assert [row.reason for row in rows] == expected
    assert [row.stage for row in rows] == [0] * 4 + [1] * 5 + [2] * 3
    assert math.isnan(rows[4].success)


def test_deadline_reports_what_was_measured(schedule: Schedule) -> None:
    _, rows = _run(schedule, [[(NOW, 10, 5)]] + [[]] * 4)
    assert (rows[4].reason, rows[4].judged, rows[4].success) == (BY_BUDGET, 0, 0.5)


def test_threshold_goes_before_deadline(schedule: Schedule) -> None:
    at_once = schedule._replace(deadline=np.array([4, 10, LATE], np.int32))
    _, rows = _run(at_once, [PERFECT] * 4)
    assert rows[3].reason == BY_THRESHOLD


def test_a_stage_entered_late_is_left_at_its_own_deadline(schedule: Schedule) -> None:
    # All deadlines are past: a stage an update, until the last.
    _, rows = _run(schedule, [[]] * 4, first=50)
    assert [row.reason for row in rows] == [BY_BUDGET, BY_BUDGET, STAYED, STAYED]
    assert [row.stage for row in rows] == [1, 2, 2, 2]


def test_the_last_stage_stays(tiny_config: TrainConfig) -> None:
    schedule = curriculum.schedule(_config(tiny_config, 1))
    _, rows = _run(schedule, [PERFECT] * 8, first=1000)
    assert {(row.reason, row.stage) for row in rows} == {(STAYED, 0)}
    assert [row.success for row in rows[3:]] == [1.0] * 5  # measured nevertheless


def test_log() -> None:
    rows = [
        {"update": 3, "decision": BY_THRESHOLD, "decided_stage": 0, "stage_success": 0.9},
        {"update": 4, "decision": STAYED, "decided_stage": 1, "stage_success": 0.1},
        {"update": 9, "decision": BY_BUDGET, "decided_stage": 1, "stage_success": 0.25},
    ]
    assert curriculum.log(rows, ["a", "b", "c"]) == [
        {"update": 3, "from": "a", "to": "b", "why": "threshold", "targets_reached": 0.9},
        {"update": 9, "from": "b", "to": "c", "why": "budget", "targets_reached": 0.25},
    ]
