"""The gradient of the PPO loss of a minibatch on an NVIDIA GPU, with one kernel for each network.

It is the gradient of `gradients.ppo_loss`, written out. That loss is

    1/n sum_s [-min(r_s A_s, clip(r_s) A_s) + value_cost (V_s - R_s)^2 / 2 - entropy_cost H
               + BOUND_COST |b_s|^2].

The sum runs over the valid samples s, and n = max(expected_valid, 1). a_s is the action, pi the
policy, r_s = exp(log pi(a_s) - log pi_old(a_s)) the ratio, A_s the advantage, V_s the critic's
value, R_s the return, and H the entropy. b_s is how far the mean action lies beyond -1..1.

The kernels sum over samples. Factors and terms that all samples share, such as 1/n, are applied to
the sums. The kernels take tiles of samples in any order. So once the valid samples lie first, the
kernels can read the batch in place. A minibatch is then a choice of tiles, and tiles without a
valid sample are never read.
"""

import functools
import itertools
import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from swarmjax.ppo import gradients
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.fast import kernel
from swarmjax.ppo.fast.blocks import valid_first
from swarmjax.ppo.fast.kernel import KernelLayout, Launch, Loss, Place, Samples, Tiles
from swarmjax.ppo.gradients import Learning, Metrics, Progress
from swarmjax.ppo.networks import Params

# 64 samples are the fewest rows that four warps multiply at once on an H100. With two layers of 64,
# each of the 128 threads then uses all of its 255 registers, and a program uses 80 kB of the chip's
# memory. Each of the 132 multiprocessors holds two such programs, so all 264 run at the same time.
LAUNCH = Launch(tile=64, programs=264, warps=4)
# 30 % faster than `LAUNCH` on an H100 (1.53 instead of 2.19 ms), but a program needs more of the
# chip's memory.
LARGE = Launch(tile=128, programs=264, warps=8)
# Fewest tiles of a minibatch: with fewer, one tile more or less makes minibatches too unequal.
_LEAST_TILES = 8

# The metrics of a step with kernels: those of `gradients.ppo_loss` if the critic sees only the
# observation, the norm of the gradient before clipping, and two flags. One flag is 1 if the step
# was taken, the other is 1 if the step was skipped.
METRICS = (
    "approx_kl",
    "bound_loss",
    "clip_fraction",
    "entropy",
    "policy_loss",
    "value_loss",
    "grad_norm",
    "taken_steps",
    "skipped_steps",
)

# The parts of a sample that the kernel of each network reads.
_READ = {
    "actor": ("observation", "action", "log_prob", "advantage", "valid"),
    "critic": ("observation", "return_", "valid"),
}
Flat = dict[str, jax.Array]  # a vector for each network, in the order of its tree's leaves


def fits(config: AlgoConfig, observation_size: int, action_size: int) -> bool:
    """Tells whether the kernels support the networks.

    Args:
      config: Settings of the networks.
      observation_size: O.
      action_size: U.

    Returns:
      Whether `learn` may be called.
    """
    return kernel.fits(observation_size, config.hidden_sizes, action_size, LAUNCH.tile)


def choose_launch(
    config: AlgoConfig, observation_size: int, action_size: int, samples: int | None = None
) -> Launch:
    """Chooses how the kernels are spread over the GPU that JAX computes on.

    Args:
      config: Settings of networks that `fits` accepts.
      observation_size: O.
      action_size: U.
      samples: B, the samples of a batch that is split into minibatches; None if it is not split.

    Returns:
      `LARGE` if the chip has enough memory for it and each minibatch gets at least `_LEAST_TILES`
      tiles; otherwise `LAUNCH`.
    """
    if samples is not None and samples < _LEAST_TILES * config.num_minibatches * LARGE.tile:
        return LAUNCH
    sizes = (observation_size, config.hidden_sizes, action_size)
    return LARGE if kernel.fits(*sizes, LARGE.tile, kernel.shared_memory()) else LAUNCH


