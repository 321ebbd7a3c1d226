"""Checks a curriculum over levels in training: one trace, any chunk size, and replayed levels."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.curriculum.config import CurriculumConfig, LevelsConfig
from swarmjax.curriculum.engine import Schedule
from swarmjax.curriculum.levels import FRESH, MUTATED, LevelBuffer
from swarmjax.run.checkpoint import digest, from_leaves, to_leaves
from swarmjax.run.settings import TrainConfig
from swarmjax.task import extended
from swarmjax.task import stage as task_stage
from swarmjax.training import loop, practice, rollout
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.practice import LevelSource
from swarmjax.training.program import Program

UPDATES = 20


class Trained(NamedTuple):
    """A run of twenty single updates, with the state before each update and after the last."""

    program: Program
    schedule: Schedule
    chunk: Callable[..., tuple[TrainState, dict]]
    states: list[TrainState]
    rows: list[dict]


def _source(state: TrainState) -> LevelSource:
    found = state.arenas.source
    assert found is not None
    return found


def _buffer(state: TrainState) -> LevelBuffer:
    found = state.curriculum.levels
    assert found is not None
    return found


def _config(base: TrainConfig, **options: Any) -> TrainConfig:
    given = {"buffer": 24, "replay": 0.8, "minimum_episodes": 1, **options}
    levels = LevelsConfig(**given)
    curriculum = CurriculumConfig(mode="adaptive", floor=1.0, levels=levels)
    return replace(base, curriculum=curriculum)


@pytest.fixture(
    scope="module",
    params=[{"mode": "learnability"}, {"mode": "failure"}, {"mode": "value_loss", "mutation": 0.5}],
    ids=["learnability", "failure", "value_loss"],
)
def trained(request: pytest.FixtureRequest, tiny_config: TrainConfig) -> Trained:
    program, schedule = programs.load(_config(tiny_config, **request.param))
    traces = itertools.count(1)

    def chunk(schedule: Schedule, state: TrainState, n: np.int32) -> tuple[TrainState, dict]:
        assert next(traces) == 1, "traced again"
        return loop.train_chunk(program, schedule, state, jnp.asarray(n))

    jitted, init = jax.jit(chunk), partial(loop.init, program)
    # The first state is as restored from a checkpoint, whose numbers have no weak types.
    first = from_leaves(to_leaves(jax.jit(init)(schedule)), jax.eval_shape(init, schedule))
    states, rows = [first], []
    for _ in range(UPDATES):
        state, metrics = jitted(schedule, states[-1], np.int32(1))
        states.append(state)
        rows.append({name: np.asarray(x[0]) for name, x in metrics.items()})
    return Trained(program, schedule, jitted, states, rows)


@pytest.mark.parametrize("sizes", [[20], [7, 7, 6]])
def test_any_chunk_size_gives_the_same_run_bit_for_bit(sizes: list[int], trained: Trained) -> None:
    state = trained.states[0]
    for n in sizes:
        state, _ = trained.chunk(trained.schedule, state, np.int32(n))
    assert digest(to_leaves(state)) == digest(to_leaves(trained.states[-1]))


def test_a_run_goes_on_from_a_checkpoint_bit_for_bit(trained: Trained) -> None:
    leaves = to_leaves(trained.states[9])
    assert "curriculum/levels/numbers" in leaves
    assert "arenas/source/numbers" in leaves
    template = jax.eval_shape(partial(loop.init, trained.program), trained.schedule)
    state, _ = trained.chunk(trained.schedule, from_leaves(leaves, template), np.int32(11))
    assert digest(to_leaves(state)) == digest(to_leaves(trained.states[-1]))


def test_the_numbers_are_no_part_of_the_program(trained: Trained) -> None:
    """Changes the numbers: `chunk` fails if they need a second trace, and the run must differ."""
    levels = trained.schedule.levels
    assert levels is not None
    other = levels._replace(
        replay=np.float32(0.3),
        mutation=np.float32(0.1),
        temperature=np.float32(0.5),
        staleness=np.float32(0.9),
        minimum_episodes=np.int32(3),
    )
    state, _ = trained.chunk(
        trained.schedule._replace(levels=other), trained.states[0], np.int32(UPDATES)
    )
    assert digest(to_leaves(state)) != digest(to_leaves(trained.states[-1]))


def test_the_buffer_fills_and_is_played_from(trained: Trained) -> None:
    rows = trained.rows
    held = np.array([row["levels_held"] for row in rows])
    assert (np.diff(held, axis=0) >= 0).all()
    np.testing.assert_array_equal(held[-1], [12, 12])
    replayed = np.sum([row["levels_replayed"] for row in rows], axis=0)
    fresh = np.sum([row["levels_fresh"] for row in rows], axis=0)
    assert (replayed > 5).all()
    assert (fresh >= 12).all()
    mutates = trained.program.config.curriculum.levels.mutates
    mutated = np.sum([row["levels_mutated"] for row in rows])
    assert (mutated > 3) == mutates
    generations = np.asarray(_buffer(trained.states[-1]).generation)
    assert (generations.max() > 0) == mutates


def test_episodes_of_the_buffer_speak_for_no_stage(trained: Trained) -> None:
    """Checks that the curriculum over stages counts only episodes on newly drawn levels."""
    for state in trained.states:
        source = _source(state)
        fresh = np.asarray(source.slot) == FRESH
        counted = np.asarray(state.arenas.cohort) != rollout.UNCOUNTED
        assert not counted[~fresh].any()
    seen = [np.asarray(_source(state).slot) for state in trained.states]
    assert any((slot >= 0).any() for slot in seen)


def test_an_arena_is_on_the_level_that_its_numbers_say(trained: Trained) -> None:
    """Checks all bits of newly drawn, replayed and mutated levels."""
    world, stages = trained.program.world, jax.tree.map(jnp.asarray, trained.schedule.stages)

    @jax.jit
    @jax.vmap
    def again(numbers: jax.Array, stage: jax.Array) -> Any:
        return extended.draw(numbers, task_stage.select(stages, stage), world.spacing, ())

    kinds = set()
    for state in trained.states[::4]:
        source = _source(state)
        np.testing.assert_array_equal(source.stage, state.arenas.stage)
        expected = again(source.numbers, source.stage)
        for name, found in state.arenas.level._asdict().items():
            np.testing.assert_array_equal(found, getattr(expected, name), err_msg=name)
        kinds |= {int(min(slot, 0)) for slot in np.asarray(source.slot)}
    assert {FRESH, 0} <= kinds
    assert (MUTATED in kinds) == trained.program.config.curriculum.levels.mutates


def test_a_level_of_the_buffer_is_where_its_arenas_look_for_it(trained: Trained) -> None:
    for state in trained.states:
        slot = np.asarray(_source(state).slot)
        held = np.asarray(_buffer(state).numbers).reshape(24, -1)
        mine = np.asarray(_source(state).numbers)
        np.testing.assert_array_equal(held[slot[slot >= 0]], mine[slot >= 0])


def test_outcomes_of_a_rollout_are_those_of_its_episodes(trained: Trained) -> None:
    """Computes the outcomes in NumPy, arena by arena, from the ended episodes of the rollout."""
    program, state = trained.program, trained.states[-1]
    waiting = loop._draw_waiting(program, trained.schedule, state.curriculum, jax.random.key(5))
    collect = jax.jit(partial(rollout.collect, program))
    # An episode ends at 16 steps, a rollout at 8.
    arenas = replace(state.arenas, clock=jnp.array([0, 9, 10, 11, 12, 13, 14, 15], jnp.int32))
    after, trajectory, ended = collect(state.learners, arenas, waiting, jax.random.key(6))
    every = practice.line_up(_source(state), waiting.source)
    batch = rollout.batch(trajectory, program.config.algo)
    before = practice._nothing(jnp.zeros(8))
    loss, left = jax.jit(practice.gain)(before, batch, ended.episodes > 0)
    played = practice.plays(every, ended, loss, CurriculumConfig(success="all"))
    over, reached = np.asarray(ended.episodes) > 0, np.asarray(ended.all_reached)
    steps, robots = over.shape[0], np.asarray(trajectory.valid).shape[-1]
    advantage = np.asarray(batch.advantage).reshape(1, 8, steps, robots)[0]
    valid = np.asarray(batch.valid).reshape(1, 8, steps, robots)[0]
    for arena in range(8):
        ends = np.flatnonzero(over[:, arena])
        assert np.asarray(played.ended)[:, arena].sum() == min(len(ends), 2)
        begins = 0
        for row, end in enumerate(ends[:2]):
            mine = slice(begins, end + 1)
            kept = advantage[arena, mine][valid[arena, mine]]
            assert played.ended[row, arena]
            assert int(played.successes[row, arena]) == reached[end, arena]
            expected = np.maximum(kept, 0.0).sum() / max(len(kept), 1)
            np.testing.assert_allclose(played.loss[row, arena], expected, rtol=1e-5)  # float32
            begins = end + 1
        assert bool(played.begun[1, arena]) == (len(ends) > 0)
        assert not played.begun[0, arena]
        np.testing.assert_array_equal(
            after.source.numbers[arena], every.numbers[min(len(ends), 1), arena]
        )
        assert int(left.steps[arena]) == valid[arena, begins:].sum() or len(ends) > 2
    assert over.any()
