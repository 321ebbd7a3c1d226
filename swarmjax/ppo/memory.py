"""The memory of a policy: a gated recurrent unit (GRU) between the hidden layers and the heads.

Cho et al. 2014, "Learning Phrase Representations using RNN Encoder-Decoder", section 2.3. The reset
gate is applied after the recurrent product, as in cuDNN, PyTorch, Flax and ONNX
(`linear_before_reset=1`). The heads see both the hidden layers' features and the memory, so they
can ignore the memory.

B stands for any number of leading axes, T for control steps, F for the number of features, H for
the width of the memory.
"""

import functools
import math
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn

# `algo.initialization=orthogonal` means Flax's own choice for its GRU: LeCun's for input weights,
# orthogonal for recurrent weights, no bias.
_INPUT = nn.initializers.lecun_normal()

# How many steps of a sequence one iteration of the loop computes: on a GPU each iteration launches
# its own kernels. Compared with 1 step, an update takes at most half a second longer to compile
# with 4 steps, and a second longer with 8 steps.
_UNROLL = 4


class Recall(NamedTuple):
    """The memories of actor and critic before an observation, [B, H] each; () without memory."""

    actor: Any
    critic: Any


NO_MEMORY = Recall((), ())


class Gru(nn.Module):
    """A GRU whose three gates lie side by side: reset, update, candidate.

    Attributes:
      size: H.
      uniform: Whether weights and biases begin within +-1 / sqrt(H), as in PyTorch's GRU
        (`torch.nn.RNNBase.reset_parameters`).
      kernels: Module with `remember` and `remember_all`, which replace the functions of this file
        on a GPU. None means that XLA computes them.
    """

    size: int
    uniform: bool = False
    kernels: Any = None

    @nn.compact
    def __call__(
        self, features: jax.Array, memory: jax.Array, begins: jax.Array | None = None
    ) -> tuple[jax.Array, jax.Array]:
        """Updates the memory with one observation, or with a sequence of them.

        Args:
          features: [B, F], or [T, B, F] for sequences.
          memory: [B, H], memory before the first observation.
          begins: [T, B], whether an episode begins with the step; the memory is then cleared before
            the step. None for a single observation.

        Returns:
          The memory [.., H] after each observation, for the heads, and the memory [B, H] after
          the last one.
        """
        if self.kernels is not None and not self.is_initializing():
            return self._by_kernels(features, memory, begins)
        seen = self._layer(_INPUT, "input")(features)
        recurrent = self._layer(_recurrent, "recurrent")
        if begins is None:
            memory = remember(seen, recurrent(memory), memory)
            return memory, memory
        chex.assert_equal_shape_prefix([features, begins], begins.ndim)
        recurrent(memory)  # creates the weights, also during initialisation
        weights = recurrent.variables["params"]
        every = remember_all(weights["kernel"], weights["bias"], seen, begins, memory)
        return every, every[-1]

    def _by_kernels(
        self, features: jax.Array, memory: jax.Array, begins: jax.Array | None
    ) -> tuple[jax.Array, jax.Array]:
        """Does what `__call__` does, but with the kernels."""
        layers = self.variables["params"]
        if begins is None:
            memory = self.kernels.remember(layers, features, memory)
            return memory, memory
        every = self.kernels.remember_all(layers, features, begins, memory)
        return every, every[-1]

    def _layer(self, kernel: Any, name: str) -> nn.Dense:
        """Makes one layer for all three gates, side by side."""
        if not self.uniform:
            return nn.Dense(3 * self.size, kernel_init=kernel, name=name)
        within = functools.partial(uniform, bound=1.0 / math.sqrt(self.size))
        return nn.Dense(3 * self.size, kernel_init=within, bias_init=within, name=name)


def uniform(
    key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32, *, bound: float
) -> jax.Array:
    """Samples numbers within +-`bound`, with the signature of Flax's initialisers."""
    return jax.random.uniform(key, shape, dtype, -bound, bound)


