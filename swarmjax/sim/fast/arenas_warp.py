"""Makes Warp kernels that compute many arenas at once work under `vmap`."""

import threading
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_batching import custom_vmap

# Warp loads a module when JAX first traces one of its kernels. Only one thread at a time may do so.
_LOADING = threading.Lock()
# All traced calls in this process, in order: for each call, the function and the shapes of its
# inputs.
CALLS: list[tuple[Any, tuple]] = []


def over_arenas(solve: Any, *inputs: Any) -> Array:
    """Calls a function of many arenas for one arena; under `vmap`, it gets all arenas at once.

    Args:
      solve: takes the inputs with a leading arena axis, and returns an array with that axis.
      *inputs: arrays of one arena, or pytrees of such arrays.

    Returns:
      The result for the arena.
    """
    many = custom_vmap(partial(_call, solve))

    @many.def_vmap
    def _(size: int, batched: Any, *given: Any) -> tuple[Array, bool]:
        def widen(x: Array, has: bool) -> Array:
            return x if has else jnp.broadcast_to(x, (size, *x.shape))

        whole = jax.tree.map(widen, given, tuple(batched))
        shape = jax.tree.leaves(whole)[0].shape[:2]  # [size, arenas]
        arenas = shape[0] * shape[1]  # `reshape` cannot infer this number if there are no obstacles
        result = many(*jax.tree.map(lambda x: x.reshape(arenas, *x.shape[2:]), whole))
        return result.reshape(*shape, *result.shape[1:]), True

    return many(*jax.tree.map(lambda x: jnp.asarray(x)[None], inputs))[0]


def _call(solve: Any, *given: Any) -> Array:
    with _LOADING:
        CALLS.append((solve, jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), given)))
        return solve(*given)


def repeat(calls: list[tuple[Any, tuple]]) -> None:
    """Registers with Warp the calls of a program that was compiled in an earlier process.

    A compiled program is not traced again. It refers to each Warp call by a number. Warp numbers
    calls in the order in which they are registered, so `CALLS` must be as it was when the program
    was traced.

    Args:
      calls: the entries that tracing the program added to `CALLS`.
    """
    for solve, shapes in calls:
        jax.eval_shape(partial(_call, solve), *shapes)
