"""Tests one arena as an environment of MuJoCo Playground, which has no checker."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from courses import ARENA_SEED, LIMIT, Course, assert_close, drawn_key

from swarmjax.environment import Swarm

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # Brax imports JAXopt, which warns that it is unmaintained
    from mujoco_playground import MjxEnv, wrapper

    from swarmjax.adapters.playground import SwarmMjxEnv


@pytest.fixture(scope="module")
def env(arena: Swarm) -> SwarmMjxEnv:
    return SwarmMjxEnv(arena)


@pytest.fixture(scope="module")
def wrapped(env: SwarmMjxEnv) -> Any:
    return wrapper.wrap_for_brax_training(env, env.episode_length, full_reset=True)


@pytest.fixture(scope="module")
def states(env: SwarmMjxEnv, arena_course: Course) -> list[Any]:
    step, found = jax.jit(env.step), [jax.jit(env.reset)(drawn_key(ARENA_SEED))]
    for action in arena_course.action:
        found.append(step(found[-1], action.ravel()))
    return found


def test_what_playground_asks(env: SwarmMjxEnv) -> None:
    assert isinstance(env, MjxEnv)
    assert (env.observation_size, env.action_size, env.episode_length) == (20, 4, LIMIT)
    assert (env.dt, env.n_substeps) == (0.032, env.robots.swarm.world.physics.substeps)
    assert env.mj_model.nbody > 2


@pytest.mark.slow
def test_it_follows_the_course(states: list, arena_course: Course) -> None:
    came = arena_course.came
    for t, state in enumerate(states[1:]):
        assert_close(state.obs, arena_course.after[t].ravel())
        assert_close(state.reward, came.reward[t].sum())
        assert_close(state.metrics["reached"], came.terminated[t].sum() / 2)
        assert state.done == 0.0  # a robot times out, and only the wrapper reports that
        assert not state.info["is_success"]


@pytest.mark.slow
def test_done_says_that_all_have_arrived(env: SwarmMjxEnv, states: list) -> None:
    state = states[50]
    arenas = state.data.arenas
    everyone = jnp.ones_like(arenas.arrived)
    state = state.replace(data=state.data.replace(arenas=arenas.replace(arrived=everyone)))
    last = jax.jit(env.step)(state, jnp.zeros(4))
    assert last.done == 1.0
    assert last.info["is_success"].dtype == bool
    assert last.info["is_success"]


@pytest.mark.slow
def test_playgrounds_wrapper_ends_episodes_and_draws_new_levels(wrapped: Any) -> None:
    keys = jax.random.split(jax.random.PRNGKey(0), 3)  # Brax's wrappers take only old-style keys
    state, step = jax.jit(wrapped.reset)(keys), jax.jit(wrapped.step)
    first = state.obs
    for _ in range(LIMIT - 1):
        state = step(state, jnp.tile(jnp.array([-1.0, 0.0]), (3, 2)))  # all stand still
        assert not state.done.any()
    state = step(state, jnp.zeros((3, 4)))
    np.testing.assert_array_equal(state.done, np.ones(3))
    # With `full_reset`, Playground 0.2.0 drops all of `info`, including `truncation`.
    assert (state.obs != first).any(axis=1).all()
    # The observation belongs to the state from which the next step starts.
    np.testing.assert_array_equal(state.obs, state.data.observation.reshape(3, -1))


@pytest.mark.slow
@pytest.mark.parametrize("action", [jnp.zeros(2), jnp.zeros(4, int)])
def test_wrong_actions_are_refused(env: SwarmMjxEnv, states: list, action: Any) -> None:
    with pytest.raises(ValueError, match=r"^action "):
        env.step(states[0], action)
