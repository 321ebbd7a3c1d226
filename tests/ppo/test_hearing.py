"""Checks networks that hear neighbours.

The order of neighbours does not matter, and absent neighbours do not count.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest

from swarmjax.ppo import dispatch, networks
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.networks import Hearing, Sizes
from swarmjax.ppo.ppo import PPO, LearnerState

OWN, COUNT, WIDTH, STATE = 3, 4, 5, 2
SIZE = OWN + COUNT * WIDTH
PLAIN = AlgoConfig(hidden_sizes=(8, 6), initial_std=0.6)
KINDS = {
    "plain": {},
    "gru": {"memory": "gru", "memory_size": 4},
    "state": {"critic": "state"},
    "both": {"memory": "gru", "memory_size": 4, "critic": "state"},
}


def _ppo(config: AlgoConfig, state: int = 0) -> PPO:
    sizes = Sizes(SIZE, 3, state, Hearing(OWN, COUNT, WIDTH))
    return learners.ppo(config, sizes, backend="autodiff")


def _learner(ppo: PPO) -> LearnerState:
    """Returns a learner whose weights have noise added, since new output layers are near 0."""
    made = jax.jit(ppo.init)(jax.random.key(0))
    leaves, tree = jax.tree.flatten(made.params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    drawn = [x + 0.3 * jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    return dataclasses.replace(made, params=jax.tree.unflatten(tree, drawn))


def _seen(there: tuple[int, ...] = (1, 1, 1, 0)) -> tuple[np.ndarray, np.ndarray]:
    """Returns a robot's own observation [OWN] and its neighbours' rows [COUNT, WIDTH].

    Rows of absent neighbours are 0.
    """
    draw = np.random.default_rng(2)
    rows = draw.uniform(-1, 1, (COUNT, WIDTH)).astype(np.float32)
    rows[:, 0] = 1.0
    return draw.normal(size=OWN).astype(np.float32), rows * np.array(there, np.float32)[:, None]


def _think(kind: str, own: np.ndarray, rows: np.ndarray) -> tuple[Any, Any]:
    """Returns the action and the value of one observation."""
    config = AlgoConfig(hidden_sizes=(8, 6), **KINDS[kind])
    sees = config.critic == "state"
    ppo = _ppo(config, STATE if sees else 0)
    mine, memory = _learner(ppo), ppo.begin_memory(())
    seen = jnp.concatenate([jnp.asarray(own), jnp.asarray(rows).ravel()])
    state = jnp.array([0.5, -0.5]) if sees else ()
    action, _, _ = jax.jit(ppo.act)(mine, seen, jnp.zeros(3), memory.actor)
    value, _ = jax.jit(ppo.value)(mine, seen, state, memory.critic)
    return np.asarray(action), np.asarray(value)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("order", [[1, 2, 0, 3], [3, 2, 1, 0]])
def test_the_order_of_neighbours_does_not_matter(kind: str, order: list[int]) -> None:
    own, rows = _seen()
    for found, expected in zip(
        _think(kind, own, rows[order]), _think(kind, own, rows), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=2e-6)  # float32 sums in another order


@pytest.mark.parametrize("kind", KINDS)
def test_a_neighbour_more_is_noticed(kind: str) -> None:
    own, rows = _seen((1, 1, 1, 1))
    for found, expected in zip(_think(kind, own, _seen()[1]), _think(kind, own, rows), strict=True):
        assert np.abs(found - expected).max() > 1e-3


def test_what_is_heard_is_the_sum_of_one_layer_of_each() -> None:
    mine = jax.tree.map(np.asarray, _learner(_ppo(PLAIN)).params["actor"])
    own, rows = _seen()
    each = np.tanh(rows @ mine["hearing"]["kernel"] + mine["hearing"]["bias"])
    x = np.concatenate([own, each[:3].sum(axis=0)])  # the fourth neighbour is absent
    for name in ("hidden_0", "hidden_1"):
        x = np.tanh(x @ mine["torso"][name]["kernel"] + mine["torso"][name]["bias"])
    expected = x @ mine["mean"]["kernel"] + mine["mean"]["bias"]
    np.testing.assert_allclose(_think("plain", own, rows)[0], expected, atol=1e-5)


def test_a_policy_that_does_not_hear_has_the_weights_that_it_had() -> None:
    made = jax.jit(learners.ppo(PLAIN, Sizes(SIZE, 2)).init)(jax.random.key(0))
    assert "hearing" not in made.params["actor"]


@pytest.mark.slow
def test_what_is_heard_is_not_normalised_by_what_was_heard_before() -> None:
    ppo = _ppo(AlgoConfig(hidden_sizes=(8, 6), num_minibatches=1))
    draw = np.random.default_rng(0)
    shape = (4, 8)
    batch = Batch(
        observation=jnp.asarray(draw.normal(3.0, 2.0, (*shape, SIZE)), jnp.float32),
        action=jnp.asarray(draw.normal(size=(*shape, 3)), jnp.float32),
        log_prob=jnp.full(shape, -3.0),
        advantage=jnp.asarray(draw.normal(size=shape), jnp.float32),
        return_=jnp.zeros(shape),
        valid=jnp.ones(shape, bool),
    )
    after, _ = ppo.update(_learner(ppo), batch, jax.random.key(0))
    assert (np.asarray(after.normalizer.mean)[:OWN] > 1.0).all()
    np.testing.assert_array_equal(after.normalizer.mean[OWN:], 0.0)
    np.testing.assert_array_equal(after.normalizer.variance[OWN:], 1.0)


def test_the_kernels_are_not_taken_for_robots_that_hear(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "_runs_kernels", lambda: True)
    plain = Sizes(10 + COUNT * WIDTH, 2)
    heard = plain._replace(hearing=Hearing(10, COUNT, WIDTH))
    for sizes, backend in ((plain, "fused"), (heard, "autodiff")):
        nets = networks.make(AlgoConfig(), sizes)
        assert dispatch.resolve(AlgoConfig(), nets, sizes) == backend
