"""The gradient of the PPO loss of a minibatch on an NVIDIA GPU, by a kernel for each network.

It is that of `losses.ppo_loss`, written out. With s over the valid samples, n = max(expected_valid,
1), ratio r_s = exp(log pi(a_s) - log pi_old(a_s)) and V the critic, that loss is

    1/n sum_s [-min(r_s A_s, clip(r_s) A_s) + value_cost (V_s - R_s)^2 / 2 - entropy_cost H
               + bound_cost |b_s|^2],

b_s being how far the mean action lies beyond -1..1.

Its kernels sum over samples; what is the same for all of them, 1/n among it, comes after.
"""

import functools
import math
import re
from typing import Literal

import chex
import jax
import jax.numpy as jnp

from swarmjax.config import AlgoConfig, ConfigError, show
from swarmjax.ppo import fused_kernel, networks
from swarmjax.ppo.fused_kernel import Launch, Layer, Samples
from swarmjax.ppo.losses import Metrics, Minibatch
from swarmjax.ppo.networks import Params

# 64 samples are the fewest rows that four warps multiply at once on an H100. With two layers of 64,
# 128 threads then take all of their 255 registers, and 80 kB on the chip: each of its 132
# multiprocessors has room for two programs, and as many are there from begin to end.
LAUNCH = Launch(tile=64, programs=264, warps=4)
# Faster by 30 % on an H100 (design.md), where a program may take so much of the chip.
LARGE = Launch(tile=128, programs=264, warps=8)
# By compute capability, bytes, where a program may have more than the least: CUDA C++ Programming
# Guide, "Technical Specifications per Compute Capability".
_MEMORY = {"8.0": 163 * 1024, "9.0": 227 * 1024, "10.0": 227 * 1024}

# XLA takes Triton's kernels from this generation on (Ampere, compute capability 8).
_LEAST_GENERATION = 8

# Names that JAX has for products without tensor cores (`jax.default_matmul_precision`).
_FULL = ("highest", "float32", "F32_F32_F32")

_Run = functools.partial[fused_kernel.Sums]


def resolve(
    config: AlgoConfig, observation_size: int, action_size: int
) -> Literal["autodiff", "fused"]:
    """Turns `auto` into `fused` on an NVIDIA GPU where the layers fit it, `autodiff` elsewhere.

    So it does where JAX's matrix products are to be in full precision: without tensor cores the
    kernels are slower than what XLA makes.

    Args:
        config: Of the learner.
        observation_size: O.
        action_size: U.

    Returns:
        How the gradient is computed.

    Raises:
        ConfigError: `fused` is asked for where there is no such GPU, or of layers that do not fit.
    """
    possible = _has_tensor_cores()
    fitting = fits(config, observation_size, action_size)
    if config.gradient == "fused" and not possible:
        raise ConfigError(
            "algo.gradient is fused, but there is no NVIDIA GPU of compute capability "
            f"{_LEAST_GENERATION} or more: give auto or autodiff."
        )
    if config.gradient == "fused" and not fitting:
        raise ConfigError(
            f"algo.gradient is fused, but algo.hidden is {show(config.hidden)}, which does not fit "
            "the chip: give two layers of 16, 32 or 64, or algo.gradient=auto."
        )
    if config.gradient == "auto" and jax.config.jax_default_matmul_precision in _FULL:
        return "autodiff"
    return "fused" if config.gradient != "autodiff" and possible and fitting else "autodiff"


def fits(config: AlgoConfig, observation_size: int, action_size: int) -> bool:
    """Says whether the kernels take the networks.

    Args:
        config: Of the networks.
        observation_size: O.
        action_size: U.

    Returns:
        Whether `gradient` may be called.
    """
    return fused_kernel.fits(observation_size, config.hidden, action_size, LAUNCH.tile)


def choose_launch(config: AlgoConfig, observation_size: int, action_size: int) -> Launch:
    """Chooses how the kernels are spread over the GPU that JAX computes on.

    Args:
        config: Of networks that `fits` accepts.
        observation_size: O.
        action_size: U.

    Returns:
        `LARGE` where the chip has room for it.
    """
    memory = _MEMORY.get(_capability(), fused_kernel.SHARED_MEMORY)
    sizes = (observation_size, config.hidden, action_size)
    return LARGE if fused_kernel.fits(*sizes, LARGE.tile, memory) else LAUNCH


def _capability() -> str:
    """The compute capability of the GPU that JAX computes on, such as 9.0; no text of others."""
    return str(getattr(jax.devices()[0], "compute_capability", ""))


