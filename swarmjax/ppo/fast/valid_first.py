"""Samples without gaps, so that what nothing is to be learned from costs nothing."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmjax.ppo.losses import Minibatch


def valid_first(samples: Minibatch) -> Minibatch:
    """Lays all samples out along one axis, the valid ones first, in the order that they have.

    Args:
        samples: [G, N, ...].

    Returns:
        [G N, ...]; past the valid samples are copies of others, which are not valid.
    """
    groups, each = samples.valid.shape
    within = jnp.cumsum(samples.valid, axis=1, dtype=jnp.int32)
    before = jnp.cumsum(within[:, -1]) - within[:, -1]
    index = jnp.arange(groups * each, dtype=jnp.int32)
    beyond = groups * each + index  # dropped, each at a place of its own
    place = jnp.where(samples.valid.ravel(), (before[:, None] + within - 1).ravel(), beyond)
    source = jnp.zeros_like(index).at[place].set(index, mode="drop", unique_indices=True)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[source], samples)
    return replace(flat, valid=index < jnp.sum(within[:, -1]))
