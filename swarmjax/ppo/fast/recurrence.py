"""GPU kernels that run a GRU through sequences, and backpropagate, on the chip.

XLA launches several kernels for each step of a sequence, and passes data between them through the
GPU's memory. Here a program of the grid holds a tile of sequences and their memory, and runs all
steps.

T is the number of control steps, B of sequences, F of features, H the memory's width, and `tile`
the number of sequences that a program holds.
"""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from swarmjax.ppo.fast import kernel as hardware
from swarmjax.ppo.fast.kernel import logistic

# Sequences of a tile. If a learner has at most `MOST_SMALL` sequences, the smaller tile gives more
# of the chip's processors a program, and is faster on an H100. With more sequences, the backward
# pass is faster with the larger tile. Several seeds side by side fill the chip with fewer sequences
# of each; that was not timed. In the backward pass, 8 warps took twice as long with tiles of 64
# sequences. With tiles of 32 sequences, 4 warps were slower than 8.
SMALL_TILE, TILE = 16, 32
MOST_SMALL = 8192
_WARPS, _BACKWARD_WARPS = 4, 8
# Steps that the backward pass has in flight: it loads the inputs of the next steps while it
# computes one. On an H100, the backward pass then takes 0.56 to 0.64 of its time without this. The
# forward pass has one step in flight, because more made it slower.
_STAGES = 3
# Type of the GRU's inputs and of their gradient, which are the largest arrays. With half as many
# bytes as float32, training took 8 % less time on an H100. The rollout rounds in the same way, so
# that ratios of probabilities begin at 1.
_SEEN = jnp.bfloat16
# Supported widths of a memory. An operand of a tensor core is at least 16 wide, and weight matrices
# wider than 64 do not fit on the chip.
_SIZES = (16, 32, 64)

_Three = tuple[jax.Array, ...]  # arrays of reset, update and candidate


class _Rows(NamedTuple):
    """The sequences of a program at a step.

    Attributes:
      at: [tile], rows of the sequences in [T B, ...].
      exist: [tile], false past the last sequence.
    """

    at: jax.Array
    exist: jax.Array


class _Weights(NamedTuple):
    """The weights of a GRU.

    Each field is one array for all gates, or three arrays: for reset, update and candidate.

    Attributes:
      kernel: [H, 3 H], or three of [H, H], weights of the memory.
      bias: [3 H], or three of [H], added to the memory's part.
      bias_seen: [3 H], or three of [H], added to the input's part.
    """

    kernel: Any
    bias: Any
    bias_seen: Any


class _Sequences(NamedTuple):
    """A GRU's inputs [T B, 3 H], where episodes begin [T B] (0 or 1), and memories [B, H]."""

    seen: Any
    begins: Any
    memory: Any


class _Gates(NamedTuple):
    """What a step computes; each field is [tile, H].

    Attributes:
      reset: 0..1.
      update: 0..1.
      candidate: -1..1.
      recalled: The memory's part of the candidate, before `reset` scales it.
    """

    reset: jax.Array
    update: jax.Array
    candidate: jax.Array
    recalled: jax.Array


def fits(size: int, shared_memory: int) -> bool:
    """Tells whether the kernels support a memory of this width on this chip.

    The chip's memory holds the recurrent weights twice: the second copy is transposed for the
    backward pass. The chip also holds four tiles of memories and derivatives.

    Args:
      size: H.
      shared_memory: Bytes of the chip's memory that a program may use.

    Returns:
      Whether `remember_all` may be called.
    """
    return size in _SIZES and _bytes(size) <= shared_memory


def _bytes(size: int) -> int:
    """Returns the bytes on the chip that a program with one step in flight needs."""
    return 4 * (2 * size * 3 * size + 4 * TILE * size)


def _tile(sequences: int) -> int:
    """Chooses how many sequences a tile has, for the sequences of a learner."""
    return SMALL_TILE if sequences <= MOST_SMALL else TILE


