"""A run over several devices: one program on each, with a share of the arenas.

What is learned and decided is the same on every device (`Shards`), so only the arenas are spread.
With one device there is no mesh, and the program is that of `seeds`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from swarmjax.config import ConfigError
from swarmjax.curriculum.engine import Schedule
from swarmjax.shards import AXIS
from swarmjax.training import seeds
from swarmjax.training.loop import Metrics, TrainState
from swarmjax.training.program import Program

_ALL: Any = PartitionSpec()
_ARENAS: Any = PartitionSpec(None, AXIS)  # the axis before is that of the seeds
_STATE: Any = TrainState(learners=_ALL, arenas=_ARENAS, curriculum=_ALL, key=_ALL, update=_ALL)

Chunk = Callable[[Schedule, TrainState, Any], tuple[TrainState, Metrics]]


def make(devices: int) -> Mesh:
    """Makes the mesh of the first devices that JAX knows, those of all hosts among them.

    Raises:
      ConfigError: if there are fewer.
    """
    found = jax.device_count()
    if devices > found:
        kind = jax.devices()[0].platform
        raise ConfigError(
            f"devices is {devices}, but JAX sees {found} ({kind}): give at most {found}."
        )
    return jax.make_mesh((devices,), (AXIS,), (AxisType.Auto,), devices=jax.devices()[:devices])


def init(program: Program) -> Callable[[Schedule], TrainState]:
    """Returns what starts every seed of a run, as `seeds.init` does; `jit` it.

    Args:
      program: the compiled side.

    Returns:
      From the curriculum's numbers to the states [N] before the first update, spread over devices.
    """
    local = partial(seeds.init, program)
    if program.config.devices == 1:
        return local
    return jax.shard_map(
        local, mesh=make(program.config.devices), in_specs=_ALL, out_specs=_STATE, check_vma=False
    )


def jit_chunk(program: Program) -> Any:
    """Jits what trains every seed for some updates, as `seeds.train_chunk` does.

    Args:
      program: the compiled side.

    Returns:
      The jitted function; it donates the state, whose arenas are spread over devices.
    """
    local = partial(seeds.train_chunk, program)
    if program.config.devices == 1:
        return jax.jit(local, donate_argnums=1)
    mesh = make(program.config.devices)
    spread = jax.shard_map(
        lambda schedule, state, n: local(schedule, _without_empty(state), n),
        mesh=mesh,
        in_specs=(_ALL, _STATE, _ALL),
        out_specs=(_STATE, _ALL),
        check_vma=False,
    )
    everywhere, state = NamedSharding(mesh, _ALL), _on(mesh)
    return jax.jit(
        spread,
        in_shardings=(everywhere, state, everywhere),
        out_shardings=(state, everywhere),
        donate_argnums=1,
    )


def put(program: Program, state: TrainState) -> TrainState:
    """Spreads a state that every process holds whole over the devices of the program.

    Args:
      program: the compiled side.
      state: [N], of all arenas.

    Returns:
      The same state.
    """
    if program.config.devices == 1:
        return state
    shardings = _on(make(program.config.devices))
    return jax.tree.map(
        lambda sharding, part: jax.tree.map(partial(_spread, sharding), part), shardings, state
    )


def stepped_together(program: Program, state: TrainState) -> Any:
    """Takes out of a state the arenas of one device that the program steps together.

    Args:
      program: the compiled side.
      state: [N].

    Returns:
      What `seeds.stepped_together` does, of the arenas of this process's first device.
    """
    if program.config.devices > 1:
        state = jax.tree.map(lambda x: x.addressable_data(0), state)
    return seeds.stepped_together(program, state)


def _on(mesh: Mesh) -> Any:
    return jax.tree.map(
        partial(NamedSharding, mesh), _STATE, is_leaf=lambda x: isinstance(x, PartitionSpec)
    )


def _spread(sharding: NamedSharding, x: jax.Array) -> jax.Array:
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_spread(sharding, jax.random.key_data(x)))
    whole = np.asarray(x)
    return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])


def _without_empty(state: TrainState) -> TrainState:
    """Replaces arrays without elements: passed through `shard_map` they break jaxlib 0.11.2."""
    return jax.tree.map(lambda x: x if x.size else jnp.zeros(x.shape, x.dtype), state)
