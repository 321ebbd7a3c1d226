"""Checks that a run which goes on with newly drawn arenas keeps all it has learned and measured."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np
import pytest

from swarmjax.run.checkpoint import to_leaves
from swarmjax.run.settings import TrainConfig
from swarmjax.task.env import World
from swarmjax.training import loop
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState


@pytest.fixture(scope="module")
def states(tiny_config: TrainConfig, tiny_world: World) -> tuple[TrainState, TrainState]:
    """Returns a state on the second stage with counted episodes, without and with new arenas."""
    algo = replace(tiny_config.algo, memory="gru", memory_size=4)
    program = programs.build(replace(tiny_config, algo=algo), tiny_world)
    schedule = programs.schedule(tiny_config)
    begun = jax.jit(partial(loop.init, program))(schedule)
    remembered = jax.tree.map(lambda x: x + 1.0, begun.arenas.recall)
    begun = replace(begun, arenas=replace(begun.arenas, recall=remembered))
    cohorts, own = begun.curriculum.cohorts, begun.curriculum.own
    tally = jax.tree.map(lambda x: x + 3, cohorts.current)
    chosen = own.chosen._replace(stage=np.int32(1), weights=np.float32([0.0, 1.0]))
    there = replace(
        begun.curriculum,
        cohorts=replace(cohorts, age=np.int32(1), current=tally),
        own=replace(own, chosen=chosen),
    )
    before = replace(begun, curriculum=there)
    without: Any = replace(before, arenas=None)
    return before, jax.jit(partial(loop.draw_arenas, program))(schedule, without)


@pytest.mark.slow
def test_learners_and_updates_stay(states: tuple[TrainState, TrainState]) -> None:
    before, after = map(to_leaves, states)
    for name in before:
        if name.startswith("learners/") or name == "update":
            np.testing.assert_array_equal(after[name], before[name], err_msg=name)


def test_what_the_curriculum_has_decided_stays(states: tuple[TrainState, TrainState]) -> None:
    before, after = (
        (state.curriculum.own, state.curriculum.cohorts.record, state.curriculum.met)
        for state in states
    )
    jax.tree.map(np.testing.assert_array_equal, after, before)


def test_arenas_begin_on_the_stages_of_now(states: tuple[TrainState, TrainState]) -> None:
    before, after = states
    assert set(before.arenas.stage.tolist()) == {0}
    assert set(after.arenas.stage.tolist()) == {1}


def test_arenas_begin_with_nothing_to_remember(states: tuple[TrainState, TrainState]) -> None:
    recall = states[1].arenas.recall
    assert recall is not None
    assert not any(np.any(part) for part in recall)


def test_a_cohort_begins_that_holds_all_new_episodes(states: tuple[TrainState, TrainState]) -> None:
    before, after = states
    assert int(after.curriculum.cohorts.number) == int(before.curriculum.cohorts.number) + 1
    assert int(after.curriculum.cohorts.age) == 0
    assert set(after.arenas.cohort.tolist()) == {int(after.curriculum.cohorts.number)}


def test_episodes_that_were_lost_are_not_counted(states: tuple[TrainState, TrainState]) -> None:
    cohorts = states[1].curriculum.cohorts
    for tally in (cohorts.current, cohorts.previous):
        assert [int(np.sum(x)) for x in tally] == [0] * len(tally)


def test_other_levels_are_drawn(states: tuple[TrainState, TrainState]) -> None:
    before, after = states
    assert not np.array_equal(before.arenas.observation, after.arenas.observation)
