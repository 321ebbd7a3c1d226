"""Checks that the timed parts of an update are the parts of the training loop's update."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

from benchmarks import update_parts
from swarmjax.config import ConfigError
from swarmjax.run.settings import TrainConfig
from swarmjax.training import loop
from swarmjax.training import program as programs


@pytest.mark.slow
def test_the_parts_make_an_update(tiny_config: TrainConfig) -> None:
    program, schedule = programs.load(tiny_config)
    state = jax.jit(partial(loop.init, program))(schedule)
    _, level_key, rollout_key, learn_key = jax.random.split(state.key, 4)
    waiting = jax.jit(partial(update_parts.draw, program))(schedule, state, level_key)
    batch = jax.jit(partial(update_parts.collect, program))(state, waiting, rollout_key)
    found = jax.jit(partial(update_parts.learn, program))(state, batch, learn_key)
    expected = jax.jit(partial(loop.update, program))(schedule, state)[0].learners
    for mine, theirs in zip(
        jax.tree.leaves(found.params), jax.tree.leaves(expected.params), strict=True
    ):
        # XLA fuses a part differently from the whole, which changes the rounding of float32.
        np.testing.assert_allclose(mine, theirs, atol=1e-5)
    starts = jax.tree.leaves(state.learners.params)
    assert any(
        np.abs(np.asarray(mine) - np.asarray(start)).max() > 1e-4
        for mine, start in zip(jax.tree.leaves(found.params), starts, strict=True)
    )


@pytest.mark.slow
def test_each_part_has_a_line(tiny_config: TrainConfig) -> None:
    lines = list(update_parts.results(tiny_config))
    assert [line["part"] for line in lines] == ["draw", "collect", "learn"]
    assert all(line["ms"] > 0.0 and line["compile_s"] > 0.0 for line in lines)


@pytest.mark.slow
def test_the_parts_of_several_seeds_are_timed_together(tiny_config: TrainConfig) -> None:
    lines = list(update_parts.results(replace(tiny_config, seeds=2)))
    assert [line["seeds"] for line in lines] == [2, 2, 2]


def test_one_device_is_timed(tiny_config: TrainConfig) -> None:
    with pytest.raises(ConfigError, match=r"^devices is 2: give devices=1"):
        next(update_parts.results(replace(tiny_config, devices=2)))