def _stages(size: int, shared_memory: int) -> int:
    """Chooses how many steps of the backward pass are in flight.

    Each further step holds a tile of its inputs on the chip: the inputs of three gates in
    bfloat16, and the memory before, the first memory and the derivative in float32.

    Args:
      size: H.
      shared_memory: Bytes of the chip's memory that a program may use.

    Returns:
      `_STAGES`, or 1 if the chip's memory has no room for the inputs of further steps.
    """
    inputs = TILE * size * (3 * 2 + 3 * 4)
    return _STAGES if _bytes(size) + (_STAGES - 1) * inputs <= shared_memory else 1


def remember_all(
    layers: Mapping[str, Mapping[str, jax.Array]],
    features: jax.Array,
    begins: jax.Array,
    memory: jax.Array,
) -> jax.Array:
    """Computes the memory of `memory.Gru` after each observation, up to rounding.

    Features, and what the gates compute from them, are rounded to bfloat16. Other products use
    JAX's precision, `jax.default_matmul_precision`.

    Args:
      layers: `input` and `recurrent` of the GRU, each with `kernel` [F or H, 3 H] and `bias`
        [3 H]; `fits` accepts H.
      features: [T, B, F].
      begins: [T, B], whether an episode begins with the step.
      memory: [B, H], memory before the first step.

    Returns:
      The memory [T, B, H] after each step.
    """
    features, kernel = (x.astype(_SEEN) for x in (features, layers["input"]["kernel"]))
    inner = layers["recurrent"]
    weights = _Weights(inner["kernel"], inner["bias"], layers["input"]["bias"])
    begun = begins.astype(jnp.float32).ravel()
    seen = (features @ kernel).reshape(-1, kernel.shape[1])
    return _through(weights, _Sequences(seen, begun, memory))


def remember(
    layers: Mapping[str, Mapping[str, jax.Array]],
    features: jax.Array,
    memory: jax.Array,
) -> jax.Array:
    """Computes the memory of `memory.Gru` after one observation, up to rounding.

    Args:
      layers: As `remember_all` takes them.
      features: [B, F].
      memory: [B, H], memory before the observation.

    Returns:
      The memory [B, H] after the observation.
    """
    flat = memory.reshape(-1, memory.shape[-1])
    seen = features.reshape(1, -1, features.shape[-1])
    after = remember_all(layers, seen, jnp.zeros(seen.shape[:2], bool), flat)
    return after.reshape(memory.shape)


@jax.custom_vjp
def _through(weights: _Weights, sequences: _Sequences) -> jax.Array:
    """Runs the GRU through sequences; returns the memory after each step, [T, B, H]."""
    count, size = sequences.memory.shape
    steps, tile = len(sequences.seen) // count, _tile(count)
    every = pl.pallas_call(
        functools.partial(_forward, steps, tile),
        grid=(pl.cdiv(count, tile),),
        out_shape=jax.ShapeDtypeStruct((steps * count, size), jnp.float32),
        compiler_params=triton.CompilerParams(num_warps=_WARPS, num_stages=1),
    )(weights, sequences)
    return every.reshape(steps, count, size)


def _through_forward(weights: _Weights, sequences: _Sequences) -> tuple[Any, Any]:
    """Computes `_through`, and keeps what its gradient needs."""
    every = _through(weights, sequences)
    return every, (weights, sequences, every)


