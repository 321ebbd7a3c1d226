"""Updates with the kernels of `fused`, which read the batch in place: minibatches of tiles.

Valid samples are moved to the front once. Then tiles of them are shuffled, instead of groups, and a
minibatch is a span of the shuffled tiles. There may be fewer tiles of valid samples than
minibatches.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from swarmjax.ppo import optimizer
from swarmjax.ppo.fast import fused
from swarmjax.ppo.fast.valid_first import valid_first
from swarmjax.ppo.losses import Metrics, Minibatch
from swarmjax.ppo.networks import Params
from swarmjax.ppo.optimizer import METRICS, Learning, Progress


def learn(
    learning: Learning, begun: Progress, samples: Minibatch, key: jax.Array
) -> tuple[Progress, Metrics]:
    """Learns from a batch, in minibatches of tiles of valid samples.

    Each device deals out its own tiles. The samples of a minibatch therefore depend on the number
    of devices as well as on the random streams.

    Here each network is one vector, and the optimiser's state for each network is also one vector.
    With two dozen small arrays instead, most kernels of a minibatch would handle only one array
    each.

    Args:
      learning: Settings and networks that `fused.fits` accepts, and the optimiser.
      begun: Parameters and the optimiser's state.
      samples: [G, N, ...], zero where not valid.
      key: Random key, consumed.

    Returns:
      Parameters and the optimiser's state after, and the metrics of each step, [steps].
    """
    params, state = begun
    config, shards = learning.config, learning.shards
    flat_state = _flat_state(learning, *begun)
    layouts, arranged = fused.layouts(params), valid_first(samples)
    valid = jnp.sum(arranged.valid, dtype=jnp.int32)
    arranged = replace(arranged, valid=arranged.valid.astype(jnp.float32))
    count, size = arranged.observation.shape
    launch = fused.choose_launch(config, size, arranged.action.shape[-1], count)
    keys = jax.random.split(shards.own_key(key), config.epochs)
    dealt = fused.shuffle(keys, count, valid, config.num_minibatches, launch)
    expected_valid = shards.sum(valid) / config.num_minibatches

    def step(progress: Progress, span: jax.Array) -> tuple[Progress, jax.Array]:
        tiles = dealt._replace(span=span)
        gradient, metrics, taken = fused.flat_gradient(
            progress[0],
            layouts,
            arranged,
            tiles,
            config,
            expected_valid,
            launch=launch,
        )
        progress, metrics = optimizer.take(learning, progress, (gradient, metrics), taken > 0)
        return progress, jnp.stack([metrics[name] for name in METRICS])

    (flat, flat_state), rows = jax.lax.scan(step, (fused.flatten(params), flat_state), dealt.span)
    learned = fused.unflatten(flat, params), _tree_state(flat_state, state)
    return learned, dict(zip(METRICS, rows.T, strict=True))


def _flat_state(learning: Learning, params: Params, state: optax.OptState) -> optax.OptState:
    """Converts the optimiser's state: one vector for each network instead of a tree."""
    like = jax.eval_shape(learning.optimizer.init, fused.flatten(params))
    return jax.tree.map(lambda x, tree: ravel_pytree(tree)[0] if x.ndim else tree, like, state)


def _tree_state(flat: optax.OptState, like: optax.OptState) -> optax.OptState:
    """Undoes `_flat_state`."""
    return jax.tree.map(lambda x, tree: ravel_pytree(tree)[1](x) if x.ndim else x, flat, like)
