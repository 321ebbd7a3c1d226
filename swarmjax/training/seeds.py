"""Several seeds of a run in one program: `loop` with a leading axis N on state and metrics.

Each seed is a whole run with its own networks, arenas and curriculum, and seeds exchange nothing.
Seed k is `config.seed + k`. A single seed has the axis too, so that there is one format of state,
checkpoint and metrics.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from swarmjax.curriculum.engine import Schedule
from swarmjax.sim.physics import PhysicsState
from swarmjax.training import loop
from swarmjax.training.config import ProgramConfig
from swarmjax.training.loop import Metrics, TrainState
from swarmjax.training.program import Program, side_by_side


def numbers(config: ProgramConfig) -> range:
    """Returns the seeds of a run, in the order of the seed axis."""
    return config.numbers


def init(
    program: Program, schedule: Schedule, lanes: Array | np.ndarray | None = None
) -> TrainState:
    """Starts every seed of a run.

    Args:
      program: the compiled program.
      schedule: the curriculum's numbers.
      lanes: [N] seeds, uint32; None: the config's.

    Returns:
      [N] states before the first update.
    """
    lanes = np.array(numbers(program.config), np.uint32) if lanes is None else lanes
    return each(partial(loop.init, program, schedule), lanes)


def train_chunk(
    program: Program, schedule: Schedule, state: TrainState, n: Array
) -> tuple[TrainState, Metrics]:
    """Trains every seed for `n` updates; `jit` it with `program` bound and `state` donated.

    Args:
      program: the compiled program.
      schedule: the curriculum's numbers, the same for all seeds.
      state: [N] states before.
      n: [] number of updates, at most `program.rows`, int32.

    Returns:
      [N] states after, and metrics [N, rows, ...]: the first n rows hold one update each.
    """
    return each(lambda lane: loop.train_chunk(program, schedule, lane, n), state)


def each(function: Callable[[Any], Any], lanes: Any) -> Any:
    """Applies a function of one seed to all seeds of a call, side by side.

    The matrix products are then batched. This rounds differently from a run of one seed, but in the
    same way for every seed. One seed alone is not batched. With `seeds_by=cores`, a call has one
    group of seeds; with `devices`, it has the seeds of one device.

    Args:
      function: from a tree to a tree.
      lanes: the function's arguments with a leading axis N.

    Returns:
      The function's results with a leading axis N.
    """
    if jax.tree.leaves(lanes)[0].shape[0] == 1:
        alone = function(jax.tree.map(lambda x: x[0], lanes))
        return jax.tree.map(lambda x: x[None], alone)
    return jax.vmap(function)(lanes)


def split(lanes: Any, parts: int) -> list[Any]:
    """Cuts a tree with a leading axis N into `parts` trees with a leading axis N / parts."""

    def cut(x: Array, i: int) -> Array:
        size = x.shape[0] // parts
        return x[i * size : (i + 1) * size]

    return [jax.tree.map(partial(cut, i=i), lanes) for i in range(parts)]


def join(parts: list[Any]) -> Any:
    """Undoes `split`."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def size(tree: Any) -> int:
    """Returns the bytes of a tree's arrays, or of their shapes from `jax.eval_shape`."""
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def stepped_together(program: Program, state: TrainState) -> PhysicsState:
    """Takes out of a state the arenas that the program steps together, all on one axis.

    Args:
      program: the compiled program.
      state: [N] states.

    Returns:
      [N A] arenas if seeds run side by side, [A] if they run one after the other.
    """
    lanes = side_by_side(program.config)
    return jax.tree.map(lambda x: x[:lanes].reshape(-1, *x.shape[2:]), state.arenas.sim)
