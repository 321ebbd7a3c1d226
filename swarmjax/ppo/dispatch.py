"""Chooses how an update is computed: plain autodiff, or a faster way of `ppo/fast/`."""

import importlib
import re
from collections.abc import Callable
from typing import Any, Literal

import jax

from swarmjax.config import ConfigError, show
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.gradients import Learning, Metrics, Minibatch, Progress
from swarmjax.ppo.networks import Networks, Sizes

# XLA runs Triton's kernels from this generation on (Ampere, compute capability 8).
_LEAST_GENERATION = 8
# JAX's names for products without tensor cores (`jax.default_matmul_precision`).
_FULL = ("highest", "float32", "F32_F32_F32")

# autodiff: `ppo` alone. blocks: autodiff of a whole batch, block by block. fused: kernels.
# sequences: autodiff of a policy with memory, without the sequences of absent robots.
Backend = Literal["autodiff", "blocks", "fused", "sequences"]
Learn = Callable[[Learning, Progress, Minibatch, jax.Array], tuple[Progress, Metrics]]


def resolve(config: AlgoConfig, networks: Networks, sizes: Sizes) -> Backend:
    """Chooses how updates are computed on the device that JAX computes on.

    `auto` means `fused` on an NVIDIA GPU that supports the layers, but not if JAX computes matrix
    products in full precision. Without tensor cores the kernels are slower than XLA's code. A CPU
    processes a whole batch in `blocks`; an accelerator processes it at once. A policy with memory
    is trained in `sequences` on any device.

    Args:
      config: Settings of the learner.
      networks: Actor and critic.
      sizes: What they see and do.

    Returns:
      The backend.

    Raises:
      ConfigError: The config asks for `fused`, but there is no such GPU or the layers do not fit.
    """
    if config.memory != "none":  # the other faster ways handle single samples
        return "sequences" if config.update_backend == "auto" else "autodiff"
    if _fuses(config, networks, sizes):
        return "fused"
    whole = config.num_minibatches == 1 and jax.default_backend() == "cpu"
    return "blocks" if whole else "autodiff"


def memory_kernels(config: AlgoConfig) -> Any:
    """Returns the kernels that compute a memory; None without memory or a GPU that supports them.

    Args:
      config: Settings of the learner.
    """
    asked = config.memory != "none" and config.update_backend == "auto"
    if not asked or not _has_tensor_cores() or _is_full_precision():
        return None
    from swarmjax.ppo.fast import kernel, recurrence

    return recurrence if recurrence.fits(config.memory_size, kernel.shared_memory()) else None


def find(backend: Backend) -> Learn:
    """Returns the function of `ppo/fast/` that learns with a backend other than autodiff."""
    return importlib.import_module(f"swarmjax.ppo.fast.{backend}").learn


def _fuses(config: AlgoConfig, networks: Networks, sizes: Sizes) -> bool:
    """Tells whether to use the kernels; refuses `fused` where they are not available."""
    if config.update_backend == "autodiff" or config.critic == "state":
        return False
    possible = _has_tensor_cores()
    fitting = possible and networks.actor.torso is None and _fits(config, sizes)
    if config.update_backend == "fused" and not possible:
        raise ConfigError(
            "algo.update_backend is fused, but there is no NVIDIA GPU of compute capability "
            f"{_LEAST_GENERATION} or more: give auto or autodiff."
        )
    if config.update_backend == "fused" and not fitting:
        raise ConfigError(
            "algo.update_backend is fused, but the kernels do not support algo.hidden_sizes "
            f"{show(config.hidden_sizes)} with {sizes.observation} observed numbers: give two "
            "layers of 16, 32 or 64 and at most 128 numbers, or algo.update_backend=auto."
        )
    if config.update_backend == "auto" and _is_full_precision():
        return False
    return fitting


def _fits(config: AlgoConfig, sizes: Sizes) -> bool:
    """Tells whether the kernels support hidden layers of this size."""
    from swarmjax.ppo.fast import fused

    return fused.fits(config, sizes.observation, sizes.action)


def _is_full_precision() -> bool:
    """Tells whether JAX avoids tensor cores in matrix products; the kernels are slower then."""
    return jax.config.jax_default_matmul_precision in _FULL


def _has_tensor_cores() -> bool:
    """Tells whether JAX computes on an NVIDIA GPU whose tensor cores Triton supports."""
    capability = str(getattr(jax.devices()[0], "compute_capability", ""))
    generation = re.fullmatch(r"(\d+)\.\d+", capability)
    return generation is not None and int(generation[1]) >= _LEAST_GENERATION
