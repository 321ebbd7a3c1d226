"""A run over several devices: each device runs the program on a share of the arenas or seeds.

If devices share the arenas, only the arenas are spread: every device learns and decides the same,
as `Shards` says. If devices share the seeds (`seeds_by=devices`), they exchange nothing. With one
device there is no mesh, and the program is the one that `seeds` makes.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from swarmjax.config import ConfigError
from swarmjax.shards import AXIS
from swarmjax.sim.physics import PhysicsState
from swarmjax.training import loop, seeds
from swarmjax.training.config import ProgramConfig
from swarmjax.training.loop import TrainState
from swarmjax.training.program import side_by_side
from swarmjax.training.rollout import Program

_ALL: Any = PartitionSpec()
_SEEDS: Any = PartitionSpec("seeds")
_ARENAS: Any = PartitionSpec(None, AXIS)  # the first axis is the seeds'


class _Layout(NamedTuple):
    """How a run is spread over devices.

    Attributes:
      mesh: the devices.
      lanes: sharding of arrays with a seed axis.
      state: sharding of each part of a state.
    """

    mesh: Mesh
    lanes: Any
    state: Any

    @property
    def shardings(self) -> Any:
        """Sharding of each part of a state, on the mesh."""
        return jax.tree.map(
            partial(NamedSharding, self.mesh),
            self.state,
            is_leaf=lambda x: isinstance(x, PartitionSpec),
        )


def _layout(config: ProgramConfig) -> _Layout:
    if config.seeds_by == "devices":
        every = TrainState(_SEEDS, _SEEDS, _SEEDS, _SEEDS, _SEEDS)
        return _Layout(make(config.devices, "seeds"), _SEEDS, every)
    state: Any = TrainState(_ALL, _ARENAS, _ALL, _ALL, _ALL)
    return _Layout(make(config.devices, AXIS), _ALL, state)


def make(devices: int, axis: str = AXIS) -> Mesh:
    """Makes the mesh of the first devices that JAX knows, including devices of other hosts.

    Raises:
      ConfigError: JAX knows fewer devices.
    """
    found = jax.device_count()
    if devices > found:
        kind = jax.devices()[0].platform
        raise ConfigError(
            f"devices is {devices}, but JAX sees {found} ({kind}): give at most {found}."
        )
    kinds = (AxisType.Auto,)
    return jax.make_mesh((devices,), (axis,), axis_types=kinds, devices=jax.devices()[:devices])


def init(program: Program) -> Callable[..., TrainState]:
    """Returns a function that starts every seed of a run; `jit` it.

    Args:
      program: the compiled program.

    Returns:
      A function from the curriculum's schedule and the seeds [N] to the states [N] before the first
      update, spread over devices. Called without seeds, it takes the seeds of the config.
    """
    start = partial(seeds.each, partial(loop.init, program))
    given = lanes(program.config)
    if program.config.devices > 1:
        layout = _layout(program.config)
        start = _spread(start, layout, (_ALL, layout.lanes), layout.state)
    return lambda schedule, lanes=given: start(schedule, lanes)


def lanes(config: ProgramConfig) -> np.ndarray:
    """Returns the seeds [N] of a run, as `init` takes them."""
    return np.array(config.numbers, np.uint32)


def jit_chunk(program: Program) -> Any:
    """Jits the function that trains every seed for some updates, `seeds.chunk`.

    Args:
      program: the compiled program.

    Returns:
      The jitted function; it donates the state, whose arenas are spread over devices.
    """
    local = seeds.chunk(program)
    if program.config.devices == 1:
        return jax.jit(local, donate_argnums=1)
    layout = _layout(program.config)
    chunk = _spread(
        lambda schedule, state, n: local(schedule, _without_empty(state), n),
        layout,
        (_ALL, layout.state, _ALL),
        (layout.state, layout.lanes),
    )
    everywhere = NamedSharding(layout.mesh, _ALL)
    return jax.jit(
        chunk,
        in_shardings=(everywhere, layout.shardings, everywhere),
        out_shardings=(layout.shardings, NamedSharding(layout.mesh, layout.lanes)),
        donate_argnums=1,
    )


def _spread(function: Any, layout: _Layout, given: Any, returned: Any) -> Any:
    """Runs a function on each device, with its share of the arguments."""
    return jax.shard_map(
        function, mesh=layout.mesh, in_specs=given, out_specs=returned, check_vma=False
    )


def put(program: Program, state: TrainState) -> TrainState:
    """Spreads a state over the devices of the program; every process gives the whole state.

    Args:
      program: the compiled program.
      state: [N] states with all arenas.

    Returns:
      The same state.
    """
    if program.config.devices == 1:
        return state
    shardings = _layout(program.config).shardings
    return jax.tree.map(
        lambda sharding, part: jax.tree.map(partial(_placed, sharding), part), shardings, state
    )


def stepped_together(program: Program, state: TrainState) -> PhysicsState:
    """Extracts from a state the arenas that this process's first device steps together.

    Args:
      program: the compiled program.
      state: [N] states.

    Returns:
      [N A] arenas if seeds run side by side, [A] if they run one after the other.
    """
    if program.config.devices > 1:
        state = jax.tree.map(lambda x: x.addressable_data(0), state)
    lanes = side_by_side(program.config)
    return jax.tree.map(lambda x: x[:lanes].reshape(-1, *x.shape[2:]), state.arenas.sim)


def _placed(sharding: NamedSharding, x: jax.Array) -> jax.Array:
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_placed(sharding, jax.random.key_data(x)))
    whole = np.asarray(x)
    return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])


def _without_empty(state: TrainState) -> TrainState:
    """Replaces empty arrays by new ones, because `shard_map` of jaxlib 0.11.2 fails on them."""
    return jax.tree.map(lambda x: x if x.size else jnp.zeros(x.shape, x.dtype), state)