def flatten(params: Params) -> Flat:
    """Lays each network out in one vector.

    Args:
      params: Parameters of the actor and the critic.

    Returns:
      The vectors, [n] and [m], by the networks' names.
    """
    return {name: ravel_pytree(network)[0] for name, network in params.items()}


def unflatten(flat: Flat, like: Params) -> Params:
    """Undoes `flatten`.

    Args:
      flat: The vectors, [n] and [m], of parameters or of values with the same shapes.
      like: Parameters with these shapes.

    Returns:
      The content of `flat`, in the shape of `like`.
    """
    return {name: ravel_pytree(network)[1](flat[name]) for name, network in like.items()}


def layouts(params: Params) -> dict[str, KernelLayout]:
    """Describes how `flatten` lays the networks out.

    Args:
      params: Parameters of the actor and the critic, arrays or their shapes.

    Returns:
      The layouts, by the networks' names.
    """
    return {
        "actor": _layout(params["actor"], "mean"),
        "critic": _layout(params["critic"], "value"),
    }


def shuffle(
    keys: jax.Array, samples: int, valid: jax.Array, minibatches: int, launch: Launch
) -> Tiles:
    """Distributes the tiles that hold valid samples over minibatches, as evenly as possible.

    If there are fewer such tiles than minibatches, some minibatches get none.

    Args:
      keys: [E] random keys, one for each pass over the samples, consumed.
      samples: B, the number of samples. The valid ones come first.
      valid: [], int32, the number of valid samples.
      minibatches: M, the number of minibatches in a pass.
      launch: Its `tile` is the number of samples of a tile.

    Returns:
      The tiles: the orders of all passes, one after the other, and the span [E M, 2] of each
      minibatch.
    """
    count = -(-samples // launch.tile)
    used = -(-valid // launch.tile)
    index = jnp.arange(count, dtype=jnp.int32)

    def order(key: jax.Array) -> jax.Array:
        # Tiles without a valid sample get the greatest number, so that they sort to the end.
        bits = jnp.minimum(jax.random.bits(key, (count,), jnp.uint32), jnp.uint32(2**32 - 2))
        return jax.lax.sort_key_val(jnp.where(index < used, bits, jnp.uint32(2**32 - 1)), index)[1]

    share, rest = used // minibatches, used % minibatches
    parts = jnp.arange(minibatches + 1, dtype=jnp.int32)
    bounds = parts * share + jnp.minimum(parts, rest)
    passes = count * jnp.arange(len(keys), dtype=jnp.int32)[:, None, None]
    spans = passes + jnp.stack([bounds[:-1], bounds[1:]], axis=-1)
    return Tiles(jax.vmap(order)(keys).ravel(), spans.reshape(-1, 2))


def flat_gradient(
    flat: Flat,
    layout: dict[str, KernelLayout],
    samples: Batch,
    tiles: Tiles,
    config: AlgoConfig,
    expected_valid: jax.Array,
    *,
    launch: Launch,
) -> tuple[Flat, Metrics, jax.Array]:
    """Computes the gradient over some tiles of a batch, with each network as one vector.

    Matrix products use JAX's precision, `jax.default_matmul_precision`.

    Args:
      flat: Result of `flatten`.
      layout: Result of `layouts`, for layers that `fits` accepts.
      samples: B samples. `valid` is float32, 0 or 1, so that no step has to convert it.
      tiles: The minibatch, in tiles of `launch.tile` samples.
      config: Clip range and costs.
      expected_valid: [], as `gradients.ppo_loss` takes it.
      launch: How the kernels are spread over the GPU.

    Returns:
      The gradient, in the shape of `flat`; `METRICS`, each []; and the number of valid samples in
      the tiles, [].
    """
    share = 1.0 / jnp.maximum(expected_valid, 1.0)

    def run(name: str, loss: Loss) -> tuple[jax.Array, Metrics]:
        read = {key: getattr(samples, key).astype(jnp.float32) for key in _READ[name]}
        return kernel.sums(flat[name], layout[name], config.activation, loss, read, tiles, launch)

    surrogate_loss = functools.partial(_surrogate, config, samples.action.shape[1])
    actor, surrogate = run("actor", surrogate_loss)
    critic, error = run("critic", _half_square)
    count = error.pop("valid")
    weight = count * share  # weight of a term that is equal for all samples
    first, width = layout["actor"].vectors["log_std"]
    deviation = jnp.exp(flat["actor"][first : first + width])
    metrics = {name: total * share for name, total in (surrogate | error).items()}
    metrics["entropy"] = gradients.entropy(deviation) * weight
    found = {
        "actor": _with_entropy(actor * share, config, weight, first, width),
        "critic": critic * (config.value_cost * share),
    }
    return found, metrics, count


def _with_entropy(
    gradient: jax.Array, config: AlgoConfig, weight: jax.Array, first: int, width: int
) -> jax.Array:
    """Adds the entropy cost's derivative with respect to `log_std`, which begins at index `first`.

    The entropy is the sum of log_std and a constant, so the derivative is 1. If exploration
    is scheduled, the gradient with respect to `log_std` is set to 0.
    """
    index = jnp.arange(gradient.shape[0])
    moved = 0.0 if config.exploration == "scheduled" else gradient - config.entropy_cost * weight
    return jnp.where((index >= first) & (index < first + width), moved, gradient)


def _layout(network: Params, last: str) -> KernelLayout:
    leaves, structure = jax.tree.flatten(network)
    ends = list(itertools.accumulate(leaf.size for leaf in leaves))
    firsts = jax.tree.unflatten(structure, [0, *ends[:-1]])
    torso = [f"hidden_{index}" for index in range(len(network["torso"]))]
    at = [firsts["torso"][name] for name in torso] + [firsts[last]]
    layers = [network["torso"][name] for name in torso] + [network[last]]
    places = (
        Place(place["kernel"], place["bias"], layer["kernel"].shape)
        for place, layer in zip(at, layers, strict=True)
    )
    vectors = {name: (firsts[name], network[name].size) for name in network if name == "log_std"}
    return KernelLayout(tuple(places), vectors, ends[-1])


def _surrogate(
    config: AlgoConfig, size: int, output: jax.Array, samples: Samples, vectors: Samples
) -> tuple[jax.Array, Metrics]:
    """Computes the clipped surrogate, negated. Zeros pad the arrays of actions to a wider width.

    Schulman et al. 2017, "Proximal Policy Optimization Algorithms", equation 7. If the minimum is
    r A, its derivative with respect to log pi is r A, since dr / dlog pi = r. If the minimum is the
    other, clipped term, the derivative is 0. Within the range the two terms are equal. With
    z = (a - mu) / sigma, log pi is the sum over the action of
    -z^2 / 2 - log sigma - log(2 pi) / 2. Its derivatives with respect to mu and log sigma are
    z / sigma and z^2 - 1.
    """
    mean = jnp.tanh(output) if config.mean_activation == "tanh" else output
    log_std = vectors["log_std"][None, :]
    standardised = (samples["action"] - mean) * jnp.exp(-log_std)
    log_density = jnp.sum(-0.5 * standardised * standardised - log_std, axis=1)
    log_density -= 0.5 * size * math.log(2.0 * math.pi)
    valid, advantage = samples["valid"] > 0.0, samples["advantage"]
    # Masked before exp: an overflow there would turn the masked zero gradient into NaN.
    log_ratio = jnp.where(valid, log_density - samples["log_prob"], 0.0)
    ratio = jnp.exp(log_ratio)
    gain = ratio * advantage
    clipped = (
        jnp.minimum(jnp.maximum(ratio, 1.0 - config.clip_epsilon), 1.0 + config.clip_epsilon)
        * advantage
    )
    by_density = jnp.where(valid & (gain <= clipped), -gain, 0.0)[:, None]
    beyond = jnp.where(valid[:, None], gradients.beyond_range(mean), 0.0)
    slope = by_density * standardised * jnp.exp(-log_std) + 2.0 * gradients.BOUND_COST * beyond
    if config.mean_activation == "tanh":
        slope *= 1.0 - mean * mean
    return slope, {
        "log_std": by_density * (standardised * standardised - 1.0),
        "policy_loss": jnp.where(valid, -jnp.minimum(gain, clipped), 0.0),
        "bound_loss": jnp.sum(beyond * beyond, axis=1),
        "approx_kl": ratio - 1.0 - log_ratio,  # 0 where not valid
        "clip_fraction": jnp.where(
            jnp.abs(ratio - 1.0) > config.clip_epsilon, 1.0, 0.0
        ),  # 0 where not valid
    }


def _half_square(
    output: jax.Array, samples: Samples, vectors: Samples
) -> tuple[jax.Array, Metrics]:
    """Computes half the squared error of the output's first column; other columns are padding."""
    del vectors
    value = jnp.sum(output, axis=1)
    error = jnp.where(samples["valid"] > 0.0, value - samples["return_"], 0.0)
    first = jnp.arange(output.shape[1]) == 0
    return jnp.where(first[None, :], error[:, None], 0.0), {
        "value_loss": 0.5 * error * error,
        "valid": samples["valid"],
    }


def learn(
    learning: Learning, begun: Progress, samples: Batch, key: jax.Array
) -> tuple[Progress, Metrics]:
    """Learns from a batch, in minibatches that consist of tiles of valid samples.

    Each device deals out its own tiles. The samples of a minibatch therefore depend on the number
    of devices as well as on the random streams.

    Here each network is one vector, and the optimiser's state for each network is also one vector.
    With a tree of two dozen small arrays instead, most kernels of a minibatch would handle only one
    array.

    Args:
      learning: Settings and networks that `fits` accepts, and the optimiser.
      begun: Parameters and the optimiser's state.
      samples: [G, N, ...], zero where not valid.
      key: Random key, consumed.

    Returns:
      Parameters and the optimiser's state after the update, and the metrics of each step,
      [steps].
    """
    params, state = begun
    config, shards = learning.config, learning.shards
    flat_state = _flat_state(learning, *begun)
    layout, arranged = layouts(params), valid_first(samples)
    valid = jnp.sum(arranged.valid, dtype=jnp.int32)
    arranged = replace(arranged, valid=arranged.valid.astype(jnp.float32))
    count, size = arranged.observation.shape
    launch = choose_launch(config, size, arranged.action.shape[-1], count)
    keys = jax.random.split(shards.own_key(key), config.epochs)
    dealt = shuffle(keys, count, valid, config.num_minibatches, launch)
    expected_valid = shards.sum(valid) / config.num_minibatches

    def step(progress: Progress, span: jax.Array) -> tuple[Progress, jax.Array]:
        tiles = dealt._replace(span=span)
        gradient, metrics, taken = flat_gradient(
            progress[0], layout, arranged, tiles, config, expected_valid, launch=launch
        )
        progress, metrics = gradients.take(learning, progress, (gradient, metrics), taken > 0)
        return progress, jnp.stack([metrics[name] for name in METRICS])

    (flat, flat_state), rows = jax.lax.scan(step, (flatten(params), flat_state), dealt.span)
    learned = unflatten(flat, params), _tree_state(flat_state, state)
    return learned, dict(zip(METRICS, rows.T, strict=True))


def _flat_state(learning: Learning, params: Params, state: optax.OptState) -> optax.OptState:
    """Converts the optimiser's state: one vector for each network instead of a tree."""
    like = jax.eval_shape(learning.optimizer.init, flatten(params))
    return jax.tree.map(lambda x, tree: ravel_pytree(tree)[0] if x.ndim else tree, like, state)


def _tree_state(flat: optax.OptState, like: optax.OptState) -> optax.OptState:
    """Undoes `_flat_state`."""
    return jax.tree.map(lambda x, tree: ravel_pytree(tree)[1](x) if x.ndim else x, flat, like)
