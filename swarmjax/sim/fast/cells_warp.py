"""Puts robots into a grid of cells, in Warp, to find those near a place without checking all.

A robot is in the cell of its centre. The robots of a cell form a linked list of any length, so no
cell overflows. The grid repeats: along x and y, the last cell is followed by the first cell. So the
grid has a cell for every place in the plane, also for parked robots and for robots outside the
walls.
"""

import math

import jax.numpy as jnp
import warp as wp
from jax import Array

# Distance from the origin, in cells. Along each axis, all places beyond this distance share one
# cell. Up to this distance, float32 rounds to less than 1 % of a cell.
_FAR = wp.constant(32768.0)
_PER_ROBOT = 2.0  # least cells of an axis, divided by the square root of the number of robots


def chain(place: Array, width: float) -> tuple[Array, Array]:
    """Puts the robots of many arenas into cells.

    Args:
      place: [A, R, 3] x (m), y (m), yaw (rad).
      width: edge of a cell, m.

    Returns:
      [A, C, C] the first robot of each cell, and [A, R] the robot that follows each robot in its
      cell; -1 for none. C is a power of two. The order of the robots in a cell may differ from run
      to run.
    """
    arenas, robots = place.shape[:2]
    across = 2 ** math.ceil(math.log2(_PER_ROBOT * math.sqrt(robots)))
    empty = jnp.full((arenas, across, across), -1, jnp.int32)
    call = wp.jax_kernel(_enter, num_outputs=2, in_out_argnames=["first"])
    size = (arenas, robots)
    return call(place, width, empty, launch_dims=size, output_dims={"after": size})


@wp.kernel(enable_backward=False)
def _enter(
    place: wp.array2d[wp.vec3], width: float, first: wp.array3d[int], after: wp.array2d[int]
) -> None:
    """Puts a robot into its cell, at the head of the list of the robots already there."""
    i, robot = wp.tid()
    here, last = place[i, robot], first.shape[1] - 1
    x, y = cell_at(here[0], width) & last, cell_at(here[1], width) & last
    after[i, robot] = wp.atomic_exch(first, i, x, y, robot)


@wp.func
def cell_at(x: float, width: float) -> int:
    """Returns the index of x's cell in an endless row of cells; NaN has a cell, too."""
    across = x / width
    return int(wp.floor(wp.where(across > -_FAR, wp.min(across, _FAR), -_FAR)))


@wp.func
def cells_around(x: float, reach: float, width: float, across: int) -> wp.vec2i:
    """Returns the cells within reach of x along an axis: the first, and one past the last.

    These are at most as many cells as the grid has (`across`), so that no robot is found twice.
    """
    first = cell_at(x - reach, width)
    return wp.vec2i(first, wp.min(cell_at(x + reach, width) + 1, first + across))
