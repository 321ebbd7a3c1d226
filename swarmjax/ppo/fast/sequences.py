"""Updates of policies with memory, in minibatches of sequences that hold a valid sample.

A sequence is the rollout of one robot. A robot that is absent, or had arrived before the rollout
began, has no valid sample. The other sequences are shuffled one by one. A minibatch is processed in
tiles of a fixed number of sequences. Sequences without a valid sample come last, and tiles that
hold no other sequences are left out. The loss is a sum over samples, so the gradients of tiles add
up.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from swarmjax.ppo import gradients
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.fast import blocks
from swarmjax.ppo.gradients import Learning, Metrics, Progress
from swarmjax.ppo.memory import NO_MEMORY
from swarmjax.ppo.networks import Params
from swarmjax.shards import ALONE, Shards

# Sequences of a tile on a CPU. Tiles of 32 take no longer than whole minibatches if all robots are
# present, and are still well filled if few robots are present.
CPU_TILE = 32
# Fewest and most samples of a tile on an accelerator, summed over all learners trained side by
# side. An accelerator runs the control steps one after the other, so a large tile takes little
# longer than a small one. With default layers, the largest tile takes about 12 GB.
TILE_SAMPLES = 2**17, 2**21
# Fewest sequences that the memory kernels compute at once.
FEWEST_SEQUENCES = 16
# An accelerator splits a full minibatch into this many tiles, unless the bounds above demand
# another size. If most robots are absent, most of the tiles are left out.
_TILES = 4


def learn(
    learning: Learning, begun: Progress, samples: Batch, key: jax.Array
) -> tuple[Progress, Metrics]:
    """Learns from a batch, in minibatches of sequences that hold a valid sample.

    Args:
      learning: Settings, networks with memory, and the optimiser.
      begun: Parameters and the optimiser's state.
      samples: [G, N, ...], zero where not valid; the samples of a group are ordered by step.
      key: Random key, consumed.

    Returns:
      Parameters and the optimiser's state after the update, and the metrics of each step,
      [epochs, M] for M minibatches.
    """
    config, shards = learning.config, learning.shards
    rows = arrange(samples, config.rollout_length)
    expected_valid = shards.sum(jnp.sum(samples.valid)) / config.num_minibatches

    def epoch(progress: Progress, key: jax.Array) -> tuple[Progress, Metrics]:
        useful = jnp.any(rows.valid, axis=1)
        order, spans = deal(key, useful, config.num_minibatches, shards)

        def step(progress: Progress, span: jax.Array) -> tuple[Progress, Metrics]:
            found = gradient(progress[0], rows, order, span, learning, expected_valid)
            return gradients.take(learning, progress, found, span[1] > span[0])

        return jax.lax.scan(step, progress, spans)

    return jax.lax.scan(epoch, begun, jax.random.split(key, config.epochs))


def arrange(samples: Batch, steps: int) -> Batch:
    """Lays samples out by sequence.

    Args:
      samples: [G, T S, ...], and memory [G, S, H], for S robots per group.
      steps: T, control steps of a sequence.

    Returns:
      [Q, T, ...] and memory [Q, H], with Q = G S. The robots of the first group come first.
    """

    def by_sequence(x: jax.Array) -> jax.Array:
        split = x.reshape(x.shape[0], steps, -1, *x.shape[2:])
        return jnp.moveaxis(split, 1, 2).reshape(-1, steps, *x.shape[2:])

    memory = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), samples.memory)
    return replace(jax.tree.map(by_sequence, replace(samples, memory=NO_MEMORY)), memory=memory)


def deal(
    key: jax.Array, useful: jax.Array, minibatches: int, shards: Shards = ALONE
) -> tuple[jax.Array, jax.Array]:
    """Distributes the sequences with a valid sample over minibatches at random.

    The sequences of each stream of random numbers are distributed as evenly as possible, so that a
    minibatch holds the same sequences on any number of devices. If a stream has fewer sequences
    than there are minibatches, the last minibatches get no sequence of this stream.

    Args:
      key: Random key, the same on all devices, consumed.
      useful: [Q], bool, which sequences of this device hold a valid sample.
      minibatches: M, number of minibatches.
      shards: How the sequences are spread over devices.

    Returns:
      The order [Q] of all sequences of this device, int32, and the span [M, 2] of each minibatch
      in this order: its begin and its end. The sequences of the first minibatch come first, and
      those without a valid sample come last.
    """
    by_stream = useful.reshape(shards.local_streams, -1)
    size = by_stream.shape[1]
    drawn = shards.draw(key, lambda key: jax.random.uniform(key, (size,))).reshape(by_stream.shape)
    shuffled = jnp.argsort(jnp.where(by_stream, drawn, jnp.inf), axis=1).astype(jnp.int32)
    count = jnp.sum(by_stream, axis=1, keepdims=True, dtype=jnp.int32)
    share, rest = count // minibatches, count % minibatches  # `rest` minibatches get one more
    place, longer = jnp.arange(size, dtype=jnp.int32), rest * (share + 1)
    beyond = rest + (place - longer) // jnp.maximum(share, 1)
    dealt_to = jnp.where(place < longer, place // (share + 1), beyond)
    dealt_to = jnp.where(place < count, dealt_to, minibatches)
    first = size * jnp.arange(len(by_stream), dtype=jnp.int32)[:, None]
    order = (first + shuffled).ravel()[jnp.argsort(dealt_to.ravel(), stable=True)]
    end = jnp.cumsum(jnp.sum(share + (jnp.arange(minibatches) < rest), axis=0, dtype=jnp.int32))
    begin = jnp.concatenate([jnp.zeros_like(end[:1]), end[:-1]])
    return order, jnp.stack([begin, end], axis=1)


def gradient(
    params: Params,
    rows: Batch,
    order: jax.Array,
    span: jax.Array,
    learning: Learning,
    expected_valid: jax.Array,
) -> tuple[Params, Metrics]:
    """Computes the gradient of `gradients.ppo_loss` over the sequences of one minibatch.

    Args:
      params: Parameters of the actor and the critic.
      rows: Result of `arrange`.
      order: [Q], result of `deal`.
      span: [2], int32, where in `order` the minibatch begins and ends.
      learning: Networks, clip range and costs.
      expected_valid: [], valid samples of the whole batch / number of minibatches.

    Returns:
      The gradient, and the metrics of the loss; 0 if the span is empty.
    """
    config = learning.config
    steps, learners = config.rollout_length, learning.side_by_side
    size = tile_size(len(order), config.num_minibatches, steps, learners)

    def of_tile(i: jax.Array | int) -> tuple[Params, Metrics]:
        tile = take_tile(rows, order, span[0] + i * size, span[1], size)
        return jax.grad(gradients.ppo_loss, has_aux=True)(
            params, tile, learning.networks, config, expected_valid
        )

    return blocks.add_up((span[1] - span[0] + size - 1) // size, of_tile)


def tile_size(sequences: int, minibatches: int, steps: int, learners: int) -> int:
    """Chooses how many sequences a tile has, so that few tiles fill the fullest minibatch.

    Args:
      sequences: Q, sequences of the batch.
      minibatches: M, number of minibatches.
      steps: T, control steps of a sequence.
      learners: How many learners a device trains at once, each with a batch of this size.

    Returns:
      At least 1. On an accelerator, a tile has at most as many samples as `TILE_SAMPLES` allows,
      or `FEWEST_SEQUENCES` sequences if these have more samples.
    """
    fullest = -(-sequences // minibatches)
    if jax.default_backend() == "cpu":
        most = CPU_TILE
    else:
        bounds = (samples // (steps * learners) for samples in TILE_SAMPLES)
        least, limit = (max(FEWEST_SEQUENCES, bound) for bound in bounds)
        most = min(max(least, -(-fullest // _TILES)), limit)
    return -(-fullest // -(-fullest // most))


def take_tile(rows: Batch, order: jax.Array, start: jax.Array, end: jax.Array, size: int) -> Batch:
    """Gathers the samples of a tile, ordered by step.

    Args:
      rows: Result of `arrange`.
      order: [Q], result of `deal`.
      start: [], int32, index in `order` of the tile's first sequence.
      end: [], int32, index in `order` at which the minibatch ends. Samples of sequences from this
        index on are not valid.
      size: Number of sequences in the tile.

    Returns:
      [T size, ...], ordered by step, and memory [size, H].
    """
    place = start + jnp.arange(size, dtype=jnp.int32)
    which = order[jnp.minimum(place, len(order) - 1)]
    tile = jax.tree.map(lambda x: x[which], rows)
    tile = replace(tile, valid=tile.valid.astype(bool) & (place < end)[:, None])

    def by_step(x: jax.Array) -> jax.Array:
        return jnp.moveaxis(x, 1, 0).reshape(-1, *x.shape[2:])

    return replace(jax.tree.map(by_step, replace(tile, memory=NO_MEMORY)), memory=tile.memory)
