"""Checks the gated recurrent unit: its equations, its gradient through time, and its resets."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest
from flax import linen as nn
from jax.flatten_util import ravel_pytree

from swarmjax.config import ConfigError
from swarmjax.ppo import gradients
from swarmjax.ppo.batch import Batch, generalized_advantages
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.memory import NO_MEMORY, Gru, Recall
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import PPO

STEPS, ROWS, WIDTH, SIZE = 6, 3, 4, 5


def _drawn(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def _run(made: Gru, params: Any, *given: Any) -> tuple[np.ndarray, np.ndarray]:
    found: Any = made.apply(params, *given)
    return np.asarray(found[0]), np.asarray(found[1])


def _gru() -> tuple[Gru, Any]:
    made = Gru(SIZE)
    params = made.init(jax.random.key(0), jnp.zeros((ROWS, WIDTH)), jnp.zeros((ROWS, SIZE)))
    shapes = jax.tree.map(jnp.shape, params)
    leaves, tree = jax.tree.flatten(shapes, is_leaf=lambda x: isinstance(x, tuple))
    drawn = [0.7 * _drawn(*shape, seed=i) for i, shape in enumerate(leaves)]
    return made, jax.tree.unflatten(tree, drawn)


def test_the_unit_is_that_of_flax() -> None:
    made, params = _gru()
    features, memory = _drawn(ROWS, WIDTH), _drawn(ROWS, SIZE, seed=1)
    mine = params["params"]
    # Flax has a recurrent bias for the candidate only, so the biases of the gates are set to 0.
    recalled = np.array(mine["recurrent"]["bias"])
    mine["recurrent"]["bias"] = np.where(np.arange(3 * SIZE) < 2 * SIZE, 0.0, recalled)
    theirs: dict[str, Any] = {}
    for i, gate in enumerate("rzn"):
        part = slice(i * SIZE, (i + 1) * SIZE)
        theirs[f"i{gate}"] = {k: mine["input"][k][..., part] for k in ("kernel", "bias")}
        theirs[f"h{gate}"] = {"kernel": mine["recurrent"]["kernel"][:, part]}
    theirs["hn"]["bias"] = mine["recurrent"]["bias"][2 * SIZE :]
    beside, after = _run(made, params, features, memory)
    cell: Any = nn.GRUCell(SIZE)
    expected, _ = cell.apply({"params": theirs}, memory, features)
    np.testing.assert_allclose(after, expected, atol=1e-6)  # float32, numbers of about 1
    np.testing.assert_array_equal(beside, after)


def test_a_sequence_is_its_steps_one_by_one_and_forgets_where_an_episode_begins() -> None:
    made, params = _gru()
    features, memory = _drawn(STEPS, ROWS, WIDTH), _drawn(ROWS, SIZE, seed=1)
    begins = np.zeros((STEPS, ROWS), bool)
    begins[2, 0] = begins[4, 1] = begins[0, 2] = True
    found, last = _run(made, params, features, memory, begins)
    now = memory
    for step in range(STEPS):
        now = np.where(begins[step][:, None], 0.0, now)
        beside, now = _run(made, params, features[step], now)
        np.testing.assert_allclose(found[step], beside, atol=1e-6)
    np.testing.assert_allclose(last, now, atol=1e-6)


def test_nothing_leaks_over_the_border_of_an_episode() -> None:
    made, params = _gru()
    features, memory = jnp.array(_drawn(STEPS, ROWS, WIDTH)), _drawn(ROWS, SIZE, seed=1)
    begins = jnp.zeros((STEPS, ROWS), bool).at[3].set(True)

    def after(features: jax.Array) -> jax.Array:
        found: Any = made.apply(params, features, memory, begins)
        return jnp.sum(found[0][3:] ** 2)

    gradient = np.asarray(jax.grad(after)(features))
    assert (gradient[:3] == 0.0).all()
    assert (gradient[3:] != 0.0).all()


CONFIG = AlgoConfig(
    memory="gru", memory_size=SIZE, hidden_sizes=(4,), num_minibatches=1, rollout_length=8
)


def _minibatch() -> Batch:
    sequences, length = 3, CONFIG.rollout_length
    count = sequences * length
    begins = np.zeros((length, sequences), bool)
    begins[5, 1] = True
    return Batch(
        observation=jnp.array(_drawn(count, WIDTH)),
        action=jnp.array(_drawn(count, 2, seed=1)),
        log_prob=jnp.full(count, -2.5),
        advantage=jnp.array(_drawn(count, seed=2)),
        return_=jnp.array(_drawn(count, seed=3)),
        valid=jnp.array(np.arange(count) % 7 > 0),
        memory=Recall(*(jnp.array(_drawn(sequences, SIZE, seed=i)) for i in (4, 5))),
        begins=jnp.array(begins.reshape(-1)),
    )


@pytest.mark.slow
def test_the_gradient_through_time_is_that_of_finite_differences() -> None:
    with jax.enable_x64(True):
        minibatch = jax.tree.map(
            lambda x: x.astype(float) if x.dtype == jnp.float32 else x, _minibatch()
        )
        nets = learners.nets(CONFIG, WIDTH, 2)
        params = nets.init(jax.random.key(0))
        flat, tree = ravel_pytree(jax.tree.map(lambda x: x.astype(float), params))
        towards = np.random.default_rng(0).normal(size=(4, len(flat)))

        def loss(flat: jax.Array) -> jax.Array:
            return gradients.ppo_loss(tree(flat), minibatch, nets, CONFIG, jnp.float64(20.0))[0]

        gradient, step = jax.grad(loss)(flat), 1e-6
        for way in towards:
            slope = (loss(flat + step * way) - loss(flat - step * way)) / (2 * step)
            # A float64 difference over 2e-6 has a rounding error of about 1e-9, and the curvature
            # adds an error of 1e-10.
            np.testing.assert_allclose(gradient @ way, slope, rtol=1e-6)


# --- a task that only a memory solves

_EPISODE, _WORLDS, _UPDATES = 21, 64, 150


def _play(ppo: PPO, state: Any, key: jax.Array, history: int) -> tuple[Batch, jax.Array]:
    """Plays one episode in each world and returns the batch and the mean reward.

    The first step shows a cue of -1 or 1, and the last step rewards an action of the cue's sign.
    With a `history` above 1, the networks see that many observations, the newest first.
    """
    cue_key, noise_key = jax.random.split(key)
    cue = jax.random.rademacher(cue_key, (_WORLDS,), jnp.float32)
    clock = jnp.arange(_EPISODE)[:, None]
    shown = jnp.where(clock == 0, cue, 0.0)
    asked = jnp.broadcast_to(clock == _EPISODE - 1, shown.shape).astype(jnp.float32)
    looks = jnp.stack([shown, asked], axis=-1)
    seen = jax.lax.scan(_stacked, jnp.zeros((_WORLDS, 2 * history)), looks)[1]
    noise = jax.random.normal(noise_key, (_EPISODE, _WORLDS, 1))
    memory = ppo.begin_memory((_WORLDS,))

    def step(carry: Any, now: Any) -> tuple[Any, Any]:
        mine, theirs = carry
        action, log_prob, mine = ppo.act(state, now[0], now[1], mine)
        value, theirs = ppo.value(state, now[0], (), theirs)
        return (mine, theirs), (action, log_prob, value)

    _, (action, log_prob, value) = jax.lax.scan(step, tuple(memory), (seen, noise))
    reward = asked * jnp.where(jnp.sign(action[..., 0]) == cue, 1.0, 0.0)
    over = asked > 0
    next_value = jnp.concatenate([value[1:], jnp.zeros_like(value[:1])])
    advantage, return_ = generalized_advantages(
        reward, value, next_value, over, jnp.zeros_like(over), discount=1.0, gae_lambda=1.0
    )
    begins = jnp.broadcast_to(clock == 0, shown.shape)
    parts = (seen, action, log_prob, advantage, return_, jnp.ones_like(over), begins)
    grouped = [jnp.moveaxis(x, 0, 1) for x in parts]
    batch = Batch(**dict(zip(_FIELDS, grouped[:6], strict=True)))
    if ppo.config.memory == "gru":
        groups = jax.tree.map(lambda x: x[:, None], memory)
        batch = replace(batch, memory=groups, begins=grouped[6])
    return batch, jnp.sum(reward) / _WORLDS


def _stacked(before: jax.Array, fresh: jax.Array) -> tuple[jax.Array, jax.Array]:
    after = jnp.concatenate([fresh, before], axis=-1)[..., : before.shape[-1]]
    return after, after


_FIELDS = ("observation", "action", "log_prob", "advantage", "return_", "valid")


@pytest.mark.parametrize(
    ("memory", "history", "low", "high"),
    [
        ("gru", 1, 0.95, 1.0),
        ("none", 21, 0.95, 1.0),
        ("none", 20, 0.4, 0.6),  # one observation too few
        ("none", 1, 0.4, 0.6),
    ],
)
@pytest.mark.slow
def test_a_task_that_asks_for_what_was_seen_twenty_steps_ago(
    memory: Any, history: int, low: float, high: float
) -> None:
    config = AlgoConfig(
        memory=memory,
        memory_size=16 if memory == "gru" else 64,
        hidden_sizes=(16,),
        rollout_length=_EPISODE,
        num_minibatches=2,
        epochs=4,
        discount=1.0,
        actor_learning_rate=5e-3,
        critic_learning_rate=5e-3,
        learning_rate_schedule="constant",
    )
    ppo = learners.ppo(config, Sizes(2 * history, 1), _UPDATES, "autodiff")
    state = jax.jit(ppo.init)(jax.random.key(3))

    @jax.jit
    def train(state: Any) -> tuple[Any, jax.Array]:
        def update(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            play_key, learn_key = jax.random.split(key)
            batch, success = _play(ppo, state, play_key, history)
            return ppo.update(state, batch, learn_key)[0], success

        return jax.lax.scan(update, state, jax.random.split(jax.random.key(4), _UPDATES))

    _, success = train(state)
    # Chance is 1/2. The mean of 640 random episodes is off by more than 0.1 with a chance of one in
    # a million.
    assert low <= float(jnp.mean(success[-10:])) <= high


@pytest.mark.slow
def test_a_memory_that_is_no_number_spoils_nothing() -> None:
    """Gives a robot without valid samples a memory of NaN, which must change nothing."""
    groups, robots, length = 4, 2, CONFIG.rollout_length
    shape = (groups, length * robots)
    valid = np.tile([True, False], length)
    memory = np.zeros((groups, robots, SIZE), np.float32)
    memory[:, 1] = np.nan
    batch = Batch(
        observation=jnp.array(_drawn(*shape, WIDTH)),
        action=jnp.array(_drawn(*shape, 2, seed=1)),
        log_prob=jnp.full(shape, -2.5),
        advantage=jnp.array(_drawn(*shape, seed=2)),
        return_=jnp.array(_drawn(*shape, seed=3)),
        valid=jnp.array(np.broadcast_to(valid, shape)),
        memory=Recall(jnp.array(memory), jnp.array(memory)),
        begins=jnp.zeros(shape, bool),
    )
    ppo = learners.ppo(CONFIG, Sizes(WIDTH, 2), backend="autodiff")
    after, metrics = jax.jit(ppo.update)(
        jax.jit(ppo.init)(jax.random.key(0)), batch, jax.random.key(1)
    )
    assert float(metrics["skipped_steps"]) == 0.0
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(after.params))


# --- settings that do not go with a memory


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"mean_activation": "tanh"}, "mean_activation is tanh, but .* memory is gru"),
        ({"network": "mine"}, "network is 'mine', but memory is gru"),
        ({"memory": "none", "memory_size": 8}, "memory_size is 8, but memory is none"),
    ],
)
def test_refuses_what_goes_with_no_memory(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        AlgoConfig(**({"memory": "gru"} | changed))


@pytest.mark.slow
def test_a_uniform_unit_begins_within_the_bound_of_pytorch() -> None:
    config = replace(CONFIG, initialization="uniform", memory_size=64)
    params = learners.nets(config, WIDTH, 2).init(jax.random.key(0))["actor"]["memory"]
    for part in jax.tree.leaves(params):
        assert 0.1 < np.abs(part).max() <= 1 / 8


def test_a_memory_begins_empty() -> None:
    assert learners.nets(AlgoConfig(), 3, 2).begin_memory((2, 3)) == NO_MEMORY
    made = learners.nets(CONFIG, 3, 2).begin_memory((2, 3))
    assert [x.shape for x in made] == [(2, 3, SIZE)] * 2
    assert not any(np.any(x) for x in made)