def _through_backward(
    kept: tuple[_Weights, _Sequences, jax.Array], slope: jax.Array
) -> tuple[_Weights, _Sequences]:
    """Backpropagates from the memories [T, B, H] to weights, inputs and first memories."""
    weights, sequences, every = kept
    steps, count, size = every.shape
    tile = _tile(count)
    programs = pl.cdiv(count, tile)
    shapes = {
        "kernel": jax.ShapeDtypeStruct((programs * size, 3 * size), jnp.float32),
        "sums": jax.ShapeDtypeStruct((programs, 4 * size), jnp.float32),
        "seen": jax.ShapeDtypeStruct(sequences.seen.shape, sequences.seen.dtype),
        "memory": jax.ShapeDtypeStruct((count, size), jnp.float32),
    }
    found = pl.pallas_call(
        functools.partial(_backward, steps, tile),
        grid=(programs,),
        out_shape=shapes,
        compiler_params=triton.CompilerParams(
            num_warps=_BACKWARD_WARPS, num_stages=_stages(size, hardware.shared_memory())
        ),
    )(weights, sequences, every.reshape(-1, size), slope.reshape(-1, size))
    by_kernel = found["kernel"].reshape(programs, size, 3 * size).sum(axis=0)
    gates, recalled, candidate = jnp.split(found["sums"].sum(axis=0), (2 * size, 3 * size))
    by_bias, by_bias_seen = (jnp.concatenate([gates, x]) for x in (recalled, candidate))
    # `begins` has no gradient.
    by_begins = jnp.zeros_like(sequences.begins)
    return (
        _Weights(by_kernel, by_bias, by_bias_seen),
        _Sequences(found["seen"], by_begins, found["memory"]),
    )


_through.defvjp(_through_forward, _through_backward)


def _forward(steps: int, tile: int, weights: _Weights, sequences: _Sequences, every: Any) -> None:
    """Runs a program: a tile of sequences, first step to last; arguments are references."""
    unit, (count, size) = _read_unit(weights), sequences.memory.shape
    own = _own(count, tile)

    def step(t: jax.Array, before: jax.Array) -> jax.Array:
        rows = _rows(own, t * count)
        before = before * _goes_on(sequences.begins, rows)
        gates = _gates(sequences.seen, rows, before, unit)
        after = gates.candidate + gates.update * (before - gates.candidate)
        _write(every, rows, 0, after)
        return after

    jax.lax.fori_loop(0, steps, step, _load(sequences.memory, own, 0, size))


def _backward(
    steps: int,
    tile: int,
    weights: _Weights,
    sequences: _Sequences,
    every: Any,
    slope: Any,
    found: dict[str, Any],
) -> None:
    """Runs a program: a tile of sequences, last step to first; arguments are references."""
    unit, (count, size) = _read_unit(weights), sequences.memory.shape
    own = _own(count, tile)

    def step(i: jax.Array, sofar: Any) -> Any:
        later, products, totals = sofar
        t = steps - 1 - i
        rows = _rows(own, t * count)
        goes_on = _goes_on(sequences.begins, rows)
        before = _before(every, sequences.memory, t, own) * goes_on
        gates = _gates(sequences.seen, rows, before, unit)
        slopes, by_recalled, by_before = _slopes(later + _load(slope, rows, 0, size), gates, before)
        for gate, value in enumerate(slopes):
            _write(found["seen"], rows, gate * size, value)
        for value, kernel in zip(by_recalled, unit.kernel, strict=True):
            by_before = by_before + jnp.dot(value, kernel.T)
        product = tuple(jnp.dot(before.T, value) for value in by_recalled)
        total = tuple(jnp.sum(value, axis=0) for value in (*by_recalled, slopes[2]))
        return by_before * goes_on, *jax.tree.map(jnp.add, (products, totals), (product, total))

    square, row = jnp.zeros((size, size), jnp.float32), jnp.zeros(size, jnp.float32)
    begun = jnp.zeros((tile, size), jnp.float32), (square,) * 3, (row,) * 4
    later, products, totals = jax.lax.fori_loop(0, steps, step, begun)
    _write(found["memory"], own, 0, later)
    _write_sums(found, products, totals)


def _write_sums(
    found: dict[str, Any], products: tuple[jax.Array, ...], totals: tuple[jax.Array, ...]
) -> None:
    """Writes the sums of a program: gradients of the weights, gate by gate, and of the biases."""
    program, size = pl.program_id(0), len(totals[0])
    columns = jnp.arange(size)
    for gate, product in enumerate(products):
        at = (program * size + columns)[:, None], (gate * size + columns)[None, :]
        triton.store(found["kernel"].at[at], product)
    for gate, total in enumerate(totals):
        triton.store(found["sums"].at[program, gate * size + columns], total)