def remember(seen: jax.Array, recalled: jax.Array, memory: jax.Array) -> jax.Array:
    """Computes the memory after an observation.

    Args:
      seen: [B, 3 H], input weights times features, with their bias.
      recalled: [B, 3 H], recurrent weights times memory, with their bias.
      memory: [B, H], memory before the observation.

    Returns:
      The memory [B, H] after the observation, within -1..1.
    """
    reset, update, candidate = jnp.split(seen, 3, axis=-1)
    reset_, update_, candidate_ = jnp.split(recalled, 3, axis=-1)
    fresh = jnp.tanh(candidate + nn.sigmoid(reset + reset_) * candidate_)
    kept = nn.sigmoid(update + update_)
    return fresh + kept * (memory - fresh)


@jax.custom_vjp
def remember_all(
    kernel: jax.Array, bias: jax.Array, seen: jax.Array, begins: jax.Array, memory: jax.Array
) -> jax.Array:
    """Computes the memory after each observation of sequences.

    The gradient is built from the gradient of `remember`. Only terms that depend on the next step
    are computed step by step. Autodiff would also sum the gradient of `kernel` step by step, from
    products that are too small to fill a GPU.

    Args:
      kernel: [H, 3 H], recurrent weights.
      bias: [3 H], recurrent bias.
      seen: [T, B, 3 H], as for `remember`.
      begins: [T, B], whether an episode begins with the step.
      memory: [B, H], memory before the first step.

    Returns:
      The memory [T, B, H] after each step.
    """

    def step(memory: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        seen, begins = now
        memory = jnp.where(begins[..., None], 0.0, memory)
        memory = remember(seen, memory @ kernel + bias, memory)
        return memory, memory

    return jax.lax.scan(step, memory, (seen, begins), unroll=_UNROLL)[1]


def _remember_forward(
    kernel: jax.Array, bias: jax.Array, seen: jax.Array, begins: jax.Array, memory: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    """Computes `remember_all`, and keeps what its gradient needs."""
    every = remember_all(kernel, bias, seen, begins, memory)
    return every, (kernel, bias, seen, begins, memory, every)


def _remember_backward(kept: tuple[jax.Array, ...], slope: jax.Array) -> tuple[Any, ...]:
    """Backpropagates from the memories [T, B, H] to all arguments."""
    kernel, bias, seen, begins, memory, every = kept
    before = jnp.concatenate([memory[None], every[:-1]])
    before = jnp.where(begins[..., None], 0.0, before)
    recalled = before @ kernel + bias

    def step(later: jax.Array, now: tuple[jax.Array, ...]) -> tuple[jax.Array, Any]:
        seen, recalled, before, begins, slope = now
        _, pull = jax.vjp(remember, seen, recalled, before)
        by_seen, by_recalled, by_memory = pull(later + slope)
        by_memory = by_memory + by_recalled @ kernel.T
        return jnp.where(begins[..., None], 0.0, by_memory), (by_seen, by_recalled)

    steps = (seen, recalled, before, begins, slope)
    nothing = jnp.zeros_like(memory)
    by_memory, (by_seen, by_recalled) = jax.lax.scan(
        step, nothing, steps, reverse=True, unroll=_UNROLL
    )
    flat = (x.reshape(len(x), -1, x.shape[-1]) for x in (before, by_recalled))
    by_kernel = jnp.einsum("tbh,tbg->thg", *flat).sum(axis=0)
    by_bias = by_recalled.sum(axis=tuple(range(by_recalled.ndim - 1)))
    return by_kernel, by_bias, by_seen, None, by_memory


remember_all.defvjp(_remember_forward, _remember_backward)


def _recurrent(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
    """Draws one orthogonal matrix [H, H] for each gate, side by side."""
    rows, columns = shape
    make = nn.initializers.orthogonal()
    gates = [make(each, (rows, columns // 3), dtype) for each in jax.random.split(key, 3)]
    return jnp.concatenate(gates, axis=-1)