def _has_tensor_cores() -> bool:
    """Whether JAX computes on an NVIDIA GPU whose tensor cores Triton knows."""
    generation = re.fullmatch(r"(\d+)\.\d+", _capability())
    return generation is not None and int(generation[1]) >= _LEAST_GENERATION


def gradient(
    params: Params,
    minibatch: Minibatch,
    config: AlgoConfig,
    expected_valid: jax.Array,
    *,
    launch: Launch | None = None,
    interpret: bool = False,
) -> tuple[Params, Metrics]:
    """Computes what `jax.grad(losses.ppo_loss, has_aux=True)` does, but for rounding.

    Products have JAX's precision, `jax.default_matmul_precision`.

    Args:
        params: Of actor and critic, of layers that `fits` accepts.
        minibatch: B samples.
        config: Clip range and costs.
        expected_valid: [], as `losses.ppo_loss` takes it.
        launch: How the kernels are spread over the GPU; None: by `choose_launch`.
        interpret: Run them as ordinary JAX, on any device.

    Returns:
        The gradient, as `params`, and the metrics, each [].

    Raises:
        ValueError: `fits` says no.
    """
    _check(params, minibatch, config)
    sizes = minibatch.observation.shape[1], minibatch.action.shape[1]
    launch = choose_launch(config, *sizes) if launch is None else launch
    share = 1.0 / jnp.maximum(expected_valid, 1.0)
    run = functools.partial(
        fused_kernel.sums, activation=config.activation, launch=launch, interpret=interpret
    )
    actor, surrogate = _actor_sums(run, params["actor"], minibatch, config)
    critic, error = _critic_sums(run, params["critic"], minibatch)
    weight = jnp.sum(minibatch.valid.astype(bool)) * share  # in a mean, of what all have in common
    # The entropy is the sum of log_std and a constant, so its slope is 1.
    log_std = surrogate.pop("log_std") * share - config.entropy_cost * weight
    if config.exploration == "scheduled":
        log_std = jnp.zeros_like(log_std)
    metrics = {name: total * share for name, total in (surrogate | error).items()}
    metrics["entropy"] = networks.entropy(jnp.exp(params["actor"]["log_std"])) * weight
    return {
        "actor": _scaled(actor, share) | {"log_std": log_std},
        "critic": _scaled(critic, config.value_cost * share),
    }, metrics


def _check(params: Params, minibatch: Minibatch, config: AlgoConfig) -> None:
    chex.assert_rank([minibatch.observation, minibatch.action], 2)
    chex.assert_rank([minibatch.log_prob, minibatch.valid], 1)
    chex.assert_equal_shape(
        [minibatch.log_prob, minibatch.advantage, minibatch.return_, minibatch.valid]
    )
    chex.assert_equal_shape_prefix([minibatch.observation, minibatch.action, minibatch.valid], 1)
    observation_size, action_size = minibatch.observation.shape[1], minibatch.action.shape[1]
    chex.assert_axis_dimension(params["actor"]["torso"]["hidden_0"]["kernel"], 0, observation_size)
    chex.assert_shape(params["actor"]["log_std"], (action_size,))
    if not fits(config, observation_size, action_size):
        raise ValueError(f"the kernels do not take hidden layers of {config.hidden}")


def _actor_sums(
    run: _Run, actor: Params, minibatch: Minibatch, config: AlgoConfig
) -> tuple[Params, Metrics]:
    """Sums over samples of the surrogate's gradient, of metrics, and of the slope by `log_std`."""
    size = minibatch.action.shape[1]
    loss = functools.partial(_surrogate, config, size)
    names = ("observation", "action", "log_prob", "advantage")
    log_std = fused_kernel.pad(actor["log_std"], (fused_kernel.padded_width(size),))
    layers, sums = run(
        _layers(actor, "mean"),
        loss=loss,
        samples=_samples(minibatch, names),
        constants={"log_std": log_std},
    )
    return _tree(layers, actor, "mean"), sums | {"log_std": sums["log_std"][:size]}


def _critic_sums(run: _Run, critic: Params, minibatch: Minibatch) -> tuple[Params, Metrics]:
    """Sums over samples of the gradient of half the squared error, and of that itself."""
    samples = _samples(minibatch, ("observation", "return_"))
    layers, sums = run(_layers(critic, "value"), loss=_half_square, samples=samples, constants={})
    return _tree(layers, critic, "value"), sums


