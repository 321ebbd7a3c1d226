"""The compiled loop: one trace, any chunk size, every stage."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax import curriculum, loop
from swarmjax.checkpoint import digest, to_leaves
from swarmjax.config import CurriculumConfig, StageConfig, TrainConfig
from swarmjax.curriculum import Schedule
from swarmjax.loop import Program, TrainState
from swarmjax.task.env import World

Chunk = Callable[[Schedule, TrainState, np.int32], tuple[TrainState, dict]]


@pytest.fixture(scope="module")
def program(tiny_config: TrainConfig, tiny_world: World) -> Program:
    return Program(tiny_config, tiny_world)


@pytest.fixture(scope="module")
def start(program: Program) -> Callable[[], TrainState]:
    init = jax.jit(partial(loop.init, program))
    return lambda: init(curriculum.schedule(program.config))


@pytest.fixture(scope="module")
def chunk(program: Program) -> Chunk:
    """Traces `loop.train_chunk` once for all tests of this module, or fails."""
    return _traced_once(program)


def _traced_once(program: Program) -> Chunk:
    """Jits `loop.train_chunk`; tracing it a second time is an error."""

    def chunk(schedule: Schedule, state: TrainState, n: np.int32) -> tuple[TrainState, dict]:
        return loop.train_chunk(program, schedule, state, jnp.asarray(n))

    return jax.jit(chex.assert_max_traces(chunk, n=1), donate_argnums=1)


def _run(chunk: Chunk, schedule: Schedule, state: TrainState, sizes: list[int]) -> TrainState:
    for n in sizes:
        state, _ = chunk(schedule, state, np.int32(n))
    return state


@pytest.mark.parametrize("sizes", [[7, 7, 6], [20], [1, 19]])
def test_any_chunk_size_gives_the_same_run_bit_for_bit(
    sizes: list[int], program: Program, start: Callable[[], TrainState], chunk: Chunk
) -> None:
    schedule = curriculum.schedule(program.config)
    one_by_one = _run(chunk, schedule, start(), [1] * 20)
    at_once = _run(chunk, schedule, start(), sizes)
    assert digest(to_leaves(one_by_one)) == digest(to_leaves(at_once))


def test_a_run_trains_and_reports_one_row_an_update(
    program: Program, start: Callable[[], TrainState], chunk: Chunk
) -> None:
    state, metrics = chunk(curriculum.schedule(program.config), start(), np.int32(5))
    assert int(state.update) == 5
    np.testing.assert_array_equal(metrics["update"][:5], np.arange(5))
    before, after = to_leaves(start()), to_leaves(state)
    name = "learners/params/actor/mean/kernel"
    assert np.max(np.abs(before[name] - after[name])) > 1e-4
    # 8 arenas of two robots for 8 control steps; those that arrive early add fewer.
    assert 0 < metrics["transitions"][0] <= 8 * 2 * 8
    assert set(np.asarray(metrics["broken_arenas"][:5])) == {0}


def test_stage_numbers_are_no_part_of_the_program(
    program: Program, start: Callable[[], TrainState], chunk: Chunk
) -> None:
    """A later trace would fail in `chunk`, which allows one; the numbers must matter as well."""
    schedule = curriculum.schedule(program.config)
    wider = schedule._replace(stages=schedule.stages._replace(side=schedule.stages.side * 1.5))
    state, _ = chunk(schedule, start(), np.int32(20))
    other, _ = chunk(wider, start(), np.int32(20))
    sides = {round(float(side), 3) for side in np.asarray(other.arenas.level.side)}
    assert sides <= {0.5, 0.75, 1.2}  # 0.5: drawn by `start`, still running
    assert 0.75 in sides or 1.2 in sides
    assert digest(to_leaves(state)) != digest(to_leaves(other))


def test_the_curriculum_visits_every_stage_within_one_trace(tiny_config: TrainConfig) -> None:
    """All six stages of the default, promoted by deadline since nothing is learned so fast."""
    sizes = [(2, 0.5, 0), (2, 0.7, 0), (3, 0.7, 1), (3, 1.0, 2), (5, 1.0, 2), (5, 1.2, 3)]
    stages = tuple(
        StageConfig(name=f"s{i + 1}", robots=robots, side=side, obstacles=obstacles)
        for i, (robots, side, obstacles) in enumerate(sizes)
    )
    config = replace(
        tiny_config,
        stage=stages,
        sim=replace(tiny_config.sim, max_robots=5, max_obstacles=3),
        curriculum=CurriculumConfig(threshold=1.0, budget_share=0.8),
        budget=8 * 8 * 25,
    )
    program, schedule = loop.load(config)
    chunk = _traced_once(program)
    state = jax.jit(partial(loop.init, program))(schedule)
    state, metrics = chunk(schedule, state, np.int32(10))
    state, more = chunk(schedule, state, np.int32(15))
    visited = np.concatenate([metrics["stage"][:10], more["stage"][:15]])
    # 20 updates for the first five stages, four each: a deadline of 4, 8, 12, 16 and 20.
    np.testing.assert_array_equal(visited, np.repeat(np.arange(6), [4, 4, 4, 4, 4, 5]))
    assert set(np.asarray(state.arenas.stage)) <= {4, 5}
    assert int(np.max(np.sum(state.arenas.level.present, axis=-1))) == 5


def test_independent_robots_learn_apart(tiny_config: TrainConfig, tiny_world: World) -> None:
    """The third robot is absent from the first stage: its learner must not move at all."""
    config = replace(
        tiny_config,
        stage=tiny_config.stage[:1],
        algo=replace(tiny_config.algo, policy="independent"),
    )
    program = Program(config, replace(tiny_world, config=config))
    schedule = curriculum.schedule(config)
    before = jax.jit(partial(loop.init, program))(schedule)
    after, _ = jax.jit(partial(loop.train_chunk, program))(schedule, before, np.int32(3))
    name = "learners/params/actor/mean/kernel"
    moved = np.abs(to_leaves(after)[name] - to_leaves(before)[name]).max(axis=(1, 2))
    assert (moved[:2] > 1e-4).all()
    assert moved[2] == 0.0
    assert not np.array_equal(to_leaves(after)[name][0], to_leaves(after)[name][1])