def _gates(seen: Any, rows: _Rows, before: jax.Array, unit: _Weights) -> _Gates:
    """Computes the gates and the candidate as `memory.remember` does."""
    size = before.shape[1]

    def of(gate: int) -> tuple[jax.Array, jax.Array]:
        found = _load(seen, rows, gate * size, size) + unit.bias_seen[gate][None, :]
        return found, jnp.dot(before, unit.kernel[gate]) + unit.bias[gate][None, :]

    reset, update = (logistic(jnp.add(*of(gate))) for gate in (0, 1))
    candidate, recalled = of(2)
    return _Gates(reset, update, jnp.tanh(candidate + reset * recalled), recalled)


def _slopes(slope: jax.Array, gates: _Gates, before: jax.Array) -> tuple[_Three, _Three, jax.Array]:
    """Backpropagates from the memory after a step through the gates.

    r and u are the gates. n = tanh(x + r c) is the candidate, with the input's part x and the
    memory's part c. h is the memory before the step, and h' = n + u (h - n) after it. The
    derivatives of h' with respect to n, u and h are 1 - u, h - n and u. The derivatives of tanh and
    of the logistic function are 1 - n^2 and r (1 - r).

    Returns:
      Derivatives with respect to the inputs, gate by gate; with respect to the memory's parts, gate
      by gate; and with respect to h where h' uses it directly.
    """
    reset, update, candidate, recalled = gates
    by_candidate = slope * (1.0 - update) * (1.0 - candidate * candidate)
    by_update = slope * (before - candidate) * update * (1.0 - update)
    by_reset = by_candidate * recalled * reset * (1.0 - reset)
    seen = (by_reset, by_update, by_candidate)
    return seen, (by_reset, by_update, by_candidate * reset), slope * update


def _own(count: int, tile: int) -> _Rows:
    """Returns this program's sequences at the first step. Call it outside of a loop."""
    at = pl.program_id(0) * tile + jnp.arange(tile)
    return _Rows(at, at < count)


def _rows(own: _Rows, first: jax.Array) -> _Rows:
    """Returns the same sequences at the step whose first row is `first`."""
    return own._replace(at=first + own.at)


def _goes_on(begins: Any, rows: _Rows) -> jax.Array:
    """Returns 0 where an episode begins with the step, and otherwise 1, [tile, 1]."""
    return 1.0 - triton.load(begins.at[rows.at], mask=rows.exist, other=0.0)[:, None]


def _before(every: Any, memory: Any, step: jax.Array, own: _Rows) -> jax.Array:
    """Reads the memory [tile, H] before a step."""
    count, size = memory.shape
    earlier = _rows(own, (step - 1) * count)
    begun = _load(memory, own._replace(exist=own.exist & (step == 0)), 0, size)
    return begun + _load(every, earlier._replace(exist=own.exist & (step > 0)), 0, size)


def _read_unit(weights: _Weights) -> _Weights:
    kernel, size = weights.kernel, weights.kernel.shape[0]
    columns = [gate * size + jnp.arange(size) for gate in range(3)]
    rows = jnp.arange(size)[:, None]
    kernels = [triton.load(kernel.at[rows, each[None, :]]) for each in columns]
    biases, seen = ([triton.load(ref.at[each]) for each in columns] for ref in weights[1:])
    return _Weights((*kernels,), (*biases,), (*seen,))


def _load(ref: Any, rows: _Rows, first: int, size: int) -> jax.Array:
    """Reads [tile, H] from column `first` on; zeros for sequences that do not exist."""
    columns = first + jnp.arange(size)
    mask = rows.exist[:, None] & (columns >= 0)[None, :]
    found = triton.load(ref.at[rows.at[:, None], columns[None, :]], mask=mask, other=0.0)
    return found.astype(jnp.float32)


def _write(ref: Any, rows: _Rows, first: int, x: jax.Array) -> None:
    """Writes [tile, H] from column `first` on, except for sequences that do not exist."""
    columns = first + jnp.arange(x.shape[1])
    mask = rows.exist[:, None] & (columns >= 0)[None, :]
    triton.store(ref.at[rows.at[:, None], columns[None, :]], x.astype(ref.dtype), mask=mask)
