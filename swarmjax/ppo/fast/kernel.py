"""A GPU kernel that runs samples through a network and a loss, and backpropagates, on the chip.

XLA writes the activations of every layer to memory and reads them again. Here a program of the grid
keeps the activations of a tile of samples on the chip. A program writes only sums, when it ends.
Programs share nothing, so the same samples give the same bits. A network is one vector, and so is
its gradient: the optimiser then handles one array instead of a dozen.

B is the number of samples, P the number of programs, and `tile` the number of samples that a
program holds at once.
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
# Greatest width of a layer. The sums for a 128 x 128 matrix occupy 128 threads, and take 128 of the
# 255 registers of each thread.
MOST_WIDTH = 128
# Bytes of the chip's memory that a program may use. Compute capability 8 and later gives at least
# 99 KiB (CUDA C++ Programming Guide, "Technical Specifications per Compute Capability"). `fits`
# counts what the matrix products of capability 9.0 take; those of other capabilities take up to 4
# KiB more.
SHARED_MEMORY = 95 * 1024
# The same limit, by compute capability, of chips that allow more; from the same source.
_MORE_SHARED_MEMORY = {"8.0": 163 * 1024, "9.0": 227 * 1024, "10.0": 227 * 1024}


class Layer(NamedTuple):
    """An affine layer, or its gradient.

    Attributes:
      kernel: [in, out].
      bias: [out].
    """

    kernel: jax.Array
    bias: jax.Array


class Place(NamedTuple):
    """Where an affine layer lies in the vector of its network's parameters, row by row.

    Attributes:
      kernel: Index of the kernel's first number.
      bias: Index of the bias's first number.
      shape: Number of inputs, and number of outputs.
    """

    kernel: int
    bias: int
    shape: tuple[int, int]


class Launch(NamedTuple):
    """How the kernel is spread over the GPU.

    Attributes:
      tile: Samples of a tile, a power of two of at least `LEAST_WIDTH`.
      programs: Greatest number of programs in the grid. There are never more programs than tiles.
      warps: Number of warps of a program.
    """

    tile: int
    programs: int
    warps: int


class KernelLayout(NamedTuple):
    """How the parameters of a network lie in one vector.

    Attributes:
      layers: Hidden layers and output, in order.
      vectors: For each other parameter, by name, the index of its first number and its width.
      size: Length of the vector.
    """

    layers: tuple[Place, ...]
    vectors: dict[str, tuple[int, int]]
    size: int


class Tiles(NamedTuple):
    """The tiles of samples that a kernel takes. Tile i begins with sample i * tile.

    Attributes:
      order: [K], int32, indices of tiles.
      span: [2], int32, two indices of `order`: the first to take, and the first to leave out.
    """

    order: jax.Array
    span: jax.Array


# Samples of a tile by name, each [tile] or [tile, width], zero past the last sample.
Samples = dict[str, jax.Array]
# (output of the network [tile, width], samples, vectors) -> (derivative of the loss with respect to
# the output [tile, width], other terms to sum over all samples, each [tile, ...]).
Loss = Callable[[jax.Array, Samples, dict[str, jax.Array]], tuple[jax.Array, dict[str, jax.Array]]]


_Activations = list[tuple[jax.Array, jax.Array]]


def shared_memory() -> int:
    """Returns how many bytes of the chip's memory a program may use on JAX's current device."""
    capability = str(getattr(jax.devices()[0], "compute_capability", ""))
    return _MORE_SHARED_MEMORY.get(capability, SHARED_MEMORY)


def padded_width(width: int) -> int:
    """Returns the width with padding: a power of two, for Triton, and at least `LEAST_WIDTH`."""
    return max(LEAST_WIDTH, pl.next_power_of_2(width))


def fits(
    inputs: int,
    hidden: tuple[int, ...],
    outputs: int,
    tile: int,
    memory: int = SHARED_MEMORY,
) -> bool:
    """Tells whether the kernel supports a network: its widths, and the memory that it needs.

    Triton stores the first weight matrix once and all others twice: the second copy is transposed
    for the backward pass. Triton also stores a tile of observations, and two tiles of the widest
    hidden layer.

    Args:
      inputs: Width of the observation. The widths of observation and output are padded.
      hidden: Widths of the hidden layers, powers of two.
      outputs: Width of the output.
      tile: Samples of a tile.
      memory: Bytes of the chip's memory that a program may use.

    Returns:
      Whether `sums` may be called.
    """
    if any(not LEAST_WIDTH <= width <= MOST_WIDTH or width.bit_count() != 1 for width in hidden):
        return False
    widths = [padded_width(inputs), *hidden, padded_width(outputs)]
    kernels = [before * after for before, after in itertools.pairwise(widths)]
    numbers = kernels[0] + 2 * sum(kernels[1:]) + tile * (widths[0] + 2 * max(hidden))
    return max(widths) <= MOST_WIDTH and 4 * numbers <= memory


def sums(
    parameters: jax.Array,
    layout: KernelLayout,
    activation: str,
    loss: Loss,
    samples: Samples,
    tiles: Tiles,
    launch: Launch,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Sums the gradient of a loss, and the loss's other terms, over the samples of some tiles.

    Args:
      parameters: [n] of a network. The parameters have no padding in the GPU's memory, and are
        padded on the chip.
      layout: Layout of `parameters`. `padded_width` leaves the widths of the hidden layers
        unchanged.
      activation: Activation of the hidden layers, `tanh`, `relu` or `swish`.
      loss: Loss of the output. All its results must be 0 for samples that are not valid. The loss
        gets the layout's vectors with padding, and returns their derivatives under the same names.
      samples: By name, each [B] or [B, width], float32. `observation` [B, O] is the network's
        input.
      tiles: The tiles to sum over, each of `launch.tile` samples.
      launch: How the kernel is spread over the GPU.

    Returns:
      The gradient [n], and the loss's other terms by name, each [].
    """
    of_tile = functools.partial(_of_tile, activation, loss)
    shapes = jax.eval_shape(of_tile, *_shapes(layout, samples, launch.tile))
    told = [name for name in shapes[1] if name not in layout.vectors]
    width = layout.size + len(told)
    programs = min(launch.programs, tiles.order.size)
    totals = pl.pallas_call(
        functools.partial(_program, of_tile, shapes, layout, launch.tile),
        grid=(programs,),
        out_shape=jax.ShapeDtypeStruct((programs * width,), jnp.float32),
        # Prefetching saves no time: loading a tile's samples is little work beside its products.
        compiler_params=triton.CompilerParams(num_warps=launch.warps, num_stages=1),
    )(parameters, samples, tiles)
    total = jnp.sum(totals.reshape(programs, width), axis=0)
    return total[: layout.size], dict(zip(told, total[layout.size :], strict=True))


