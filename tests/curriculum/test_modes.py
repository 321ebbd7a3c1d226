"""Checks the modes by hand, and against a plain reference on episodes of a real tiny run."""

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from curricula import observe
from hypothesis import given, settings
from hypothesis import strategies as st

from swarmjax.curriculum import axes, engine, stages
from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.curriculum.engine import (
    BY_BUDGET,
    BY_THRESHOLD,
    NEVER,
    REASONS,
    REWEIGHED,
    STAYED,
    CohortVerdict,
    CurriculumState,
    Schedule,
    StageChoice,
)
from swarmjax.curriculum.stages import MODES, StagesState
from swarmjax.ppo.config import AlgoConfig
from swarmjax.run.settings import TrainConfig
from swarmjax.sim.config import RobotConfig, SimConfig
from swarmjax.task.config import TaskConfig
from swarmjax.task.episode import Ended
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import program as programs
from swarmjax.training import rollout
from swarmjax.training.rollout import Arena

COHORT = 4  # updates
SEQUENTIAL, MIXED = (CurriculumConfig(mode=mode) for mode in ("sequential", "mixed"))
ADAPTIVE = CurriculumConfig(mode="adaptive")
FAILURE = CurriculumConfig(mode="adaptive", score="failure")
EARLIER = 0.2  # share of the arenas on earlier stages with `mixed`


def _schedule(count: int, **changes: Any) -> Schedule:
    """Returns a schedule of stages with 1, 2, ... robots, without deadlines."""
    chosen = tuple(StageConfig(name=f"s{i}", robots=1 + i, side=1.0) for i in range(count))
    config = TrainConfig(stage=chosen, sim=SimConfig(max_robots=9))
    numbers = programs.schedule(config)._replace(
        deadline=np.full(count, NEVER, np.int32),
        floor=np.float32(0.1),
        cohort_updates=np.int32(COHORT),
    )
    return numbers._replace(**changes)


def _state(
    stage: int, count: int, turn: int = 9, since: int = 5, weights: list[float] | None = None
) -> StagesState:
    shares = jnp.zeros(count) if weights is None else jnp.array(weights)
    chosen = StageChoice(jnp.int32(stage), shares, jnp.int32(STAYED))
    return StagesState(chosen=chosen, turn=jnp.int32(turn), since=jnp.int32(since))


def _verdict(
    success: list[float],
    over: bool = True,
    judged: bool = True,
    fast: list[float] | None = None,
) -> CohortVerdict:
    values = jnp.array(success, jnp.float32)
    record = engine.init_cohorts(len(success)).record
    if fast is not None:
        record = record._replace(fast=jnp.array(fast, jnp.float32))
    return CohortVerdict(
        over=jnp.array(over),
        judged=over & judged & ~jnp.isnan(values),
        success=values,
        record=record,
    )


def _choose(
    options: CurriculumConfig,
    state: StagesState,
    numbers: Schedule,
    verdict: CohortVerdict,
    update: int,
) -> StageChoice:
    return MODES[options.mode](state, numbers, options, verdict, jnp.int32(update))


# --- promotion, hold, first and last stage


@pytest.mark.parametrize("options", [SEQUENTIAL, MIXED], ids=lambda options: options.mode)
@pytest.mark.parametrize(
    ("stage", "success", "to", "why"),
    [
        (1, 0.8, 2, BY_THRESHOLD),
        (1, 0.79, 1, STAYED),
        (1, 0.0, 1, STAYED),
        (2, 1.0, 2, STAYED),  # no stage after the last
    ],
)
def test_a_verdict_decides(
    options: CurriculumConfig, stage: int, success: float, to: int, why: int
) -> None:
    seen = [math.nan] * 3
    seen[stage] = success
    found = _choose(options, _state(stage, 3), _schedule(3), _verdict(seen), 100)
    assert (int(found.stage), int(found.reason)) == (to, why)


