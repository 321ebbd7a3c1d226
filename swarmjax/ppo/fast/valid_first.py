"""Moves valid samples to the front, so that the update can skip the others."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmjax.ppo.losses import Minibatch


def valid_first(samples: Minibatch) -> Minibatch:
    """Lays all samples out along one axis, the valid ones first and in their given order.

    Args:
      samples: [G, N, ...].

    Returns:
      [G N, ...]. Behind the valid samples come copies of other samples, marked as not valid.
    """
    groups, each = samples.valid.shape
    within = jnp.cumsum(samples.valid, axis=1, dtype=jnp.int32)
    before = jnp.cumsum(within[:, -1]) - within[:, -1]
    index = jnp.arange(groups * each, dtype=jnp.int32)
    beyond = groups * each + index  # out of range, so dropped; all differ, as unique_indices needs
    place = jnp.where(samples.valid.ravel(), (before[:, None] + within - 1).ravel(), beyond)
    source = jnp.zeros_like(index).at[place].set(index, mode="drop", unique_indices=True)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[source], samples)
    return replace(flat, valid=index < jnp.sum(within[:, -1]))
