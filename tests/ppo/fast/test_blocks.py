"""Checks that gradients computed in blocks equal the gradient of the whole batch."""

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest

from swarmjax.ppo import gradients, networks
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.fast import blocks
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import LearnerState

CONFIG = AlgoConfig(hidden_sizes=(8,), num_minibatches=1, epochs=3, entropy_cost=0.01)
GROUPS, SAMPLES = 3, 250  # 750 samples fill two blocks of 256 and part of a third
OBSERVATION, ACTION = 10, 2


PPO_ = learners.ppo(CONFIG, Sizes(OBSERVATION, ACTION), 5, "blocks")


def _batch(share: float, seed: int = 0) -> Batch:
    """Returns samples [G, N, ...] of which about this share is valid; the others are 0."""
    rng = np.random.default_rng(seed)
    valid = rng.uniform(size=(GROUPS, SAMPLES)) < share
    valid[0, 0] |= share > 0.0  # copies of this sample fill the blocks and must not count
    drawn = {
        "observation": rng.normal(size=(GROUPS, SAMPLES, OBSERVATION)),
        "action": rng.normal(size=(GROUPS, SAMPLES, ACTION)),
        **{
            name: rng.normal(size=(GROUPS, SAMPLES))
            for name in ("log_prob", "advantage", "return_")
        },
    }
    kept = {k: x * valid.reshape(valid.shape + (1,) * (x.ndim - 2)) for k, x in drawn.items()}
    return Batch(valid=valid, **{k: x.astype(np.float32) for k, x in kept.items()})


def _params() -> networks.Params:
    return jax.jit(PPO_.learning.networks.init)(jax.random.key(0))


@pytest.mark.parametrize(("share", "used"), [(1.0, 3), (0.5, 2), (0.1, 1), (0.0, 0)])
def test_the_gradient_is_that_of_all_samples_at_once(share: float, used: int) -> None:
    samples, params = _batch(share), _params()
    arranged, filled = jax.jit(blocks.arrange)(samples)
    assert int(filled) == used  # 750, about 375, about 75 and 0 samples, in blocks of 256
    count = jnp.sum(samples.valid)
    gradient = jax.jit(blocks.gradient, static_argnums=3)
    found = gradient(params, arranged, filled, PPO_.learning, count)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)
    whole = jax.jit(jax.grad(gradients.ppo_loss, has_aux=True), static_argnums=(2, 3))
    # float32 rounding: the two gradients add the samples in different orders.
    for mine, theirs in zip(
        jax.tree.leaves(found),
        jax.tree.leaves(whole(params, flat, PPO_.learning.networks, CONFIG, count)),
        strict=True,
    ):
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-6)


def test_valid_samples_come_first_in_their_order() -> None:
    samples = _batch(0.5)
    arranged, _ = blocks.arrange(samples)
    valid = samples.valid.reshape(-1)
    kept = samples.advantage.reshape(-1)[valid]
    np.testing.assert_array_equal(arranged.advantage.reshape(-1)[: len(kept)], kept)
    np.testing.assert_array_equal(
        arranged.valid.reshape(-1), np.arange(3 * blocks.BLOCK) < len(kept)
    )


@pytest.mark.slow
def test_a_learner_learns_as_by_autodiff() -> None:
    begun = PPO_.init(jax.random.key(0))
    batch = _to_batch(_batch(0.5))
    plain = replace(PPO_, backend="autodiff")
    found, told = jax.jit(PPO_.update)(begun, batch, jax.random.key(1))
    expected, metrics = jax.jit(plain.update)(begun, batch, jax.random.key(1))
    chex.assert_trees_all_equal_structs((found, told), (expected, metrics))
    # The gradients differ by rounding, and so do Adam's steps.
    chex.assert_trees_all_close((found, told), (expected, metrics), rtol=1e-4, atol=1e-5)
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), found.params, begun.params)
    assert max(jax.tree.leaves(moved)) > 1e-3


@pytest.mark.slow
def test_lanes_take_their_turns_and_come_to_what_each_does_alone() -> None:
    shares = (1.0, 0.3, 0.0)
    batches = [_to_batch(_batch(share, seed)) for seed, share in enumerate(shares)]
    keys = jax.random.split(jax.random.key(1), 3)
    every = jax.vmap(PPO_.init)(keys)

    def update(learner: LearnerState, batch: Batch, key: jax.Array) -> LearnerState:
        return PPO_.update(learner, batch, key)[0]

    stacked = jax.tree.map(lambda *x: jnp.stack(x), *batches)
    together = jax.jit(jax.vmap(update))(every, stacked, keys).params
    for lane, batch in enumerate(batches):
        mine = jax.tree.map(lambda x, i=lane: x[i], every)
        alone = jax.jit(update)(mine, batch, keys[lane]).params
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            # float32 rounding: the normalisation and Adam's steps are vectorised over learners.
            np.testing.assert_allclose(a[lane], b, atol=1e-6)
    before = jax.tree.leaves(jax.tree.map(lambda x: x[2], every.params))
    after = jax.tree.leaves(jax.tree.map(lambda x: x[2], together))
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def _to_batch(samples: Batch) -> Batch:
    names = ("observation", "action", "log_prob", "advantage", "return_", "valid")
    return Batch(**{name: jnp.asarray(getattr(samples, name)) for name in names})
