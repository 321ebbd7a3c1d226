"""A kernel that takes samples through a network, a loss and back without leaving the chip.

XLA writes the activations of every layer to memory and reads them again; here a program of the grid
keeps those of a tile of samples, and writes no more than its sums at its end. Programs share
nothing, so that the same samples give the same bits.

B stands for samples, P for programs, `tile` for the samples that a program holds at once.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

# Least width of an operand of a matrix product on the tensor cores.
LEAST_WIDTH = 16
# A kernel's sums of 128 x 128 would take 128 registers of 128 threads, of 255 each.
MOST_WIDTH = 128
# Bytes of a program: 99 KiB are the least that compute capability 8 and later give (CUDA C++
# Programming Guide, "Technical Specifications per Compute Capability"); other products than those
# of 9.0, which `fits` counts, take up to 4 more.
SHARED_MEMORY = 95 * 1024


class Layer(NamedTuple):
    """An affine layer, or its gradient.

    Attributes:
        kernel: [in, out].
        bias: [out].
    """

    kernel: jax.Array
    bias: jax.Array


class Launch(NamedTuple):
    """How the kernel is spread over the GPU.

    Attributes:
        tile: samples of a tile, a power of two of at least `LEAST_WIDTH`.
        programs: programs of the grid, at most; fewer where there are fewer tiles.
        warps: warps of a program.
    """

    tile: int
    programs: int
    warps: int


# Samples of a tile by name, each [tile] or [tile, width], zero past the last sample.
Samples = dict[str, jax.Array]
# (output of the network [tile, width], samples, constants) -> (derivative of the loss with respect
# to the output [tile, width], what else is to be summed over all samples, each [tile, ...]).
Loss = Callable[[jax.Array, Samples, dict[str, jax.Array]], tuple[jax.Array, dict[str, jax.Array]]]
# The gradient with respect to a network, and the loss's sums by name.
Sums = tuple[tuple[Layer, ...], dict[str, jax.Array]]

_Activations = list[tuple[jax.Array, jax.Array]]


def padded_width(width: int) -> int:
    """Returns what a width is padded to: Triton knows powers of two only."""
    return max(LEAST_WIDTH, pl.next_power_of_2(width))


def fits(
    inputs: int,
    hidden: tuple[int, ...],
    outputs: int,
    tile: int,
    memory: int = SHARED_MEMORY,
) -> bool:
    """Says whether the kernel takes a network: widths, and the memory on the chip.

    What Triton puts there is the first kernel once and all others twice, the second time turned
    over for the way back, with a tile of observations and two of the widest hidden layer.

    Args:
        inputs: width of the observation, which is padded, as that of the output is.
        hidden: widths of the hidden layers: powers of two.
        outputs: width of the output.
        tile: samples of a tile.
        memory: on the chip, of a program, bytes.

    Returns:
        Whether `sums` may be called.
    """
    if any(not LEAST_WIDTH <= width <= MOST_WIDTH or width.bit_count() != 1 for width in hidden):
        return False
    widths = [padded_width(inputs), *hidden, padded_width(outputs)]
    kernels = [before * after for before, after in itertools.pairwise(widths)]
    numbers = kernels[0] + 2 * sum(kernels[1:]) + tile * (widths[0] + 2 * max(hidden))
    return max(widths) <= MOST_WIDTH and 4 * numbers <= memory


def pad(x: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Appends zeros to every axis until `x` has this shape."""
    return jnp.pad(x, [(0, new - old) for old, new in zip(x.shape, shape, strict=True)])


