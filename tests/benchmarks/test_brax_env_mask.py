"""Brax learns from robots on their way alone."""

import warnings
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.run.settings import TrainConfig
from swarmjax.training import program as programs

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # JAXopt, which Brax imports, says that nobody keeps it up
    brax_env = pytest.importorskip("benchmarks.brax_env", exc_type=ImportError)

ARENAS, ROBOTS = 8, 3  # of the tiny configuration, whose first stage has two robots


def _swarm(base: TrainConfig) -> Any:
    """Without obstacles and with one solver iteration, which compiles sooner."""
    sim = replace(base.sim, max_obstacles=0, iterations=1, ls_iterations=1)
    config = replace(base, stage=base.stage[:1], sim=sim)
    return brax_env.SwarmEnv(*programs.load(config))


def test_brax_learns_nothing_from_robots_that_wait_for_the_others(tiny_config: TrainConfig) -> None:
    swarm = _swarm(tiny_config)
    state = jax.jit(swarm.reset)(jax.random.split(jax.random.PRNGKey(0), ARENAS * ROBOTS))
    # In every other arena the second robot has arrived, and the first is on its way.
    waits = np.zeros((ARENAS, ROBOTS), bool)
    waits[::2, 1] = True
    inner = state.pipeline_state
    inner = replace(inner, now=replace(inner.now, arrived=jnp.asarray(waits)))
    stepped = jax.jit(swarm.step)(
        state.replace(pipeline_state=inner), jnp.zeros((ARENAS * ROBOTS, 2))
    )
    assert not np.asarray(stepped.pipeline_state.now.clock - 1).any()  # nowhere is it over
    # Neither are there third robots. Brax gives what it takes for truncated no advantage.
    expected = np.where(waits | (np.arange(ROBOTS) == 2), 1.0, 0.0).ravel()
    np.testing.assert_array_equal(stepped.info["truncation"], expected)
    np.testing.assert_array_equal(stepped.done, expected)
