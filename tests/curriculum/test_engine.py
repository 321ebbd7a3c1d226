"""Checks the curriculum's counts and its decisions in mode `sequential` against values by hand."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from curricula import observe
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmjax.curriculum import engine, stages
from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.curriculum.engine import (
    BY_BUDGET,
    BY_THRESHOLD,
    NEVER,
    REWEIGHED,
    STAYED,
    UNKNOWN,
    CurriculumState,
    Schedule,
)
from swarmjax.curriculum.log import log
from swarmjax.run.settings import TrainConfig
from swarmjax.task.config import TaskConfig
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import program as programs
from swarmjax.training.rollout import Ended

OPTIONS = CurriculumConfig(mode="sequential")
NOW, BEFORE = -1, -2  # the current cohort, and the one before


class Episode(NamedTuple):
    """Ended episodes. A negative cohort counts back from the current cohort, which is -1."""

    cohort: int
    targets: int = 10
    reached: int = 10
    stage: int | None = None  # None: the newest
    episodes: int = 1
    complete: int = 0
    contacts: tuple[int, int, int] = (0, 0, 0)
    reward: float = 0.0


class Row(NamedTuple):
    """The decision of one update.

    `judged` is the stage before the decision, and `success` the newest success on this stage.
    """

    reason: int
    judged: int
    success: float
    stage: int
    cohort: int


PERFECT = [Episode(NOW)]


def _config(base: TrainConfig, stages: int, **changes: object) -> TrainConfig:
    """Returns a config with this many stages and 20 updates.

    A step limit of 16 steps at 8 steps an update makes a cohort last two updates.
    """
    chosen = tuple(StageConfig(name=f"s{i}", robots=1 + i % 3, side=0.8) for i in range(stages))
    return dataclasses.replace(base, stage=chosen, **changes)


@pytest.fixture
def schedule(tiny_config: TrainConfig) -> Schedule:
    """Returns a schedule of three stages; two end after 5 and 10 updates at the latest."""
    return programs.schedule(_config(tiny_config, 3))


def _late(schedule: Schedule) -> Schedule:
    """Returns the schedule without deadlines."""
    return schedule._replace(deadline=np.full(len(schedule.deadline), NEVER, np.int32))


def _start(schedule: Schedule, options: CurriculumConfig = OPTIONS) -> CurriculumState:
    return engine.init(stages.make(schedule, options), schedule)


def _ended(state: CurriculumState, episodes: list[Episode]) -> Ended:
    """Lays episodes out as one step [1, N]."""
    rows = []
    for e in episodes:
        cohort = e.cohort if e.cohort >= 0 else int(state.cohorts.number) + e.cohort + 1
        stage = int(state.chosen.stage) if e.stage is None else e.stage
        rows.append(e._replace(cohort=cohort, stage=stage))
    whole = Episode(*(jnp.array([column]) for column in zip(*rows, strict=True)))
    none = jnp.zeros_like(whole.cohort)
    return Ended(
        episodes=whole.episodes,
        stage=whole.stage,
        cohort=whole.cohort,
        targets=whole.targets,
        reached=whole.reached,
        all_reached=whole.complete,
        steps=none,
        robot_steps=none,
        sensed=none,
        contacts=whole.contacts,
        reward=whole.reward,
        broken=none,
    )


def _run(
    schedule: Schedule,
    seen: list[list[Episode]],
    first: int = 0,
    options: CurriculumConfig = OPTIONS,
) -> tuple[CurriculumState, list[Row]]:
    """Runs updates, in each of which the given episodes end."""
    state, rows = _start(schedule, options), []
    for update, episodes in enumerate(seen, first):
        # An episode of no cohort stands for an update without episodes.
        ended = _ended(state, episodes or [Episode(engine.UNCOUNTED - 10)])
        before, state = state, observe(options, schedule, state, ended, update)
        judged = int(before.chosen.stage)
        success = state.cohorts.record.deciding(options.success)[judged]
        numbers = int(state.chosen.stage), int(state.cohorts.number)
        rows.append(Row(int(state.chosen.reason), judged, float(success), *numbers))
    return state, rows


# --- numbers


def test_schedule(tiny_config: TrainConfig) -> None:
    found = programs.schedule(_config(tiny_config, 3, curriculum=OPTIONS))
    assert found.stages.robots.tolist() == [1, 2, 3]
    # Half of 20 updates is split into two equal parts; the last stage has no deadline.
    assert found.deadline.tolist() == [5, 10, NEVER]
    assert found.threshold.tolist() == [np.float32(0.8)] * 3
    assert found.cohort_updates == 2  # 16 steps, 8 an update


def test_schedule_rounds_up(tiny_config: TrainConfig) -> None:
    config = _config(
        tiny_config,
        4,
        task=TaskConfig(step_limit=17),
        curriculum=CurriculumConfig(budget_share=0.4, threshold=(0.5, 0.75, 0.25, 1.0)),
    )
    found = programs.schedule(config)
    # 0.4 of 20 updates is 8 updates, in three parts that end at 2.67, 5.33 and 8.
    assert found.deadline.tolist() == [3, 6, 8, NEVER]
    assert found.cohort_updates == 3  # 17 steps take more than two updates of 8
    assert found.threshold.tolist() == [0.5, 0.75, 0.25, 1.0]


def test_schedule_of_the_other_modes(tiny_config: TrainConfig) -> None:
    mixed = programs.schedule(_config(tiny_config, 3, curriculum=CurriculumConfig(mode="mixed")))
    assert mixed.deadline.tolist() == [5, 10, NEVER]
    adaptive = programs.schedule(
        _config(tiny_config, 3, curriculum=CurriculumConfig(mode="adaptive", floor=0.5))
    )
    assert adaptive.floor == 0.5
    assert adaptive.deadline.tolist() == [NEVER] * 3


def test_schedule_of_one_stage(tiny_config: TrainConfig) -> None:
    assert programs.schedule(_config(tiny_config, 1)).deadline.tolist() == [NEVER]


@pytest.mark.parametrize(
    ("mode", "stage", "weights", "met"),
    [
        ("sequential", 0, [1.0, 0.0, 0.0], 1),
        ("mixed", 0, [1.0, 0.0, 0.0], 1),
        ("adaptive", 2, [1 / 3] * 3, 3),
    ],
)
def test_start(
    tiny_config: TrainConfig, mode: str, stage: int, weights: list[float], met: int
) -> None:
    options = CurriculumConfig(mode=mode)  # type: ignore[arg-type]  # one of the literals
    schedule = programs.schedule(_config(tiny_config, 3, curriculum=options))
    state = _start(schedule, options)
    assert (int(state.chosen.stage), int(state.met)) == (stage, met)
    assert (int(state.cohorts.number), int(state.cohorts.age)) == (0, 0)
    np.testing.assert_allclose(state.chosen.weights, weights, rtol=1e-6)  # rounding of float32
    assert all((column == UNKNOWN).all() for column in state.cohorts.record[1:])
    assert not any(np.any(column) for column in (*state.cohorts.current, *state.cohorts.previous))


# --- the stages on which arenas begin


def _assign(weights: Sequence[float] | np.ndarray, turn: int, arenas: int) -> jax.Array:
    return stages.assign(jnp.array(weights, jnp.float32), jnp.int32(turn), arenas)


@pytest.mark.parametrize("stage", [0, 1, 2])
def test_all_weight_on_one_stage(stage: int) -> None:
    weights = np.eye(3)[stage].tolist()
    for cohort in range(50):
        found = _assign(weights, cohort, 7)
        assert found.tolist() == [stage] * 7


def test_assign_by_hand() -> None:
    # The points are (a + u) / 3 with u = 0.618, 0.236 and 0.854; stages end at 0.2 and 0.5.
    for cohort, expected in ((1, [1, 2, 2]), (2, [0, 1, 2]), (3, [1, 2, 2])):
        # The points by cohort: 0.206, 0.539, 0.873; 0.079, 0.412, 0.745; 0.285, 0.618, 0.951.
        found = _assign([0.2, 0.3, 0.5], cohort, 3)
        assert found.tolist() == expected


def test_a_point_on_the_border_is_of_the_stage_that_begins_there() -> None:
    # The points are exactly 0, 0.25, 0.5 and 0.75.
    found = _assign([0.25, 0.5, 0.25], 0, 4)
    assert found.tolist() == [0, 1, 1, 2]


def test_a_point_that_rounds_to_one_is_of_the_last_stage_that_has_weight() -> None:
    # In cohort 377 u is 0.9995, and (65535 + u) / 65536 is 1 in float32.
    found = _assign([1.0, 0.0, 0.0], 377, 65536)
    assert not found.any()


def test_many_arenas_stay_on_their_stage() -> None:
    weights = [0.2, 0.3, 0.5]
    found = [_assign(weights, cohort, 1000) for cohort in range(20)]
    # The 1000 points are a thousandth apart, so only the points beside the two borders can change
    # their stage.
    assert (np.ptp(found, axis=0) > 0).sum() <= 2


WEIGHTS = st.lists(st.floats(0.0, 1.0, allow_subnormal=False), min_size=1, max_size=48)


@settings(max_examples=30)
@given(
    raw=WEIGHTS.filter(lambda raw: sum(raw) > 0.01),
    arenas=st.sampled_from([1, 4, 128, 1000]),
    cohort=st.integers(0, 10**6),
)
def test_the_share_of_arenas_is_the_weight(raw: list[float], arenas: int, cohort: int) -> None:
    weights = np.array(raw, np.float32) / np.float32(sum(raw))
    assigned = np.asarray(_assign(weights, cohort, arenas))
    share = np.bincount(assigned, minlength=len(raw)) / arenas
    # The points are evenly spaced on a circle, so an arc holds its share of them, plus or minus
    # one. 1e-5: the float32 sum of up to 48 weights.
    assert (np.abs(share - weights) <= 1 / arenas + 1e-5).all()
    assert not share[weights == 0.0].any()


def test_few_arenas_come_round_to_every_stage() -> None:
    even = np.full(36, 1 / 36, np.float32)
    assign = jax.jit(lambda turn: stages.assign(jnp.asarray(even), turn, 2))
    turns = np.zeros(36, int)
    for cohort in range(200):
        turns += np.bincount(assign(jnp.int32(cohort)), minlength=36)
    # Each stage gets 2 * 200 / 36 = 11.1 turns. With multiples of the golden ratio, the number of
    # points in an arc is off by fewer than 2 of 200 points (Weyl sequences of bounded type: at most
    # of order log 200).
    assert turns.min() >= 9
    assert turns.max() <= 13


# --- what is counted


def test_episodes_count_for_the_cohort_and_the_stage_in_which_they_began() -> None:
    state = dataclasses.replace(engine.init_cohorts(3), number=jnp.int32(5))
    ended = Ended(
        episodes=jnp.array([[1, 1, 1], [1, 0, 1]]),
        stage=jnp.array([[0, 2, 2], [2, 0, 1]]),
        cohort=jnp.array([[5, 4, 3], [5, -1, 6]]),
        targets=jnp.array([[2, 3, 5], [4, 0, 7]]),
        reached=jnp.array([[1, 3, 5], [2, 0, 7]]),
        all_reached=jnp.array([[0, 1, 1], [0, 0, 1]]),
        steps=jnp.ones((2, 3), jnp.int32),
        robot_steps=jnp.ones((2, 3), jnp.int32),
        sensed=jnp.ones((2, 3), jnp.int32),
        contacts=jnp.arange(18).reshape(2, 3, 3),
        reward=jnp.array([[0.5, 1.5, 9.0], [-2.0, 0.0, 9.0]]),
        broken=jnp.zeros((2, 3), jnp.int32),
    )
    state = engine.count(engine.count(state, ended), ended)  # counted twice
    current = [column.tolist() for column in state.current]
    # The first arena has 0 + 1 + 2 contacts in the first step, and 9 + 10 + 11 in the second.
    assert current == [[2, 0, 2], [4, 0, 8], [2, 0, 4], [0, 0, 0], [6, 0, 60], [1.0, 0.0, -4.0]]
    previous = [column.tolist() for column in state.previous]
    # The second arena has 3 + 4 + 5 contacts in the first step.
    assert previous == [[0, 0, 2], [0, 0, 6], [0, 0, 6], [0, 0, 2], [0, 0, 24], [0.0, 0.0, 3.0]]


def test_record_of_a_cohort(schedule: Schedule) -> None:
    seen = [
        [
            Episode(NOW, 4, 1, complete=0, contacts=(1, 0, 2), reward=0.5),
            Episode(NOW, 6, 5, complete=1, contacts=(0, 2, 0), reward=1.0, episodes=3),
            Episode(NOW, 5, 5, stage=2, complete=1),
        ]
    ]
    state, _ = _run(_late(schedule), seen + [[]] * 3)
    record = state.cohorts.record
    assert record.episodes.tolist() == [4, 0, 1]
    # Rounding of float32 throughout.
    np.testing.assert_allclose(record.success, [6 / 10, UNKNOWN, 1.0], rtol=1e-6)
    np.testing.assert_allclose(record.complete, [1 / 4, UNKNOWN, 1.0], rtol=1e-6)
    np.testing.assert_allclose(record.contacts, [5 / 10, UNKNOWN, 0.0], rtol=1e-6)
    np.testing.assert_allclose(record.reward, [1.5 / 10, UNKNOWN, 0.0], rtol=1e-6)
    # The mean begins at 1/2 with the weight of 20 trials, and 10 and 5 trials are added.
    fast = [0.5 + 10 / 30 * (0.6 - 0.5), UNKNOWN, 0.5 + 5 / 25 * (1.0 - 0.5)]
    np.testing.assert_allclose(record.fast, fast, rtol=1e-6)


@pytest.mark.parametrize(("success", "first", "second", "trials"), [
    ("targets", 0.3, 0.6, (10, 20)),
    ("all", 0.0, 1.0, (1, 5)),
])  # fmt: skip
def test_running_mean(
    schedule: Schedule, success: str, first: float, second: float, trials: tuple[int, int]
) -> None:
    options = CurriculumConfig(success=success)  # type: ignore[arg-type]  # one of the literals
    seen = [
        [Episode(NOW, 10, 3)],
        [],
        [Episode(NOW, 20, 12, episodes=5, complete=5)],
        [],
        [],
        [],
    ]
    state, rows = _run(_late(schedule), seen, options=options)
    # 20 trials move the mean by a share of 20 / 40, and 5 trials by 5 / 25. The first verdict moves
    # it from 1/2.
    begun, rate = (n / (n + 20) for n in trials)
    start = 0.5 + begun * (first - 0.5)
    fast = start + rate * (second - start)
    np.testing.assert_allclose(state.cohorts.record.fast[0], fast, rtol=1e-6)  # rounding of float32
    assert rows[3].success == np.float32(first)
    assert rows[5].success == np.float32(second)


def test_a_stage_without_episodes_keeps_its_record(schedule: Schedule) -> None:
    seen = [[Episode(NOW, 10, 5), Episode(NOW, 10, 2, stage=1)], [], [Episode(NOW, 10, 7)]]
    state, _ = _run(_late(schedule), seen + [[]] * 3)
    # Rounding of float32.
    np.testing.assert_allclose(state.cohorts.record.success, [0.7, 0.2, UNKNOWN], rtol=1e-6)


# --- when mode `sequential` decides


def test_no_decision_before_two_step_limits(schedule: Schedule) -> None:
    # Episodes of cohort 0 begin in updates 0 and 1; the last of them end in updates 2 and 3.
    _, rows = _run(_late(schedule), [PERFECT] * 4)
    assert [row.reason for row in rows] == [STAYED, STAYED, STAYED, BY_THRESHOLD]
    assert [row.stage for row in rows] == [0, 0, 0, 1]
    assert [row.cohort for row in rows] == [0, 1, 1, 2]
    assert [row.success == UNKNOWN for row in rows] == [True, True, True, False]
    assert rows[3].success == 1.0
    assert [row.judged for row in rows] == [0, 0, 0, 0]


@pytest.mark.parametrize(("reached", "reason"), [(8, BY_THRESHOLD), (7, STAYED)])
def test_threshold(schedule: Schedule, reached: int, reason: int) -> None:
    # 8 of 10 targets are exactly the threshold.
    _, rows = _run(_late(schedule), [[Episode(NOW, 10, reached)], [], [], []])
    assert rows[3].reason == reason
    assert rows[3].success == np.float32(reached / 10)


@pytest.mark.parametrize(("complete", "reason"), [(4, BY_THRESHOLD), (3, STAYED)])
def test_threshold_of_whole_episodes(schedule: Schedule, complete: int, reason: int) -> None:
    """9 of 10 targets would be enough for promotion; 4 of 5 episodes are exactly the threshold."""
    seen = [[Episode(NOW, 10, 9, episodes=5, complete=complete)], [], [], []]
    _, rows = _run(_late(schedule), seen, options=CurriculumConfig(success="all"))
    assert rows[3].reason == reason
    assert rows[3].success == np.float32(complete / 5)


def test_late_episodes_of_a_cohort_count_for_it(schedule: Schedule) -> None:
    # Successful episodes of cohort 0 end first, with 9 of 10 targets in update 0. Other episodes
    # of cohort 0 end in update 3, with 0 of 10 targets.
    seen = [[Episode(NOW, 10, 9)], [], [Episode(NOW, 50, 50)], [Episode(BEFORE, 10, 0)]]
    state, rows = _run(_late(schedule), seen)
    assert rows[3].reason == STAYED
    assert rows[3].success == np.float32(9 / 20)
    # The next cohort reached 50 of 50 targets and is judged one step limit later.
    assert (int(state.cohorts.previous.targets[0]), int(state.cohorts.previous.reached[0])) == (
        50,
        50,
    )
    _, rows = _run(_late(schedule), [*seen, [], []])
    assert [row.reason for row in rows[4:]] == [STAYED, BY_THRESHOLD]
    assert [row.success for row in rows[4:]] == [np.float32(9 / 20), 1.0]


def test_short_episodes_weigh_no_more_than_long_ones(schedule: Schedule) -> None:
    """Five arenas succeed in one update, and five fail in two: 10 of 15 episodes in a cohort.

    All episodes of a cohort that end in its first update are successes.
    """
    quick = [Episode(NOW, 5, 5)]
    both = [Episode(NOW, 5, 5), Episode(BEFORE, 5, 0)]
    state, rows = _run(_late(schedule), [quick, quick, *[both, quick] * 5])
    assert {row.reason for row in rows} == {STAYED}
    assert {row.success for row in rows[3:]} == {np.float32(10 / 15)}
    assert int(state.chosen.stage) == 0


def test_a_cohort_without_episodes_decides_nothing(schedule: Schedule) -> None:
    _, rows = _run(_late(schedule), [[]] * 8)
    assert {row.reason for row in rows} == {STAYED}
    assert all(row.success == UNKNOWN for row in rows)
    assert [row.cohort for row in rows] == [0, 1, 1, 2, 2, 3, 3, 4]


def test_episodes_of_the_stage_that_was_left_decide_no_more(schedule: Schedule) -> None:
    # The first stage is left in update 3, during cohort 1. For one step limit more, perfect
    # episodes of this stage still end.
    old = [Episode(0, stage=0), Episode(1, stage=0)]
    state, rows = _run(_late(schedule), [PERFECT] * 4 + [old, old])
    assert rows[3].stage == 1
    assert rows[5].success == UNKNOWN
    assert state.cohorts.record.success.tolist()[0] == 1.0  # the old stage keeps its record
    # The new stage is judged only after two step limits, and only by its own episodes.
    new = [*old, Episode(NOW, 10, 3)]
    _, rows = _run(_late(schedule), [PERFECT] * 4 + [new] * 4)
    assert [row.reason for row in rows[4:]] == [STAYED] * 4
    assert [row.judged for row in rows[4:]] == [1] * 4
    assert all(row.success == UNKNOWN for row in rows[4:7])
    assert rows[7].success == np.float32(6 / 20)


def test_deadline(schedule: Schedule) -> None:
    _, rows = _run(schedule, [[]] * 12)
    # The deadlines come after 5 and 10 updates, which are updates number 4 and 9.
    expected = [BY_BUDGET if update in (4, 9) else STAYED for update in range(12)]
    assert [row.reason for row in rows] == expected
    assert [row.stage for row in rows] == [0] * 4 + [1] * 5 + [2] * 3
    assert rows[4].success == UNKNOWN


def test_deadline_reports_what_was_measured(schedule: Schedule) -> None:
    _, rows = _run(schedule, [[Episode(NOW, 10, 5)]] + [[]] * 4)
    assert (rows[4].reason, rows[4].judged, rows[4].success) == (BY_BUDGET, 0, 0.5)


def test_a_deadline_begins_a_cohort_at_once(schedule: Schedule) -> None:
    """Cohort 2 ends early in update 4, after one update; its episodes end in cohort 3."""
    cut = [[], [], [], [], [Episode(NOW, 10, 4)], [Episode(BEFORE, 10, 1, stage=0)], []]
    state, rows = _run(schedule, cut)
    assert [row.cohort for row in rows] == [0, 1, 1, 2, 3, 3, 4]
    assert state.cohorts.record.success.tolist()[0] == np.float32(5 / 20)


def test_threshold_goes_before_deadline(schedule: Schedule) -> None:
    at_once = schedule._replace(deadline=np.array([4, 10, NEVER], np.int32))
    _, rows = _run(at_once, [PERFECT] * 4)
    assert rows[3].reason == BY_THRESHOLD


def test_stages_whose_deadlines_are_past_take_a_step_limit_each(schedule: Schedule) -> None:
    _, rows = _run(schedule, [[]] * 6, first=50)
    assert [row.reason for row in rows] == [
        STAYED, BY_BUDGET, STAYED, BY_BUDGET, STAYED, STAYED,
    ]  # fmt: skip
    assert [row.stage for row in rows] == [0, 1, 1, 2, 2, 2]


def test_the_last_stage_stays(tiny_config: TrainConfig) -> None:
    schedule = programs.schedule(_config(tiny_config, 1))
    _, rows = _run(schedule, [PERFECT] * 8, first=1000)
    assert {(row.reason, row.stage) for row in rows} == {(STAYED, 0)}
    assert [row.success for row in rows[3:]] == [1.0] * 5  # still measured


def test_the_most_robots_met_never_falls(schedule: Schedule) -> None:
    state, _ = _run(_late(schedule), [PERFECT] * 4)
    assert int(state.met) == 2  # robots of the second stage
    again = engine.init(stages.make(schedule, OPTIONS), schedule)
    back = dataclasses.replace(again, met=state.met)
    ended = _ended(back, [Episode(NOW, 10, 0)])
    assert int(observe(OPTIONS, schedule, back, ended, 0).met) == 2


# --- the log


def _row(update: int, decision: int, left: int, to: int) -> dict:
    return {
        "update": update,
        "decision": decision,
        "decided_stage": left,
        "next_stage": to,
        "success_by_stage": [0.9, 0.25, None],
        "complete_by_stage": [0.7, 0.125, None],
        "episodes_by_stage": [40, 8, 0],
        "estimate_by_stage": [0.875, 0.5, None],
        "weights": [0.25, 0.25, 0.5],
    }


def test_log() -> None:
    rows = [
        _row(3, BY_THRESHOLD, 0, 1),
        _row(4, STAYED, 1, 1),
        _row(9, BY_BUDGET, 1, 2),
        _row(15, REWEIGHED, 2, 2),
    ]
    first = {"targets_reached": 0.9, "all_reached": 0.7, "episodes": 40}
    second = {"targets_reached": 0.25, "all_reached": 0.125, "episodes": 8}
    assert log(rows, ["a", "b", "c"], 7) == [
        {"update": 3, "seed": 7, "from": "a", "to": "b", "why": "threshold"} | first,
        {"update": 9, "seed": 7, "from": "b", "to": "c", "why": "budget"} | second,
        {
            "update": 15,
            "seed": 7,
            "why": "reweighed",
            "weights": {"a": 0.25, "b": 0.25, "c": 0.5},
            "success": {"a": 0.875, "b": 0.5, "c": None},
        },
    ]