def sums(
    network: tuple[Layer, ...],
    activation: str,
    loss: Loss,
    samples: Samples,
    constants: dict[str, jax.Array],
    launch: Launch,
    interpret: bool = False,
) -> Sums:
    """Sums the gradient of a loss, and what else it tells, over samples.

    Args:
        network: hidden layers and output, of widths that `padded_width` leaves as they are.
        activation: of the hidden layers: `tanh`, `relu` or `swish`.
        loss: of the output; what must not count is 0 in all that it returns.
        samples: by name, each [B] or [B, width], float32; of them `observation` [B, O] goes into
            the network. They are read as they are and padded on the chip, with zeros.
        constants: what else the loss takes, by name, each [width].
        launch: how it is spread over the GPU.
        interpret: run it as ordinary JAX, on any device.

    Returns:
        The gradient with respect to `network`, and the loss's sums by name, each [...]: [tile, ...]
        without its first axis.
    """
    tile, tiles = launch.tile, -(-len(samples["observation"]) // launch.tile)
    programs = min(launch.programs, tiles)
    of_tile = functools.partial(_of_tile, activation, loss)
    shapes = jax.eval_shape(
        of_tile,
        network,
        jax.tree.map(lambda x: jax.ShapeDtypeStruct(_tile_shape(x, tile), x.dtype), samples),
        constants,
    )
    partial_sums = pl.pallas_call(
        functools.partial(_program, of_tile, shapes, tile, -(-tiles // programs)),
        grid=(programs,),
        out_shape=jax.tree.map(
            lambda x: jax.ShapeDtypeStruct((programs, *x.shape), jnp.float32), shapes
        ),
        out_specs=jax.tree.map(_rows_of_program, shapes),
        # Nothing to run ahead of: a tile's samples are few bytes beside its products.
        compiler_params=triton.CompilerParams(num_warps=launch.warps, num_stages=1),
        interpret=interpret,
    )(network, samples, constants)
    gradient, parts = jax.tree.map(lambda x: jnp.sum(x, axis=0), partial_sums)
    return gradient, {name: jnp.sum(part, axis=0) for name, part in parts.items()}


def _tile_shape(samples: jax.Array, tile: int) -> tuple[int, ...]:
    return (tile, *(padded_width(width) for width in samples.shape[1:]))


def _rows_of_program(total: jax.ShapeDtypeStruct) -> pl.BlockSpec:
    """The row of an output [P, ...] that a program writes."""
    rank = len(total.shape)
    return pl.BlockSpec((None, *total.shape), lambda program: (program, *[0] * rank))


def _program(
    of_tile: Callable[..., Any],
    shapes: Any,
    tile: int,
    rounds: int,
    network: Any,
    samples: dict[str, Any],
    constants: dict[str, Any],
    *totals: Any,
) -> None:
    """A program: every P-th tile, in as many rounds; all arguments after `rounds` are references.

    The last round may lie past the last sample, where zeros are read, which count for nothing.
    """
    first, programs = pl.program_id(0), pl.num_programs(0)
    layers, fixed = jax.tree.map(lambda ref: ref[...], (network, constants))

    def add(i: jax.Array, sofar: Any) -> Any:
        rows = (first + i * programs) * tile + jnp.arange(tile)
        read = {name: _read(ref, rows) for name, ref in samples.items()}
        return jax.tree.map(jnp.add, sofar, of_tile(layers, read, fixed))

    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, jnp.float32), shapes)
    found = jax.lax.fori_loop(0, rounds, add, nothing)
    jax.tree.map(_write, totals, found)


def _write(ref: Any, total: jax.Array) -> None:
    ref[...] = total


def _read(ref: Any, rows: jax.Array) -> jax.Array:
    """Rows of an array, widened to what products take; zeros where it has none."""
    known = rows < ref.shape[0]
    if len(ref.shape) == 1:
        return triton.load(ref.at[rows], mask=known, other=0.0)
    width = ref.shape[1]
    columns = jnp.arange(padded_width(width))
    mask = known[:, None] & (columns < width)[None, :]
    return triton.load(ref.at[rows[:, None], columns[None, :]], mask=mask, other=0.0)


def _of_tile(
    activation: str,
    loss: Loss,
    network: tuple[Layer, ...],
    samples: Samples,
    constants: dict[str, jax.Array],
) -> Sums:
    """Forward, loss and backward of a tile: sums of the gradient, and what else is to be summed."""
    activations, output = _forward(activation, network, samples["observation"])
    slope, parts = loss(output, samples, constants)
    return _backward(activation, network, activations, slope), parts


def _forward(
    activation: str, network: tuple[Layer, ...], features: jax.Array
) -> tuple[_Activations, jax.Array]:
    """What goes into each layer, with what the activation that made it took, and the output."""
    seen, before = [], features
    for layer in network[:-1]:
        seen.append((before, features))
        before = jnp.dot(features, layer.kernel) + layer.bias[None, :]
        features = _ACTIVATIONS[activation](before)
    seen.append((before, features))
    return seen, jnp.dot(features, network[-1].kernel) + network[-1].bias[None, :]


def _backward(
    activation: str, network: tuple[Layer, ...], seen: _Activations, slope: jax.Array
) -> tuple[Layer, ...]:
    """Backpropagation, summed over the tile: Goodfellow et al. 2016, "Deep Learning", alg. 6.4.

    With z = x W + b and g the derivative with respect to z, those with respect to W, b and x are
    x^T g, the sum of g over samples, and g W^T; x = f(z') of the layer before multiplies by f'(z').
    """
    gradient = []
    for index in reversed(range(len(network))):
        before, features = seen[index]
        gradient.append(Layer(_outer(features, slope), jnp.sum(slope, axis=0)))
        if index:
            back = jnp.dot(slope, network[index].kernel.T)
            slope = back * _SLOPES[activation](before, features)
    return tuple(reversed(gradient))


def _outer(features: jax.Array, slope: jax.Array) -> jax.Array:
    """x^T g, with the wider of both in front: an H100's fast products have 64 rows or more."""
    if features.shape[1] < slope.shape[1]:
        return jnp.dot(slope.T, features).T
    return jnp.dot(features.T, slope)


def _swish(before: jax.Array) -> jax.Array:
    return before * _logistic(before)


def _logistic(x: jax.Array) -> jax.Array:
    return 1.0 / (1.0 + jnp.exp(-x))


def _slope_of_swish(before: jax.Array, after: jax.Array) -> jax.Array:
    """The derivative of z s(z), s + z s (1 - s), since that of the logistic s is s (1 - s)."""
    share = _logistic(before)
    return share + after * (1.0 - share)


_ACTIVATIONS = {"tanh": jnp.tanh, "relu": lambda z: jnp.maximum(z, 0.0), "swish": _swish}
# Derivatives, by what the activation took and what it gave.
_SLOPES = {
    "tanh": lambda _, after: 1.0 - after * after,
    "relu": lambda before, _: jnp.where(before > 0.0, 1.0, 0.0),
    "swish": _slope_of_swish,
}