@pytest.mark.parametrize("options", [SEQUENTIAL, MIXED], ids=lambda options: options.mode)
@pytest.mark.parametrize(
    ("stage", "success", "to"), [(0, 0.7, 0), (0, 0.9, 1), (1, 0.59, 1), (1, 0.7, 2)]
)
def test_each_stage_has_its_own_threshold(
    options: CurriculumConfig, stage: int, success: float, to: int
) -> None:
    numbers = _schedule(3, threshold=np.array([0.9, 0.6, 0.9], np.float32))
    found = _choose(options, _state(stage, 3), numbers, _verdict([success] * 3), 100)
    assert int(found.stage) == to


@pytest.mark.parametrize(
    ("cohort", "over", "success", "why"),
    [
        (5, False, 1.0, STAYED),  # right after a decision, not even the deadline counts
        (5, True, 1.0, BY_BUDGET),  # a step limit later, the verdict is still of the cohort before
        (6, False, 1.0, BY_BUDGET),
        (6, True, 1.0, BY_THRESHOLD),  # the first cohort that began after the decision
        (6, True, 0.0, BY_BUDGET),
    ],
)
def test_after_a_decision_a_step_limit_passes(
    cohort: int, over: bool, success: float, why: int
) -> None:
    numbers = _schedule(3, deadline=np.array([200, 50, NEVER], np.int32))
    seen = _verdict([1.0, success, 1.0], over)
    found = _choose(SEQUENTIAL, _state(1, 3, cohort, since=5), numbers, seen, 100)
    assert REASONS[int(found.reason)] == REASONS[why]


def test_a_stage_that_was_not_judged_now_is_not_decided_by_what_it_once_did() -> None:
    seen = _verdict([1.0, 1.0, 1.0], judged=False)
    found = _choose(SEQUENTIAL, _state(1, 3), _schedule(3), seen, 100)
    assert int(found.reason) == STAYED


# --- weights


@pytest.mark.parametrize(
    ("stage", "weights"),
    [
        (0, [1.0, 0.0, 0.0, 0.0]),
        (1, [0.2, 0.8, 0.0, 0.0]),
        (3, [0.2 / 3, 0.2 / 3, 0.2 / 3, 0.8]),
    ],
)
def test_mixed_keeps_a_share_on_earlier_stages(stage: int, weights: list[float]) -> None:
    found = _choose(MIXED, _state(stage, 4), _schedule(4), _verdict([math.nan] * 4), 3)
    np.testing.assert_allclose(found.weights, weights, rtol=1e-6)  # rounding of float32
    found = _choose(SEQUENTIAL, _state(stage, 4), _schedule(4), _verdict([math.nan] * 4), 3)
    assert found.weights.tolist() == np.eye(4)[stage].tolist()


NAN = math.nan


@pytest.mark.parametrize(
    ("options", "fast", "score"),
    [
        # The score is p (1 - p), and a quarter for an unknown p.
        (ADAPTIVE, [0.9, 0.5, 0.2, NAN], [0.09, 0.25, 0.16, 0.25]),
        (ADAPTIVE, [1.0, 1.0, 0.0, 1.0], [1.0] * 4),  # nothing to learn: even weights
        (ADAPTIVE, [NAN] * 4, [1.0] * 4),
        # The score is 1 - p, and an unknown stage counts as p = 0.
        (FAILURE, [0.9, 0.5, 0.0, NAN], [0.1, 0.5, 1.0, 1.0]),
        (FAILURE, [1.0] * 4, [1.0] * 4),
    ],
)
def test_adaptive_weighs_by_its_score(
    options: CurriculumConfig, fast: list[float], score: list[float]
) -> None:
    verdict = _verdict([0.5] * 4, fast=fast)
    chosen = _choose(options, _state(3, 4), _schedule(4), verdict, 3)
    expected = 0.1 / 4 + 0.9 * np.array(score) / sum(score)
    np.testing.assert_allclose(chosen.weights, expected, rtol=1e-5)  # differences in float32
    assert (int(chosen.stage), int(chosen.reason)) == (3, REWEIGHED)