def _shapes(layout: KernelLayout, samples: Samples, tile: int) -> Any:
    """Lists the shapes of the arguments of a tile: layers, samples and vectors, all padded."""

    def array(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(tuple(map(padded_width, shape)), jnp.float32)

    layers = tuple(Layer(array(*x.shape), array(x.shape[1])) for x in layout.layers)
    vectors = {name: array(width) for name, (_, width) in layout.vectors.items()}
    return layers, {name: array(tile, *x.shape[1:]) for name, x in samples.items()}, vectors


def _program(
    of_tile: Callable[..., Any],
    shapes: Any,
    layout: KernelLayout,
    tile: int,
    parameters: Any,
    samples: dict[str, Any],
    tiles: Any,
    totals: Any,
) -> None:
    """Runs one of P programs, on every P-th tile; all arguments after `tile` are references."""
    program, programs = pl.program_id(0), pl.num_programs(0)
    layers = tuple(_read_layer(parameters, place) for place in layout.layers)
    vectors = {name: _read_row(parameters, *at) for name, at in layout.vectors.items()}
    first = tiles.span[0] + program

    def add(i: jax.Array, sofar: Any) -> Any:
        rows = tiles.order[first + i * programs] * tile + jnp.arange(tile)
        read = {name: _read(ref, rows) for name, ref in samples.items()}
        return jax.tree.map(jnp.add, sofar, of_tile(layers, read, vectors))

    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, jnp.float32), shapes)
    rounds = (tiles.span[1] - first + programs - 1) // programs
    gradient, parts = jax.lax.fori_loop(0, rounds, add, nothing)
    row = program * (totals.shape[0] // programs)
    for place, layer in zip(layout.layers, gradient, strict=True):
        _write_layer(totals, row, place, layer)
    told = layout.size
    for name, part in parts.items():
        if name in layout.vectors:
            _write_row(totals, row, *layout.vectors[name], jnp.sum(part, axis=0))
        else:
            totals[row + told] = jnp.sum(part, axis=0)
            told += 1


def _at(first: Any, shape: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    """Returns where the numbers of a padded array lie in a vector, and which are no padding."""
    counts = [jnp.arange(padded_width(width)) for width in shape]
    if len(shape) == 1:
        return first + counts[0], counts[0] < shape[0]
    rows, columns = counts[0][:, None], counts[1][None, :]
    return first + rows * shape[1] + columns, (rows < shape[0]) & (columns < shape[1])


def _read_layer(ref: Any, place: Place) -> Layer:
    index, mask = _at(place.kernel, place.shape)
    kernel = triton.load(ref.at[index], mask=mask, other=0.0)
    return Layer(kernel, _read_row(ref, place.bias, place.shape[1]))


def _read_row(ref: Any, first: int, width: int) -> jax.Array:
    index, mask = _at(first, (width,))
    return triton.load(ref.at[index], mask=mask, other=0.0)


def _write_layer(ref: Any, row: jax.Array, place: Place, layer: Layer) -> None:
    index, mask = _at(row + place.kernel, place.shape)
    triton.store(ref.at[index], layer.kernel, mask=mask)
    _write_row(ref, row, place.bias, place.shape[1], layer.bias)


def _write_row(ref: Any, row: jax.Array, first: int, width: int, values: jax.Array) -> None:
    index, mask = _at(row + first, (width,))
    triton.store(ref.at[index], values, mask=mask)


def _read(ref: Any, rows: jax.Array) -> jax.Array:
    """Reads rows of an array, widened to float32; zeros where the array has no row."""
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
    vectors: dict[str, jax.Array],
) -> tuple[tuple[Layer, ...], dict[str, jax.Array]]:
    """Runs a tile forward and backward; returns the summed gradient and each sample's terms."""
    activations, output = _forward(activation, network, samples["observation"])
    slope, parts = loss(output, samples, vectors)
    return _backward(activation, network, activations, slope), parts


def _forward(
    activation: str, network: tuple[Layer, ...], features: jax.Array
) -> tuple[_Activations, jax.Array]:
    """Returns each layer's input, before and after its activation, and the network's output."""
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
    """Backpropagates and sums over the tile (Goodfellow et al. 2016, "Deep Learning", alg. 6.4).

    With z = x W + b and g the derivative with respect to z, the derivatives with respect to W, b
    and x are x^T g, the sum of g over samples, and g W^T. If x = f(z') is the output of the layer
    before, the derivative with respect to z' is that of x times f'(z').
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
    """Computes x^T g, the wider factor first: an H100's fast products need 64 rows or more."""
    if features.shape[1] < slope.shape[1]:
        return jnp.dot(slope.T, features).T
    return jnp.dot(features.T, slope)


def _swish(before: jax.Array) -> jax.Array:
    return before * logistic(before)


def logistic(x: jax.Array) -> jax.Array:
    """Computes 1 / (1 + exp(-x)) from functions that Triton has."""
    return 1.0 / (1.0 + jnp.exp(-x))


def _slope_of_swish(before: jax.Array, after: jax.Array) -> jax.Array:
    """Computes the derivative of z s(z), s + z s (1 - s), where s is the logistic function."""
    share = logistic(before)
    return share + after * (1.0 - share)


_ACTIVATIONS = {"tanh": jnp.tanh, "relu": lambda z: jnp.maximum(z, 0.0), "swish": _swish}
# Derivatives of the activations, from their input and their output.
_SLOPES = {
    "tanh": lambda _, after: 1.0 - after * after,
    "relu": lambda before, _: jnp.where(before > 0.0, 1.0, 0.0),
    "swish": _slope_of_swish,
}
