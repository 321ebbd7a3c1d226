"""Checks PPO in seven worlds so small that the value and the best action are known.

The worlds that fail show which part of PPO is broken. They follow the probe environments of Andy
Jones, "Debugging Reinforcement Learning Systems" (2021).
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest

from swarmjax.ppo.batch import Batch, generalized_advantages
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.dispatch import Backend
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import LearnerState

WORLDS, UPDATES = 32, 60
CONFIG = AlgoConfig(
    hidden_sizes=(16, 16),
    rollout_length=8,
    epochs=4,
    num_minibatches=4,
    discount=0.5,
    actor_learning_rate=1e-2,
    critic_learning_rate=1e-2,
)


PPO_ = learners.ppo(CONFIG, Sizes(1, 1), UPDATES, "autodiff")


class Probe(NamedTuple):
    """A world with a number `draw`, -1 or 1 and fixed for an episode, and a clock."""

    length: int
    observe: Callable[[jax.Array, jax.Array], jax.Array]
    reward: Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
    ends_by_truncation: bool = False


class World(NamedTuple):
    draw: jax.Array
    clock: jax.Array


def _start(key: jax.Array) -> World:
    draw = jax.random.rademacher(key, (WORLDS,), jnp.float32)
    return World(draw, jnp.zeros(WORLDS, jnp.int32))


def _observe(probe: Probe, world: World) -> jax.Array:
    return probe.observe(world.draw, world.clock.astype(jnp.float32))[:, None]


def _act(
    probe: Probe, state: LearnerState, world: World, key: jax.Array
) -> tuple[World, dict[str, jax.Array]]:
    """Runs one step of all worlds; returns the new worlds and the samples of the step."""
    noise_key, reset_key = jax.random.split(key)
    observation = _observe(probe, world)
    noise = jax.random.normal(noise_key, (WORLDS, 1))
    action, log_prob, _ = PPO_.act(state, observation, noise)
    reached = world._replace(clock=world.clock + 1)
    ended = reached.clock == probe.length
    step = {
        "observation": observation,
        "action": action,
        "log_prob": log_prob,
        "reward": probe.reward(world.draw, action[:, 0], world.clock.astype(jnp.float32)),
        "value": PPO_.value(state, observation)[0],
        "next_value": PPO_.value(state, _observe(probe, reached))[0],
        "terminated": ended & (not probe.ends_by_truncation),
        "truncated": ended & probe.ends_by_truncation,
    }
    fresh = _start(reset_key)
    return jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, reached), step


def _iterate(
    probe: Probe, backend: Backend, carry: tuple[LearnerState, World], key: jax.Array
) -> tuple[tuple[LearnerState, World], None]:
    state, world = carry
    rollout_key, update_key = jax.random.split(key)
    keys = jax.random.split(rollout_key, CONFIG.rollout_length)
    world, steps = jax.lax.scan(functools.partial(_act, probe, state), world, keys)
    advantage, return_ = generalized_advantages(
        steps["reward"],
        steps["value"],
        steps["next_value"],
        steps["terminated"],
        steps["truncated"],
        discount=CONFIG.discount,
        gae_lambda=CONFIG.gae_lambda,
    )
    samples = {name: steps[name] for name in ("observation", "action", "log_prob")}
    samples |= {"advantage": advantage, "return_": return_, "valid": jnp.ones_like(advantage)}
    batch = Batch(**jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), samples))
    state, _ = replace(PPO_, backend=backend).update(state, batch, update_key)
    return (state, world), None


def _solve(probe: Probe, first: float = 0.0, backend: Backend = "autodiff") -> LearnerState:
    """Trains from a mean action of about `first`."""
    init_key, world_key, loop_key = jax.random.split(jax.random.key(0), 3)

    @jax.jit
    def run(state: LearnerState, world: World, keys: jax.Array) -> LearnerState:
        return jax.lax.scan(functools.partial(_iterate, probe, backend), (state, world), keys)[0][0]

    state = PPO_.init(init_key)
    state.params["actor"]["mean"]["bias"] = jnp.array([first])
    return run(state, _start(world_key), jax.random.split(loop_key, UPDATES))


def _values(state: LearnerState, *observations: float) -> jax.Array:
    return PPO_.value(state, jnp.array(observations)[:, None])[0]


def _modes(state: LearnerState, *observations: float) -> jax.Array:
    seen = jnp.array(observations)[:, None]
    return PPO_.act(state, seen, jnp.zeros_like(seen))[0][:, 0]


@pytest.mark.slow
def test_critic_learns_a_constant() -> None:
    state = _solve(
        Probe(1, lambda draw, clock: 0.0 * draw, lambda draw, action, clock: 1.0 + 0.0 * draw)
    )
    # The target is exactly 1, so only Adam's last, shrinking steps leave an error.
    np.testing.assert_allclose(_values(state, 0.0), [1.0], atol=0.01)


@pytest.mark.slow
def test_critic_learns_from_the_observation() -> None:
    state = _solve(Probe(1, lambda draw, clock: draw, lambda draw, action, clock: draw))
    # The targets are exact, so only Adam's last, shrinking steps leave an error.
    np.testing.assert_allclose(_values(state, -1.0, 1.0), [-1.0, 1.0], atol=0.01)


@pytest.mark.slow
def test_a_later_reward_is_discounted() -> None:
    state = _solve(Probe(2, lambda draw, clock: clock, lambda draw, action, clock: clock))
    # V(clock 1) = 1 and V(clock 0) = 0.5 * V(clock 1). The targets are exact once V(clock 1) is
    # learned.
    np.testing.assert_allclose(_values(state, 0.0, 1.0), [0.5, 1.0], atol=0.01)


def test_a_truncated_episode_is_valued_as_if_it_went_on() -> None:
    probe = Probe(
        3,
        lambda draw, clock: 0.0 * draw,
        lambda draw, action, clock: 1.0 + 0.0 * draw,
        ends_by_truncation=True,
    )
    # The value is 1 + 0.5 + 0.25 + ... = 2. If truncation ended the return, the value would be
    # 1.42 on average. The target moves with the critic, which converges more slowly than with an
    # exact target.
    np.testing.assert_allclose(_values(_solve(probe), 0.0), [2.0], atol=0.01)


@pytest.mark.slow
def test_actor_learns_the_best_action() -> None:
    state = _solve(
        Probe(1, lambda draw, clock: 0.0 * draw, lambda draw, action, clock: -((action - 0.5) ** 2))
    )
    # 0.02: noise of gradients from 256 samples, damped by the falling learning rate.
    np.testing.assert_allclose(_modes(state, 0.0), [0.5], atol=0.02)


@pytest.mark.slow
def test_actor_learns_the_best_action_of_each_observation() -> None:
    state = _solve(
        Probe(
            1, lambda draw, clock: draw, lambda draw, action, clock: -((action - 0.5 * draw) ** 2)
        )
    )
    # 0.02: noise of gradients from about 128 samples for each observation.
    np.testing.assert_allclose(_modes(state, -1.0, 1.0), [-0.5, 0.5], atol=0.02)


@pytest.mark.slow
def test_an_actor_beyond_the_range_of_commands_comes_back() -> None:
    def reward(draw: jax.Array, action: jax.Array, clock: jax.Array) -> jax.Array:
        return -((jnp.clip(action, -1.0, 1.0) - 0.5) ** 2)

    state = _solve(Probe(1, lambda draw, clock: 0.0 * draw, reward), first=-6.0)
    # A mean of -6 is eight deviations below -1, so all actions have the same reward. (From -4,
    # advantages that are all alike become noise when normalised, which leads some seeds back.)
    # The best mean is not exactly 0.5, since actions above 1 are clipped to 1.
    np.testing.assert_allclose(_modes(state, 0.0), [0.5], atol=0.05)


@pytest.mark.slow
def test_the_kernels_teach_the_actor_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    learners.interpret_kernels(monkeypatch)
    probe = Probe(
        1, lambda draw, clock: draw, lambda draw, action, clock: -((action - 0.5 * draw) ** 2)
    )
    # 0.02: noise of gradients, as with autodiff.
    np.testing.assert_allclose(
        _modes(_solve(probe, backend="fused"), -1.0, 1.0), [-0.5, 0.5], atol=0.02
    )