def test_shares_of_robots_give_stages_of_many_robots_fewer_arenas() -> None:
    options = CurriculumConfig(mode="adaptive", shares="robots")
    verdict = _verdict([0.5] * 3, fast=[0.5, 0.5, 1.0])
    found = _choose(options, _state(2, 3), _schedule(3), verdict, 3)
    samples = np.array(found.weights) * [1, 2, 3]  # robots of the stages
    expected = 0.1 / 3 + 0.9 * np.array([0.5, 0.5, 0.0])
    np.testing.assert_allclose(samples / samples.sum(), expected, rtol=1e-6)
    assert float(jnp.sum(found.weights)) == pytest.approx(1.0, abs=1e-6)


def test_adaptive_waits_for_the_end_of_a_cohort() -> None:
    state, fast = _state(1, 2, weights=[0.125, 0.875]), [0.5, 0.9]
    verdict = _verdict(fast, over=False, fast=fast)
    found = _choose(ADAPTIVE, state, _schedule(2), verdict, 3)
    assert found.weights.tolist() == [0.125, 0.875]
    assert int(found.reason) == STAYED
    verdict = _verdict(fast, judged=False, fast=fast)
    found = _choose(ADAPTIVE, state, _schedule(2), verdict, 3)
    assert int(found.reason) == STAYED


# --- the frontier

FRONTIER = CurriculumConfig(mode="frontier", floor=0.1)
# Two axes of two and three values. Stage 3 i + j has value i of the first and j of the second.
GRID = axes.easier({"robots": (2.0,), "distance": (0.1, 0.2)}, 6)


def _front(fast: list[float], weights: list[float], **more: Any) -> StageChoice:
    numbers = _schedule(len(fast), easier=GRID)
    state = _state(0, len(fast), weights=weights)
    return _choose(FRONTIER, state, numbers, _verdict([0.5] * len(fast), fast=fast, **more), 3)


@pytest.mark.parametrize(
    ("fast", "front", "learned"),
    [
        ([NAN] * 6, [0], []),
        ([0.7, NAN, NAN, NAN, NAN, NAN], [0], []),
        ([0.8, NAN, NAN, NAN, NAN, NAN], [1, 3], [0]),
        # Stage 4 opens once both of its easier neighbours are learned.
        ([0.9, 0.9, 0.1, 0.2, 0.0, 0.0], [2, 3], [0, 1]),
        ([0.9, 0.9, 0.1, 0.9, 0.0, 0.0], [2, 4], [0, 1, 3]),
        # Failure narrows: stage 0 is practised again, and what stage 1 opened is closed.
        ([0.5, 0.9, 0.1, 0.1, 0.1, 0.1], [0, 2], [1]),
        ([0.9] * 5 + [0.3], [5], [0, 1, 2, 3, 4]),
        # The last stage stays in training.
        ([0.9] * 6, [5], [0, 1, 2, 3, 4]),
        # A stage beyond the frontier may be learned before it opens.
        ([0.5, NAN, NAN, NAN, 0.9, 0.0], [0], [4]),
    ],
)
def test_the_frontier_is_open_and_not_learned(
    fast: list[float], front: list[int], learned: list[int]
) -> None:
    found = _front(fast, [0.0] * 6)
    expected = np.full(6, 0.1 / 6)
    expected[front] += 0.9 * (0.8 if learned else 1.0) / len(front)
    expected[learned] += 0.9 * 0.2 / max(len(learned), 1)
    np.testing.assert_allclose(found.weights, expected, rtol=1e-6)  # rounding of float32
    assert int(found.reason) == REWEIGHED


def test_the_frontier_decides_nothing_within_a_cohort_or_without_a_change() -> None:
    learned, old = [0.9] + [0.0] * 5, [0.5] * 2 + [0.0] * 4
    found = _front(learned, old, over=False)
    assert (found.weights.tolist(), int(found.reason)) == (old, STAYED)
    again = _front(learned, _front(learned, old).weights.tolist())
    assert int(again.reason) == STAYED


