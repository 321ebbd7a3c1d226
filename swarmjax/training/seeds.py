"""Several seeds of a run in one program: `loop` with a leading axis N on state and metrics.

Each seed is a whole run with its own networks, arenas and curriculum, and seeds exchange nothing.
Seed k is `config.seed + k`. A run of a single seed has this axis too, so that there is one
format of state, checkpoint and metrics.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from swarmjax.curriculum.engine import Schedule
from swarmjax.training import loop
from swarmjax.training.loop import Metrics, TrainState
from swarmjax.training.rollout import Program


def chunk(program: Program) -> Callable[[Schedule, TrainState, Array], tuple[TrainState, Metrics]]:
    """Returns `loop.train_chunk` for all seeds, with a leading axis N on state and metrics."""
    return partial(each, partial(loop.train_chunk, program))


def each(function: Callable[..., Any], schedule: Any, lanes: Any, *rest: Any) -> Any:
    """Applies a function of one seed to all seeds of a call, side by side.

    The matrix products of several seeds are batched. Batched products round differently from those
    of a run of one seed, but in the same way for every seed. The products of a single seed are not
    batched. With `seeds_by=cores`, a call has one group of seeds; with `devices`, a call has the
    seeds of one device.

    Args:
      function: takes `schedule`, one seed's part of `lanes`, and `rest`; returns a tree.
      schedule: the function's first argument, the same for all seeds.
      lanes: the function's second argument, with a leading axis N.
      *rest: the function's other arguments, the same for all seeds.

    Returns:
      The function's results with a leading axis N.
    """
    if jax.tree.leaves(lanes)[0].shape[0] > 1:
        return jax.vmap(lambda lane: function(schedule, lane, *rest))(lanes)
    alone = function(schedule, jax.tree.map(lambda x: x[0], lanes), *rest)
    return jax.tree.map(lambda x: x[None], alone)


def split(lanes: Any, parts: int) -> list[Any]:
    """Cuts a tree with a leading axis N into `parts` trees with a leading axis N / parts."""

    def cut(x: Array, i: int) -> Array:
        size = x.shape[0] // parts
        return x[i * size : (i + 1) * size]

    return [jax.tree.map(partial(cut, i=i), lanes) for i in range(parts)]


def join(parts: list[Any]) -> Any:
    """Undoes `split`."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