def _surrogate(
    config: AlgoConfig, size: int, output: jax.Array, samples: Samples, constants: Samples
) -> tuple[jax.Array, Metrics]:
    """The clipped surrogate, negated, with the action padded by zeros.

    Schulman et al. 2017, "Proximal Policy Optimization Algorithms", equation 7: where the minimum
    is r A its slope by log pi is r A, since dr / dlog pi = r; where it is the clipped term, 0. The
    two are equal within the range. With z = (a - mu) / sigma, log pi is the sum over the action of
    -z^2 / 2 - log sigma - log(2 pi) / 2: its slopes are z / sigma by mu and z^2 - 1 by log sigma.
    """
    mean = jnp.tanh(output) if config.output == "tanh" else output
    log_std = constants["log_std"][None, :]
    standardised = (samples["action"] - mean) * jnp.exp(-log_std)
    log_density = jnp.sum(-0.5 * standardised * standardised - log_std, axis=1)
    log_density -= 0.5 * size * math.log(2.0 * math.pi)
    valid, advantage = samples["valid"] > 0.0, samples["advantage"]
    # Masked before exp: an overflow there would turn the zero gradient of a mask into NaN.
    log_ratio = jnp.where(valid, log_density - samples["log_prob"], 0.0)
    ratio = jnp.exp(log_ratio)
    gain = ratio * advantage
    clipped = jnp.minimum(jnp.maximum(ratio, 1.0 - config.clip), 1.0 + config.clip) * advantage
    by_density = jnp.where(valid & (gain <= clipped), -gain, 0.0)[:, None]
    beyond = jnp.where(valid[:, None], networks.beyond_range(mean), 0.0)
    slope = by_density * standardised * jnp.exp(-log_std) + 2.0 * config.bound_cost * beyond
    if config.output == "tanh":
        slope *= 1.0 - mean * mean
    return slope, {
        "log_std": by_density * (standardised * standardised - 1.0),
        "policy_loss": jnp.where(valid, -jnp.minimum(gain, clipped), 0.0),
        "bound_loss": jnp.sum(beyond * beyond, axis=1),
        "approx_kl": ratio - 1.0 - log_ratio,  # 0 where not valid
        "clip_fraction": jnp.where(jnp.abs(ratio - 1.0) > config.clip, 1.0, 0.0),  # likewise
    }


def _half_square(
    output: jax.Array, samples: Samples, constants: Samples
) -> tuple[jax.Array, Metrics]:
    """Half the squared error of the first column of the output, whose others are padding."""
    del constants
    value = jnp.sum(output, axis=1)
    error = jnp.where(samples["valid"] > 0.0, value - samples["return_"], 0.0)
    first = jnp.arange(output.shape[1]) == 0
    return jnp.where(first[None, :], error[:, None], 0.0), {"value_loss": 0.5 * error * error}


def _samples(minibatch: Minibatch, names: tuple[str, ...]) -> Samples:
    chosen = {name: getattr(minibatch, name).astype(jnp.float32) for name in names}
    return chosen | {"valid": minibatch.valid.astype(bool).astype(jnp.float32)}


def _layers(network: Params, last: str) -> tuple[Layer, ...]:
    """The layers of a network in order, padded."""
    torso = network["torso"]
    trees = [torso[f"hidden_{index}"] for index in range(len(torso))] + [network[last]]
    return tuple(_padded(tree["kernel"], tree["bias"]) for tree in trees)


def _padded(kernel: jax.Array, bias: jax.Array) -> Layer:
    inputs, outputs = (fused_kernel.padded_width(width) for width in kernel.shape)
    return Layer(fused_kernel.pad(kernel, (inputs, outputs)), fused_kernel.pad(bias, (outputs,)))


def _tree(layers: tuple[Layer, ...], network: Params, last: str) -> Params:
    """Layers as the network has them, without what was padded."""
    torso = {f"hidden_{index}": layer for index, layer in enumerate(layers[:-1])}
    cut = {name: _cut(layer, network["torso"][name]) for name, layer in torso.items()}
    return {"torso": cut, last: _cut(layers[-1], network[last])}


def _cut(layer: Layer, like: Params) -> Params:
    inputs, outputs = like["kernel"].shape
    return {"kernel": layer.kernel[:inputs, :outputs], "bias": layer.bias[:outputs]}


def _scaled(tree: Params, factor: jax.Array) -> Params:
    return jax.tree.map(lambda x: x * factor, tree)