def test_a_sequence_of_stages_opens_one_by_one() -> None:
    verdict = _verdict([0.5] * 3, fast=[0.9, 0.1, NAN])
    found = _choose(FRONTIER, _state(0, 3), _schedule(3), verdict, 3)
    expected = 0.1 / 3 + 0.9 * np.array([0.2, 0.8, 0.0])
    np.testing.assert_allclose(found.weights, expected, rtol=1e-6)  # rounding of float32
    assert int(found.stage) == 1


def test_a_stage_is_learned_at_its_own_threshold() -> None:
    numbers = _schedule(3, threshold=np.array([0.8, 0.6, 0.8], np.float32))
    verdict = _verdict([0.5] * 3, fast=[0.7, 0.7, NAN])
    found = _choose(FRONTIER, _state(0, 3), numbers, verdict, 3)
    expected = 0.1 / 3 + 0.9 * np.array([0.4, 0.2, 0.4])  # the last stage is open
    np.testing.assert_allclose(found.weights, expected, rtol=1e-6)  # rounding of float32


SHARES = st.lists(st.one_of(st.just(NAN), st.floats(0.0, 1.0, width=32)), min_size=1, max_size=40)


@settings(max_examples=40)
@given(
    fast=SHARES,
    seed=st.integers(0, 99),
    floor=st.floats(2.0**-10, 1.0, width=32),
    index=st.integers(0, 3),
)
@pytest.mark.slow
def test_weights_are_shares(fast: list[float], seed: int, floor: float, index: int) -> None:
    count = len(fast)
    options = (SEQUENTIAL, MIXED, ADAPTIVE, FAILURE)[index]
    verdict = _verdict(fast, fast=fast)
    chosen = _choose(options, _state(seed % count, count), _numbers(count, floor), verdict, 3)
    shares = np.asarray(chosen.weights)
    assert shares.sum() == pytest.approx(1.0, abs=1e-5)  # float32 sum of 40
    assert (shares >= (floor / count * (1 - 1e-6) if index > 1 else 0.0)).all()  # float32
    assert (shares <= 1.0 + 1e-6).all()


@functools.cache
def _numbers_of(count: int) -> Schedule:
    return _schedule(9)._replace(deadline=np.full(count, NEVER, np.int32))


def _numbers(count: int, floor: float) -> Schedule:
    return _numbers_of(count)._replace(floor=np.float32(floor))


# --- a plain reference, on episodes of a real tiny run

STAGES, ARENAS = 3, 8
UPDATES = 100


