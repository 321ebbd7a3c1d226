"""Tests that each robot is one Brax environment and that Brax ignores robots that wait."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from courses import LIMIT, SEED, Course, assert_close, drawn_key, follow, robots, steer

from swarmjax.environment import Swarm

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # Brax imports JAXopt, which warns that it is unmaintained
    from brax.envs.base import Env

    from swarmjax.adapters.brax_env import SwarmBraxEnv, mended_jax


@pytest.fixture(scope="module")
def env(swarm: Swarm) -> SwarmBraxEnv:
    return SwarmBraxEnv(swarm)


@pytest.fixture(scope="module")
def states(env: SwarmBraxEnv, course: Course) -> list[Any]:
    first = jax.jit(env.reset)(jnp.stack([drawn_key(SEED)] * 6))
    step, found = jax.jit(env.step), [first]
    for action in course.action:
        found.append(step(found[-1], robots(action)))
    return found


def test_it_is_one_of_braxs(env: SwarmBraxEnv, states: list) -> None:
    assert isinstance(env, Env)
    assert (env.num_envs, env.observation_size, env.action_size) == (6, 10, 2)
    for state in states[:2]:
        assert (state.obs.shape, state.obs.dtype) == ((6, 10), jnp.float32)
        for each in (state.reward, state.done, state.info["truncation"]):
            assert (each.shape, each.dtype) == ((6,), jnp.float32)
    # `lax.scan` requires its carry to keep one structure.
    assert jax.tree.structure(states[0]) == jax.tree.structure(states[1])


def test_observations_and_rewards_are_those_of_the_course(states: list, course: Course) -> None:
    np.testing.assert_array_equal(states[0].obs, robots(course.seen[0]))
    for state, after, reward in zip(states[1:], course.after, course.came.reward, strict=True):
        assert_close(state.obs, robots(after))
        assert_close(state.reward, robots(reward))


def test_nothing_is_learned_from_robots_that_wait(states: list, course: Course) -> None:
    came = course.came
    for t, state in enumerate(states[1:]):
        idle = robots(came.truncated[t] | ~came.valid[t])
        np.testing.assert_array_equal(state.info["truncation"], idle)
        np.testing.assert_array_equal(state.done, idle | robots(came.terminated[t]))
        np.testing.assert_array_equal(state.info["is_success"], robots(came.terminated[t]))


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        (jnp.zeros((5, 2)), r"^action has the shape \(5, 2\): give \(6, 2\)"),
        (jnp.zeros((6, 2), int), r"^action is of dtype int32: give float32"),
    ],
)
def test_wrong_actions_are_refused(
    env: SwarmBraxEnv, states: list, action: Any, sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        env.step(states[0], action)


def test_another_number_of_environments_is_refused(env: SwarmBraxEnv) -> None:
    with pytest.raises(ValueError, match=r"^num_envs is 4: give 6, the number of robots\.$"):
        env.reset(jax.random.split(jax.random.key(0), 4))


def test_jax_is_mended_for_a_while() -> None:
    name = "device_put_replicated"
    assert not hasattr(jax, name)  # if JAX has it again, remove the shim
    with mended_jax():
        tree = {"a": jnp.arange(3.0)}
        found = getattr(jax, name)(tree, jax.local_devices()[:1])
        np.testing.assert_array_equal(found["a"], [[0.0, 1.0, 2.0]])
    assert not hasattr(jax, name)


@pytest.mark.slow
def test_braxs_evaluator_counts_targets_reached(env: SwarmBraxEnv, course: Course) -> None:
    from brax.training import acting

    def steering(_: Any) -> Any:
        return lambda seen, key: (steer(seen), {})

    key = jax.random.key(0)
    evaluator = acting.Evaluator(env, steering, 6, LIMIT, 1, key)
    found = evaluator.run_evaluation(None, {}, aggregate_episodes=True)
    # The evaluator splits its key in two, and the second part into six keys, one per environment.
    # The adapter uses only the first of the six.
    bare = follow(env.robots.swarm, jax.random.split(jax.random.split(key)[1], 6)[0])
    reached, over = bare.came.terminated, bare.came.done.cumsum(axis=0) - bare.came.done > 0
    first = reached & ~over[..., None]  # counts only the first episode of each arena
    assert found["eval/episode_reached"] == pytest.approx(first.sum() / 6)
    assert 0 < first.sum() < 6


@pytest.mark.slow  # compiles the training step and the evaluator
def test_braxs_ppo_makes_an_update(env: SwarmBraxEnv) -> None:
    from brax.training.agents.ppo import networks, train

    sizes = {"policy_hidden_layer_sizes": (4,), "value_hidden_layer_sizes": (4,)}
    given = {"num_envs": 6, "batch_size": 3, "num_minibatches": 2, "unroll_length": 2}
    with mended_jax():
        _, params, _ = train.train(
            env,
            num_timesteps=12,
            wrap_env=False,
            run_evals=False,
            num_eval_envs=6,
            episode_length=LIMIT,
            max_devices_per_host=1,
            network_factory=lambda *shape, **more: networks.make_ppo_networks(
                *shape, **more, **sizes
            ),
            **given,
        )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
