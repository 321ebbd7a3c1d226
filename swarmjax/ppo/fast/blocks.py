"""Gradients over a whole batch on a CPU, block by block.

The loss is a sum over samples, so its gradient is the sum of the blocks' gradients. The activations
of a block stay in a core's cache, and blocks without a valid sample are left out. Learners and
seeds run one after the other. In a vectorised loop every learner would take as long as the learner
with the most samples.
"""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmjax.ppo import gradients
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.gradients import Learning, Metrics, Progress
from swarmjax.ppo.networks import Params

# Samples of a block. With hidden layers of width 64, blocks of 100 to 6,000 samples were timed:
# blocks of 250 to 400 samples took the least CPU time.
BLOCK = 256


def learn(
    learning: Learning, begun: Progress, samples: Batch, _: jax.Array
) -> tuple[Progress, Metrics]:
    """Learns from a batch: each epoch is one step on all samples, so their order does not matter.

    Args:
      learning: Settings with one minibatch, networks and optimiser.
      begun: Parameters and the optimiser's state.
      samples: [G, N, ...], zero where not valid.

    Returns:
      Parameters and the optimiser's state after all epochs, and the metrics of each, [epochs].
    """

    @jax.custom_batching.sequential_vmap
    def one_learner(begun: Progress, samples: Batch) -> tuple[Progress, Metrics]:
        blocks, used = arrange(samples)
        count = learning.shards.sum(jnp.sum(samples.valid))

        def epoch(progress: Progress, _: None) -> tuple[Progress, Metrics]:
            found = gradient(progress[0], blocks, used, learning, count)
            return gradients.take(learning, progress, found, count > 0)

        return jax.lax.scan(epoch, begun, length=learning.config.epochs)

    return one_learner(begun, samples)


def arrange(samples: Batch) -> tuple[Batch, jax.Array]:
    """Puts the valid samples first and cuts all samples into blocks.

    Args:
      samples: [G, N, ...], zero where not valid.

    Returns:
      The blocks [K, B, ...], B at most `BLOCK`; the padding of the last block is not valid. Also
      how many blocks hold a valid sample, [], int32; these blocks come first.
    """
    flat = valid_first(samples)
    size = min(BLOCK, len(flat.valid))
    missing = -len(flat.valid) % size

    def cut(x: jax.Array) -> jax.Array:
        padded = jnp.pad(x, [(0, missing)] + [(0, 0)] * (x.ndim - 1))
        return padded.reshape(-1, size, *x.shape[1:])

    valid = jnp.sum(flat.valid, dtype=jnp.int32)
    return jax.tree.map(cut, flat), (valid + size - 1) // size


def gradient(
    params: Params, blocks: Batch, used: jax.Array, learning: Learning, expected_valid: jax.Array
) -> tuple[Params, Metrics]:
    """Computes the gradient of `gradients.ppo_loss` over all samples.

    Args:
      params: Parameters of the actor and the critic.
      blocks: The samples, [K, B, ...].
      used: [], how many blocks to use, from the first one on.
      learning: Networks, clip range and costs.
      expected_valid: [], number of valid samples in the whole batch.

    Returns:
      The gradient, and the metrics of the loss; 0 if no sample is valid.
    """

    def of_block(i: jax.Array | int) -> tuple[Params, Metrics]:
        block = jax.tree.map(lambda x: x[i], blocks)
        return jax.grad(gradients.ppo_loss, has_aux=True)(
            params, block, learning.networks, learning.config, expected_valid
        )

    return add_up(used, of_block)


def add_up[T](count: jax.Array, part: Callable[[jax.Array | int], T]) -> T:
    """Adds up the results of several parts, such as gradients of a sum over samples.

    Args:
      count: [], int32, how many parts there are.
      part: Computes the part with a given index, from 0, as a tree of arrays.

    Returns:
      The sum; 0 if there are no parts.
    """

    def add(i: jax.Array, total: T) -> T:
        return jax.tree.map(jnp.add, total, part(i))

    shapes = jax.eval_shape(lambda: part(0))
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return jax.lax.fori_loop(0, count, add, nothing)


def valid_first(samples: Batch) -> Batch:
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
    beyond = groups * each + index  # out of range, so dropped; distinct for `unique_indices`
    place = jnp.where(samples.valid.ravel(), (before[:, None] + within - 1).ravel(), beyond)
    source = jnp.zeros_like(index).at[place].set(index, mode="drop", unique_indices=True)
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[source], samples)
    return replace(flat, valid=index < jnp.sum(within[:, -1]))
