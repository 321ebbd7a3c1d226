"""Chooses how an update is computed: plain autodiff, or a faster way of `ppo/fast/`."""

import importlib
import re
from collections.abc import Callable
from typing import Any, Literal

import jax

from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.gradients import Learning, Metrics, Progress
from swarmjax.ppo.networks import Networks, Sizes

# XLA runs Triton's kernels on NVIDIA GPUs of this compute capability or later (8 is Ampere).
_LEAST_GENERATION = 8
# Values of `jax.default_matmul_precision` with which matrix products avoid tensor cores.
_FULL = ("highest", "float32", "F32_F32_F32")

# autodiff: plain autodiff in `ppo.py`. blocks: autodiff of a whole batch, block by block. fused:
# GPU kernels. sequences: autodiff of a policy with memory, which leaves out absent robots.
Backend = Literal["autodiff", "blocks", "fused", "sequences"]
Learn = Callable[[Learning, Progress, Batch, jax.Array], tuple[Progress, Metrics]]


def resolve(config: AlgoConfig, networks: Networks, sizes: Sizes) -> Backend:
    """Chooses how updates are computed on the device that JAX computes on.

    `auto` means `fused` if the GPU supports the kernels and the kernels support the layers. If the
    whole batch is one minibatch, a CPU processes it in `blocks`, and an accelerator processes it at
    once. With `auto`, a policy with memory is trained in `sequences` on any device.

    Args:
      config: Settings of the learner.
      networks: Actor and critic.
      sizes: Sizes of observations, actions and states.

    Returns:
      The backend.
    """
    auto = config.update_backend == "auto"
    if config.memory != "none":  # the other faster ways ignore the order of steps
        return "sequences" if auto else "autodiff"
    if auto and _fuses(config, networks, sizes):
        return "fused"
    whole = config.num_minibatches == 1 and jax.default_backend() == "cpu"
    return "blocks" if whole else "autodiff"


def memory_kernels(config: AlgoConfig) -> Any:
    """Chooses the GPU kernels that compute a policy's memory.

    Args:
      config: Settings of the learner.

    Returns:
      The module of the kernels. None if the policy has no memory, if `update_backend` is
      `autodiff`, or if the kernels do not support the memory or the device.
    """
    asked = config.memory != "none" and config.update_backend == "auto"
    if not asked or not _runs_kernels():
        return None
    from swarmjax.ppo.fast import kernel, recurrence

    return recurrence if recurrence.fits(config.memory_size, kernel.shared_memory()) else None


def find(backend: Backend) -> Learn:
    """Returns the function of `ppo/fast/` that learns with a given backend, except `autodiff`."""
    return importlib.import_module(f"swarmjax.ppo.fast.{backend}").learn


def _fuses(config: AlgoConfig, networks: Networks, sizes: Sizes) -> bool:
    """Tells whether the kernels of `fused.py` can compute the update."""
    plain = config.critic == "observation" and networks.actor.torso is None
    if not plain or not _runs_kernels():
        return False
    from swarmjax.ppo.fast import fused

    return fused.fits(config, sizes.observation, sizes.action)


def _runs_kernels() -> bool:
    """Tells whether kernels are faster than XLA's code on the device that JAX computes on.

    The kernels need an NVIDIA GPU whose tensor cores Triton supports, and a precision of matrix
    products that allows tensor cores.
    """
    capability = str(getattr(jax.devices()[0], "compute_capability", ""))
    generation = re.fullmatch(r"(\d+)\.\d+", capability)
    supported = generation is not None and int(generation[1]) >= _LEAST_GENERATION
    return supported and jax.config.jax_default_matmul_precision not in _FULL
