"""Checks the compiled loop: one trace, any chunk size, every stage."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.curriculum.engine import BY_BUDGET, NEVER, Schedule
from swarmjax.run.checkpoint import digest, to_leaves
from swarmjax.run.settings import TrainConfig
from swarmjax.task.stage_config import StageConfig
from swarmjax.task.world import World
from swarmjax.training import loop, rollout
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.rollout import Program

Chunk = Callable[[Schedule, TrainState, np.int32], tuple[TrainState, dict]]


@pytest.fixture(scope="module")
def program(tiny_config: TrainConfig, tiny_world: World) -> Program:
    return programs.build(tiny_config, tiny_world)


@pytest.fixture(scope="module")
def start(program: Program) -> Callable[[], TrainState]:
    init = jax.jit(partial(loop.init, program))
    return lambda: init(programs.schedule(program.config))


@pytest.fixture(scope="module")
def chunk(program: Program) -> Chunk:
    """Returns the jitted `loop.train_chunk`; tracing it twice in this module is an error."""
    return _traced_once(program)


def _traced_once(program: Program) -> Chunk:
    """Jits `loop.train_chunk`; tracing it a second time is an error."""
    traces = itertools.count(1)

    def chunk(schedule: Schedule, state: TrainState, n: np.int32) -> tuple[TrainState, dict]:
        assert next(traces) == 1, "traced again"
        return loop.train_chunk(program, schedule, state, jnp.asarray(n))

    return jax.jit(chunk, donate_argnums=1)


def _run(chunk: Chunk, schedule: Schedule, state: TrainState, sizes: list[int]) -> TrainState:
    for n in sizes:
        state, _ = chunk(schedule, state, np.int32(n))
    return state


@pytest.mark.parametrize("sizes", [[7, 7, 6], pytest.param([20], marks=pytest.mark.slow)])
def test_any_chunk_size_gives_the_same_run_bit_for_bit(
    sizes: list[int], program: Program, start: Callable[[], TrainState], chunk: Chunk
) -> None:
    schedule = programs.schedule(program.config)
    one_by_one = _run(chunk, schedule, start(), [1] * 20)
    at_once = _run(chunk, schedule, start(), sizes)
    assert digest(to_leaves(one_by_one)) == digest(to_leaves(at_once))


def test_a_run_trains_and_reports_one_row_an_update(
    program: Program, start: Callable[[], TrainState], chunk: Chunk
) -> None:
    state, metrics = chunk(programs.schedule(program.config), start(), np.int32(5))
    assert int(state.update) == 5
    np.testing.assert_array_equal(metrics["update"][:5], np.arange(5))
    before, after = to_leaves(start()), to_leaves(state)
    name = "learners/params/actor/mean/kernel"
    assert np.max(np.abs(before[name] - after[name])) > 1e-4
    # 8 arenas of two robots run for 8 control steps; robots that arrive early add fewer.
    assert 0 < metrics["transitions"][0] <= 8 * 2 * 8
    assert set(np.asarray(metrics["broken_arenas"][:5])) == {0}


def test_levels_noise_and_shuffles_are_drawn_by_keys_of_their_own(
    program: Program, start: Callable[[], TrainState], monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = []
    state = start()
    split = jax.random.split

    def take(*arguments: Any, **_: Any) -> Any:
        """Keeps the key, which is the last argument."""
        keys.append(tuple(jax.random.key_data(arguments[-1]).tolist()))
        return None, SimpleNamespace(valid=np.zeros((1, 1))), None

    def split_once(key: jax.Array, number: int) -> jax.Array:
        """Splits the key of an update, and then takes that of its learning."""
        if keys:
            take(key)
            raise StopIteration
        return split(key, number)

    monkeypatch.setattr(loop, "_draw", take)
    monkeypatch.setattr(rollout, "collect", take)
    monkeypatch.setattr(rollout, "batch", lambda *_: None)
    monkeypatch.setattr(jax.random, "split", split_once)
    with pytest.raises(StopIteration):
        loop.update(program, programs.schedule(program.config), state)
    keys.append(tuple(jax.random.key_data(state.key).tolist()))
    assert len(set(keys)) == 4


def test_neither_state_nor_metrics_hold_nan(
    program: Program, start: Callable[[], TrainState], chunk: Chunk
) -> None:
    state, metrics = chunk(programs.schedule(program.config), start(), np.int32(1))
    for leaf in jax.tree.leaves((to_leaves(start()), to_leaves(state), metrics)):
        assert not np.isnan(leaf).any()  # JAX_DEBUG_NANS would stop the run


def test_stage_numbers_are_no_part_of_the_program(
    program: Program, start: Callable[[], TrainState], chunk: Chunk
) -> None:
    """Changes the numbers: `chunk` fails if they need a second trace, and the run must differ."""
    schedule = programs.schedule(program.config)
    wider = schedule._replace(stages=schedule.stages._replace(side=schedule.stages.side * 1.5))
    state, _ = chunk(schedule, start(), np.int32(20))
    other, _ = chunk(wider, start(), np.int32(20))
    sides = {round(float(side), 3) for side in np.asarray(other.arenas.level.side)}
    assert sides <= {0.5, 0.75, 1.2}  # 0.5: levels drawn by `start`, still in play
    assert 0.75 in sides or 1.2 in sides
    assert digest(to_leaves(state)) != digest(to_leaves(other))


def _six(base: TrainConfig, options: CurriculumConfig) -> TrainConfig:
    """Returns a config with all six stages of the default curriculum."""
    sizes = [(2, 0.5, 0), (2, 0.7, 0), (3, 0.7, 1), (3, 1.0, 2), (5, 1.0, 2), (5, 1.2, 3)]
    stages = tuple(
        StageConfig(name=f"s{i + 1}", robots=robots, side=side, obstacles=obstacles)
        for i, (robots, side, obstacles) in enumerate(sizes)
    )
    return replace(
        base,
        stage=stages,
        sim=replace(base.sim, max_robots=5, max_obstacles=3),
        curriculum=options,
        budget=8 * 8 * 25,
    )


@pytest.mark.slow
def test_the_curriculum_visits_every_stage_within_one_trace(tiny_config: TrainConfig) -> None:
    """Promotes by deadline, since nothing is learned in so few updates."""
    options = CurriculumConfig(mode="sequential", threshold=1.0, budget_share=0.8)
    program, schedule = programs.load(_six(tiny_config, options))
    chunk = _traced_once(program)
    state = jax.jit(partial(loop.init, program))(schedule)
    state, metrics = chunk(schedule, state, np.int32(10))
    state, more = chunk(schedule, state, np.int32(15))
    visited = np.concatenate([metrics["stage"][:10], more["stage"][:15]])
    # The first five stages share 20 updates, four each: deadlines at 4, 8, 12, 16 and 20.
    np.testing.assert_array_equal(visited, np.repeat(np.arange(6), [4, 4, 4, 4, 4, 5]))
    assert set(np.asarray(state.arenas.stage)) <= {4, 5}
    assert int(np.max(np.sum(state.arenas.level.present, axis=-1))) == 5
    assert int(state.curriculum.met) == 5


@pytest.mark.slow
def test_mixed_keeps_arenas_on_earlier_stages_within_one_trace(tiny_config: TrainConfig) -> None:
    options = CurriculumConfig(mode="mixed", threshold=1.0)
    program, schedule = programs.load(_six(tiny_config, options))
    chunk, init = _traced_once(program), jax.jit(partial(loop.init, program))
    schedule = schedule._replace(deadline=np.array([3, 8, *[NEVER] * 4], np.int32))
    _, metrics = chunk(schedule, init(schedule), np.int32(20))
    np.testing.assert_array_equal(metrics["stage"][:20], np.repeat([0, 1, 2], [3, 5, 12]))
    # Four fifths of the 8 arenas are on the third stage, and a tenth on each stage before it.
    # Episodes that began before the last promotion have ended after a step limit.
    np.testing.assert_allclose(metrics["weights"][19], [0.1, 0.1, 0.8, 0, 0, 0], rtol=1e-6)
    assert metrics["mix"][12:20].sum(axis=0).tolist()[3:] == [0, 0, 0]
    assert (metrics["mix"][12:20].sum(axis=1) == 8).all()
    # The points that place eight arenas on stages move with each cohort, so each stage's mean
    # number of arenas is within one of its share.
    np.testing.assert_allclose(metrics["mix"][12:20].mean(axis=0)[:3], [0.8, 0.8, 6.4], atol=1)
    # Other numbers throughout the schedule need no second trace.
    other = schedule._replace(
        threshold=np.full(6, 0.1, np.float32),
        cohort_updates=np.int32(3),
        deadline=np.arange(1, 7, dtype=np.int32),
        stages=schedule.stages._replace(robots=np.array([1, 2, 3, 4, 5, 5], np.int32)),
    )
    chunk(other, init(other), np.int32(20))


@pytest.mark.slow
def test_adaptive_trains_on_all_stages_within_one_trace(tiny_config: TrainConfig) -> None:
    options = CurriculumConfig(mode="adaptive")
    program, schedule = programs.load(_six(tiny_config, options))
    chunk, init = _traced_once(program), jax.jit(partial(loop.init, program))
    _, metrics = chunk(schedule, init(schedule), np.int32(25))
    assert set(np.asarray(metrics["stage"])) == {5}
    weights = np.asarray(metrics["weights"])
    assert (weights.min(axis=1) >= 0.1 / 6 - 1e-6).all()  # float32
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-6)  # float32
    decided = np.flatnonzero(metrics["decision"])
    # A cohort is two updates; the first decision is made at the end of the second cohort.
    assert decided.tolist() == list(range(3, 25, 2))
    # Over the run, the 8 arenas visit all six stages.
    assert (np.asarray(metrics["episodes_by_stage"])[-1] > 0).all()
    other = schedule._replace(floor=np.float32(1.0), cohort_updates=np.int32(3))
    _, metrics = chunk(other, init(other), np.int32(25))
    np.testing.assert_allclose(metrics["weights"], np.full((25, 6), 1 / 6), rtol=1e-6)  # float32


def test_metrics_by_stage_are_the_record(
    program: Program, start: Callable[[], TrainState], chunk: Chunk
) -> None:
    state, metrics = chunk(programs.schedule(program.config), start(), np.int32(20))
    record = state.curriculum.cohorts.record
    names = {
        "episodes_by_stage": record.episodes,
        "success_by_stage": record.success,
        "complete_by_stage": record.complete,
        "contacts_by_stage": record.contacts,
        "return_by_stage": record.reward,
        "estimate_by_stage": record.fast,
        "weights": state.curriculum.chosen.weights,
    }
    for name, expected in names.items():
        np.testing.assert_array_equal(metrics[name][19], expected, err_msg=name)
    on = np.bincount(np.asarray(state.arenas.stage), minlength=2)
    np.testing.assert_array_equal(metrics["mix"][19], on)
    # The first of two stages lasts for half of the 20 updates, unless it ends earlier.
    last = int(np.asarray(metrics["decision"]).nonzero()[0][0])
    assert last <= 9
    moved = [int(metrics[name][last]) for name in ("decided_stage", "next_stage")]
    assert moved == [0, 1]


@pytest.mark.slow
def test_a_seed_may_be_given(program: Program, start: Callable[[], TrainState]) -> None:
    schedule = programs.schedule(program.config)
    init = jax.jit(partial(loop.init, program))
    same, other = init(schedule, np.int32(0)), init(schedule, np.int32(1))
    assert digest(to_leaves(same)) == digest(to_leaves(start()))  # the config's seed is 0
    assert digest(to_leaves(other)) != digest(to_leaves(same))
    configured = replace(program, config=replace(program.config, seed=1))
    again = jax.jit(partial(loop.init, configured))(schedule)
    assert digest(to_leaves(again)) == digest(to_leaves(other))


Independent = tuple[Callable[[], TrainState], Callable[..., tuple[TrainState, dict]]]


@pytest.fixture(scope="module")
def independent(tiny_config: TrainConfig, tiny_world: World) -> Independent:
    """Returns functions that start and train a run with one learner for each robot.

    The third robot joins at the deadline of the first stage.
    """
    config = replace(
        tiny_config,
        algo=replace(tiny_config.algo, policy="independent"),
        curriculum=CurriculumConfig(threshold=1.0),
    )
    program = programs.build(config, tiny_world)
    schedule = programs.schedule(config)
    init = jax.jit(partial(loop.init, program))
    return lambda: init(schedule), jax.jit(partial(loop.train_chunk, program, schedule))


@pytest.mark.slow
def test_independent_robots_learn_apart(independent: Independent) -> None:
    """The third robot is absent from the first stage: its learner must not move at all."""
    start, train = independent
    before, after = start(), train(start(), np.int32(3))[0]
    name = "learners/params/actor/mean/kernel"
    moved = np.abs(to_leaves(after)[name] - to_leaves(before)[name]).max(axis=(1, 2))
    assert (moved[:2] > 1e-4).all()
    assert moved[2] == 0.0
    assert not np.array_equal(to_leaves(after)[name][0], to_leaves(after)[name][1])


@pytest.mark.slow
def test_newcomers_start_from_what_the_others_learned(independent: Independent) -> None:
    """The deadline comes after ten updates, which is half of the run."""
    start, train = independent
    before, metrics = train(start(), np.int32(9))
    after, decided = train(before, np.int32(1))
    assert not np.asarray(metrics["decision"]).any()
    assert int(decided["decision"][0]) == BY_BUDGET
    assert (int(before.curriculum.met), int(after.curriculum.met)) == (2, 3)
    untouched, kept, carried = (to_leaves(x.learners) for x in (start(), before, after))
    for name in carried:
        np.testing.assert_array_equal(kept[name][2], untouched[name][2], err_msg=name)
        np.testing.assert_array_equal(carried[name][2], carried[name][0], err_msg=name)


def test_xla_has_options_on_a_gpu_alone_and_knows_them(monkeypatch: pytest.MonkeyPatch) -> None:
    assert programs.compiler_options() == {}
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    options = programs.compiler_options(deterministic=True)
    assert options.keys() > programs.compiler_options().keys() > set()
    lowered = jax.jit(lambda x: x + 1.0).lower(1.0)
    assert lowered.compile(options)(1.0) == 2.0
    with pytest.raises(Exception, match="No such compile option"):
        lowered.compile({f"{name}_": value for name, value in options.items()})