class Reference:
    """The curriculum as lists of episodes, in NumPy and plain Python."""

    def __init__(self, numbers: Schedule, options: CurriculumConfig) -> None:
        self.numbers, self.options = numbers, options
        self.cohort = self.age = self.since = 0
        self.stages = len(numbers.deadline)
        self.stage = self.stages - 1 if options.mode == "adaptive" else 0
        self.episodes: list[tuple[int, int, int, int, int]] = []
        self.fast = np.full(self.stages, np.nan, np.float32)
        self.weights = self._weights()

    def update(self, ended: Ended, number: int) -> int:
        """Counts the episodes of an update, and returns the reason of its decision."""
        over = np.asarray(ended.episodes) > 0
        columns = (ended.cohort, ended.stage, ended.targets, ended.reached, ended.all_reached)
        self.episodes += list(zip(*(np.asarray(c)[over].tolist() for c in columns), strict=True))
        self.age += 1
        is_over = self.age == self.numbers.cohort_updates
        judged = self._judge() if is_over else {}
        reason = self._decide(judged, is_over, number)
        if is_over and self.options.mode == "adaptive":
            self.weights, reason = self._weights(), REWEIGHED if judged else STAYED
        if is_over and self.options.mode == "frontier":
            before, self.weights = self.weights, self._weights()
            reason = STAYED if np.array_equal(before, self.weights) else REWEIGHED
        if reason in (BY_THRESHOLD, BY_BUDGET):
            self.stage += 1
            self.weights = self._weights()
        if is_over or reason != STAYED:
            self.cohort, self.age = self.cohort + 1, 0
            self.since = self.since if reason == STAYED else self.cohort
        return reason

    def _judge(self) -> dict[int, np.float32]:
        """Returns the success of the previous cohort, by stage."""
        judged = {}
        for stage in range(self.stages):
            mine = [e for e in self.episodes if e[:2] == (self.cohort - 1, stage)]
            if not mine:
                continue
            _, _, targets, reached, complete = np.sum(mine, axis=0)
            part, whole = {"targets": (reached, targets), "all": (complete, len(mine))}[
                self.options.success
            ]
            judged[stage] = success = np.float32(part) / np.float32(whole)
            rate = np.float32(whole) / np.float32(whole + 20)
            half = np.float32(0.5)
            mean = half if np.isnan(self.fast[stage]) else self.fast[stage]
            self.fast[stage] = mean + rate * (success - mean)
        return judged

    def _decide(self, judged: dict[int, np.float32], is_over: bool, number: int) -> int:
        deadline = self.numbers.deadline
        if self.options.mode in ("adaptive", "frontier"):
            return STAYED
        success = judged.get(self.stage) if self.cohort - 1 >= self.since else None
        if self.stage < self.stages - 1:
            if success is not None and success >= self.numbers.threshold[self.stage]:
                return BY_THRESHOLD
            if number + 1 >= deadline[self.stage] and (is_over or self.cohort > self.since):
                return BY_BUDGET
        return STAYED

    def _weights(self) -> np.ndarray:
        if self.options.mode == "adaptive":
            unknown = np.isnan(self.fast)
            score = np.where(unknown, 0.25, self.fast * (1 - self.fast))
            if self.options.score == "failure":
                score = np.where(unknown, 1.0, 1.0 - self.fast)
            share = (
                score / score.sum() if score.sum() > 0 else np.full(self.stages, 1 / self.stages)
            )
            floor = np.float32(self.numbers.floor)
            return floor / self.stages + (1 - floor) * share
        if self.options.mode == "frontier":
            return self._frontier()
        weights = np.zeros(self.stages)
        weights[self.stage] = 1.0
        if self.options.mode == "mixed" and self.stage:
            weights[: self.stage] = EARLIER / self.stage
            weights[self.stage] = 1 - EARLIER
        return weights

    def _frontier(self) -> np.ndarray:
        """Weighs a sequence: stages that follow a learned one, or the first, and learned ones."""
        needed = self.numbers.threshold
        learned = [i for i in range(self.stages - 1) if self.fast[i] >= needed[i]]
        others = [i for i in range(self.stages) if i not in learned]
        front = [i for i in others if i == 0 or i - 1 in learned]
        self.stage = max(front)
        weights = np.zeros(self.stages)
        weights[front] = (0.8 if learned else 1.0) / len(front)
        weights[learned] = 0.2 / max(len(learned), 1)
        return 0.1 / self.stages + 0.9 * weights


Step = Callable[[jax.Array, Arena | None, jax.Array, jax.Array], tuple[Arena, Ended]]


@pytest.fixture(scope="module")
def step() -> Step:
    """Returns a function that runs a rollout of 8 arenas.

    The robots move so randomly that some reach their targets by chance.
    """
    sizes = [(1, 0.4), (1, 0.5), (2, 0.5)]
    config = TrainConfig(
        stage=tuple(StageConfig(name=f"s{i}", robots=n, side=s) for i, (n, s) in enumerate(sizes)),
        robot=RobotConfig(max_speed=0.6, max_wheel_speed=40.0),
        task=TaskConfig(step_limit=8 * COHORT, target_radius=0.09),
        algo=AlgoConfig(hidden_sizes=(8,), rollout_length=8, num_minibatches=2, initial_std=1.5),
        sim=SimConfig(impl="jax", max_robots=2, max_obstacles=0),
        arenas=ARENAS,
    )
    program, schedule = programs.load(config)
    learners = jax.vmap(program.ppo.init)(jax.random.split(jax.random.key(1), 1))

    draw = jax.jit(functools.partial(rollout.draw_starts, program.world, schedule.stages))
    collect = jax.jit(functools.partial(rollout.collect, program))

    def run(
        index: jax.Array, arenas: Arena | None, cohort: jax.Array, key: jax.Array
    ) -> tuple[Arena, Ended]:
        level_key, rollout_key = jax.random.split(key)
        starts = draw(index[None], cohort, level_key)
        before = starts if arenas is None else arenas
        after, _, ended = collect(learners, before, starts, rollout_key)
        return after, ended

    return run


