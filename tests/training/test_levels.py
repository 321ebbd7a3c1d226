"""Checks a curriculum over levels in training: one trace, any chunk size, and replayed levels."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.curriculum import levels as level_replay
from swarmjax.curriculum.config import CurriculumConfig
from swarmjax.curriculum.engine import UNCOUNTED, Schedule
from swarmjax.curriculum.levels import LevelBuffer
from swarmjax.ppo.batch import value_loss
from swarmjax.run.checkpoint import digest, from_leaves, to_leaves
from swarmjax.run.settings import TrainConfig
from swarmjax.task import extended, level
from swarmjax.task import stage as task_stage
from swarmjax.training import loop, rollout
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.rollout import Program

UPDATES = 20
pytestmark = pytest.mark.slow  # a run of the whole program; tests/curriculum has the rules


class Trained(NamedTuple):
    """A run of twenty single updates, with the state before each update and after the last."""

    program: Program
    schedule: Schedule
    chunk: Callable[..., tuple[TrainState, dict]]
    states: list[TrainState]
    rows: list[dict]


def _buffer(state: TrainState) -> LevelBuffer:
    return state.curriculum.own.buffer


def _seeds(state: TrainState) -> np.ndarray:
    seeds = state.arenas.seed
    assert seeds is not None
    return np.asarray(seeds)


def _config(base: TrainConfig, mode: str) -> TrainConfig:
    curriculum = CurriculumConfig(mode="adaptive", floor=1.0, levels=mode)  # type: ignore[arg-type]
    return replace(base, curriculum=curriculum)


@pytest.fixture(
    scope="module", params=["learnability", pytest.param("value_loss", marks=pytest.mark.slow)]
)
def trained(request: pytest.FixtureRequest, tiny_config: TrainConfig) -> Iterator[Trained]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(level_replay, "_PLACES", 24)
        patch.setattr(level_replay, "_REPLAY", 0.8)
        yield _train(_config(tiny_config, request.param))


def _train(config: TrainConfig) -> Trained:
    program, schedule = programs.load(config)
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


@pytest.mark.parametrize("sizes", [[20], pytest.param([7, 7, 6], marks=pytest.mark.slow)])
def test_any_chunk_size_gives_the_same_run_bit_for_bit(sizes: list[int], trained: Trained) -> None:
    state = trained.states[0]
    for n in sizes:
        state, _ = trained.chunk(trained.schedule, state, np.int32(n))
    assert digest(to_leaves(state)) == digest(to_leaves(trained.states[-1]))


def test_a_run_goes_on_from_a_checkpoint_bit_for_bit(trained: Trained) -> None:
    leaves = to_leaves(trained.states[9])
    assert "curriculum/own/buffer/seed" in leaves
    assert "arenas/seed" in leaves
    template = jax.eval_shape(partial(loop.init, trained.program), trained.schedule)
    state, _ = trained.chunk(trained.schedule, from_leaves(leaves, template), np.int32(11))
    assert digest(to_leaves(state)) == digest(to_leaves(trained.states[-1]))


def test_the_buffer_fills_and_is_played_from(trained: Trained) -> None:
    held = np.array([np.sum(_buffer(state).held, axis=1) for state in trained.states])
    assert (np.diff(held, axis=0) >= 0).all()
    np.testing.assert_array_equal(held[-1], [12, 12])
    replayed = [
        np.isin(_seeds(after), np.asarray(_buffer(before).seed)).sum()
        for before, after in itertools.pairwise(trained.states)
    ]
    assert sum(replayed) > 10


def test_episodes_of_the_buffer_speak_for_no_stage(trained: Trained) -> None:
    """Checks that the curriculum over stages counts only episodes on newly drawn levels."""
    begun = set()
    for state in trained.states:
        counted = np.asarray(state.arenas.cohort) != UNCOUNTED
        # A seed that is seen again in an arena is that of the same episode.
        now = set(zip(range(len(counted)), _seeds(state).tolist(), strict=True))
        again = {seed for _, seed in begun}
        for arena, seed in now - begun:
            assert not (counted[arena] and seed in again)
        begun |= now
        assert not counted[np.isin(_seeds(state), np.asarray(_buffer(state).seed))].any()


def test_an_arena_is_on_the_level_of_its_seed(trained: Trained) -> None:
    """Checks all bits of new and of replayed levels."""
    world, stages = trained.program.world, jax.tree.map(jnp.asarray, trained.schedule.stages)
    count = level.uniform_count(world.spacing)

    @jax.jit
    @jax.vmap
    def again(seed: jax.Array, stage: jax.Array) -> Any:
        numbers = jax.random.uniform(jax.random.key(seed), (count,))
        return extended.draw(numbers, task_stage.select(stages, stage), world.spacing, ())

    for state in trained.states[::4]:
        expected = again(jnp.asarray(_seeds(state)), state.arenas.stage)
        for name, drawn in state.arenas.level._asdict().items():
            np.testing.assert_array_equal(drawn, getattr(expected, name), err_msg=name)


def test_value_loss_of_a_rollout(trained: Trained) -> None:
    """Computes the loss in NumPy, arena by arena, from the ended episodes of the rollout."""
    program, state = trained.program, trained.states[-1]
    waiting = loop._draw(program, trained.schedule, state.curriculum, jax.random.key(5), waiting=1)
    # An episode ends at 16 steps, a rollout at 8.
    arenas = replace(state.arenas, clock=jnp.array([0, 9, 10, 11, 12, 13, 14, 15], jnp.int32))
    collect = jax.jit(partial(rollout.collect, program))
    _, trajectory, ended = collect(state.learners, arenas, waiting, jax.random.key(6))
    over = np.asarray(ended.episodes) > 0
    batch = rollout.batch(program, trajectory, arenas.recall, ended)
    loss = np.asarray(jax.jit(value_loss)(batch, over))
    steps, robots = over.shape[0], np.asarray(trajectory.valid).shape[-1]
    advantage = np.asarray(batch.advantage).reshape(8, steps, robots)
    valid = np.asarray(batch.valid).reshape(8, steps, robots)
    for arena in range(8):
        begins = 0
        for end in np.flatnonzero(over[:, arena]):
            mine = slice(begins, end + 1)
            kept = advantage[arena, mine][valid[arena, mine]]
            expected = np.maximum(kept, 0.0).sum() / max(len(kept), 1)
            np.testing.assert_allclose(loss[end, arena], expected, rtol=1e-5)  # float32
            begins = end + 1
    assert over.any()