# An eighth of the robots arrive by chance. The first stage ends at its deadline; the second passes.
EARLY = np.array([9, 90, NEVER], np.int32)
CASES = {
    "sequential": (SEQUENTIAL, {"deadline": EARLY}),
    "sequential-all": (CurriculumConfig(mode="sequential", success="all"), {"deadline": EARLY}),
    "mixed": (MIXED, {"deadline": EARLY}),
    "learnability": (ADAPTIVE, {}),
    "failure": (FAILURE, {"floor": np.float32(0.4)}),
    "frontier": (FRONTIER, {}),
}


@pytest.mark.parametrize("name", CASES)
def test_decisions_are_those_of_the_reference(step: Step, name: str) -> None:
    options, changes = CASES[name]
    numbers = _schedule(3, **({"threshold": np.full(3, 0.25, np.float32)} | changes))
    state = engine.init(stages.make(numbers, options), numbers)
    reference, arenas, why = Reference(numbers, options), None, []
    for number in range(UPDATES):
        index = stages.assign(state.chosen.weights, state.own.turn, ARENAS)
        arenas, ended = step(index, arenas, state.cohorts.number, jax.random.key(number))
        state = observe(options, numbers, state, ended, number)
        why.append(int(state.chosen.reason))
        assert reference.update(ended, number) == why[-1]
        assert int(state.chosen.stage) == reference.stage
        assert int(state.cohorts.number) == int(state.own.turn) == reference.cohort
        assert int(state.own.since) == reference.since
        # float32 rounding in sums and quotients. The decisions above must agree exactly.
        np.testing.assert_allclose(state.chosen.weights, reference.weights, rtol=1e-5)
    decided = [reason for reason in why if reason != STAYED]
    if options.mode == "adaptive":
        assert len(decided) >= 4
    elif options.mode == "frontier":
        assert len(decided) >= 1
    else:
        assert decided == [BY_BUDGET, BY_THRESHOLD]


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), index=st.integers(0, 3))
def test_no_decision_within_a_step_limit_of_the_last(seed: int, index: int) -> None:
    """Tests random results of episodes, and random early deadlines."""
    random = np.random.default_rng(seed)
    options = (SEQUENTIAL, MIXED, ADAPTIVE, FAILURE)[index]
    soon = np.sort(random.integers(1, 30, 3)).astype(np.int32)
    numbers = _schedule(4, deadline=np.append(soon, np.int32(NEVER)))
    state, last = engine.init(stages.make(numbers, options), numbers), -COHORT
    for number in range(40):
        state = observe(options, numbers, _seen(state, random), _NOBODY, number)
        if int(state.chosen.reason) != STAYED:
            assert number - last >= COHORT
            last = number
    assert last > 0


# An update in which no episode ended.
_NONE = jnp.zeros((1, 1), jnp.int32)
_NOBODY = Ended(
    *(_NONE, _NONE, _NONE, _NONE, _NONE, _NONE, _NONE, _NONE, _NONE),
    contacts=jnp.zeros((1, 1, 3), jnp.int32),
    reward=jnp.zeros((1, 1)),
    broken=_NONE,
)


def _seen(state: CurriculumState, random: np.random.Generator) -> CurriculumState:
    """Returns the state with random tallies."""
    targets = random.integers(0, 3, 4)
    drawn = {"targets": targets, "reached": random.integers(0, targets + 1), "episodes": targets}
    columns = {key: jnp.asarray(value, jnp.int32) for key, value in drawn.items()}
    tallies = {
        name: getattr(state.cohorts, name)._replace(**columns) for name in ("current", "previous")
    }
    return replace(state, cohorts=replace(state.cohorts, **tallies))
