"""Shortest paths around obstacles in Warp; replaces the JAX code of `task/geodesic.py`.

For each pair of corners, a thread checks whether the straight line between them is free. For each
robot, a thread finds the shortest distance from each corner to the robot's target, nearest corners
first (Dijkstra 1959, "A Note on Two Problems in Connexion with Graphs"). Another thread per robot
finds the first corner of the robot's own path. This thread looks for obstacles only on the way to
corners that could shorten the path. XLA would take minutes to compile the JAX code for a GPU.
"""

from functools import partial

import jax.numpy as jnp
import warp as wp
from jax import Array

from swarmjax.sim.fast.arenas_warp import over_arenas

_FAR = wp.constant(1e30)  # m; stands for inf inside the kernels
_OPEN, _SETTLED = wp.constant(0), wp.constant(1)


def find_legs(corner: Array, side: Array, frame: Array, widened: float) -> Array:
    """Measures the straight lines between the corners of an arena.

    Under `vmap`, one kernel computes all arenas.

    Args:
      corner: [K, 2] x and y, m.
      side: [] side of the arena, m.
      frame: [M, 6] obstacles: x (m), y (m), cosine and sine of yaw, half edges (m).
      widened: width added around obstacles, m.

    Returns:
      [K, K] m; inf if an obstacle is in between, or if a corner lies in an obstacle or outside the
      arena. The distance from a corner to itself is 0 m, unless the corner lies outside.
    """
    size = len(corner), len(corner)
    return _run("_leg", size, {"length": size}, widened, corner, side, frame)


def settle(target: Array, corner: Array, frame: Array, legs: Array, widened: float) -> Array:
    """Finds the length of the shortest path from each corner to each target.

    Args:
      target: [R, 2] x and y, m.
      corner: [K, 2] x and y, m.
      frame: [M, 6] obstacles, as for `find_legs`.
      legs: [K, K] result of `find_legs`.
      widened: width added around obstacles, m.

    Returns:
      [R, K] m; inf without a path.
    """
    size = len(target), len(corner)
    shapes = {"state": size, "to_go": size}
    return _run("_settle_corners", size[:1], shapes, widened, target, corner, frame, legs)


def measure(
    place: Array, target: Array, corner: Array, to_go: Array, frame: Array, widened: float
) -> Array:
    """Measures the shortest path from each robot to its target.

    Args:
      place: [R, 2] places of the robots: x and y, m.
      target: [R, 2] x and y, m.
      corner: [K, 2] x and y, m.
      to_go: [R, K] result of `settle`.
      frame: [M, 6] obstacles, as for `find_legs`.
      widened: width added around obstacles, m.

    Returns:
      [R] m; inf without a path.
    """
    size = (len(place),)
    return _run("_path", size, {"length": size}, widened, place, target, corner, to_go, frame)


def _run(kernel: str, threads: tuple, shapes: dict, widened: float, *inputs: Array) -> Array:
    """Runs a kernel for one arena; returns its last output."""
    return over_arenas(partial(_launch, kernel, threads, shapes, widened), *inputs)


def _launch(kernel: str, threads: tuple, shapes: dict, widened: float, *inputs: Array) -> Array:
    """Runs a kernel for many arenas; `threads` and `shapes` (of outputs) are those of one arena."""
    arenas = len(inputs[0])
    call = wp.jax_kernel(globals()[kernel], num_outputs=len(shapes))
    sizes = {name: (arenas, *shape) for name, shape in shapes.items()}
    outputs = call(*inputs, widened, launch_dims=(arenas, *threads), output_dims=sizes)
    return jnp.where(outputs[-1] >= 0.5 * _FAR, jnp.inf, outputs[-1])


@wp.func
def _is_barred(
    frame: wp.array3d[float], arena: int, widened: float, begin: wp.vec2, end: wp.vec2
) -> bool:
    """Returns whether a segment meets a widened obstacle (separating axes, as in `geodesic.py`)."""
    barred = wp.bool(False)
    m = wp.int32(0)
    while m < frame.shape[1] and not barred:
        x, y = frame[arena, m, 0], frame[arena, m, 1]
        cos, sin = frame[arena, m, 2], frame[arena, m, 3]
        half_x, half_y = frame[arena, m, 4] + widened, frame[arena, m, 5] + widened
        middle_x = 0.5 * (begin[0] + end[0]) - x
        middle_y = 0.5 * (begin[1] + end[1]) - y
        reach_x, reach_y = 0.5 * (end[0] - begin[0]), 0.5 * (end[1] - begin[1])
        at_x, at_y = cos * middle_x + sin * middle_y, cos * middle_y - sin * middle_x
        to_x, to_y = cos * reach_x + sin * reach_y, cos * reach_y - sin * reach_x
        across = wp.abs(at_x * to_y - at_y * to_x)
        to_x, to_y = wp.abs(to_x), wp.abs(to_y)
        barred = (
            wp.abs(at_x) < half_x + to_x
            and wp.abs(at_y) < half_y + to_y
            and across < half_x * to_y + half_y * to_x
        )
        m += 1
    return barred


@wp.kernel(enable_backward=False)
def _leg(
    corner: wp.array2d[wp.vec2],
    side: wp.array[float],
    frame: wp.array3d[float],
    widened: float,
    length: wp.array3d[float],
) -> None:
    """Measures the straight line from one corner to another."""
    arena, i, j = wp.tid()
    begin, end = corner[arena, i], corner[arena, j]
    reach = wp.max(
        wp.max(wp.abs(begin[0]), wp.abs(begin[1])), wp.max(wp.abs(end[0]), wp.abs(end[1]))
    )
    straight = float(_FAR)
    if reach <= 0.5 * side[arena] - widened and not _is_barred(frame, arena, widened, begin, end):
        straight = wp.length(end - begin)
    length[arena, i, j] = straight


@wp.kernel(enable_backward=False)
def _settle_corners(
    target: wp.array2d[wp.vec2],
    corner: wp.array2d[wp.vec2],
    frame: wp.array3d[float],
    legs: wp.array3d[float],
    widened: float,
    state: wp.array3d[int],
    to_go: wp.array3d[float],
) -> None:
    """Finds the distance from each corner to a target, beginning with corners in sight of it."""
    arena, robot = wp.tid()
    goal, corners = target[arena, robot], corner.shape[1]
    for k in range(corners):
        state[arena, robot, k] = _OPEN
        to_go[arena, robot, k] = _FAR
        if legs[arena, k, k] == 0.0 and not _is_barred(
            frame, arena, widened, goal, corner[arena, k]
        ):
            to_go[arena, robot, k] = wp.length(corner[arena, k] - goal)
    nearest = _nearest(state, to_go, arena, robot)
    while nearest >= 0:
        state[arena, robot, nearest] = _SETTLED
        least = to_go[arena, robot, nearest]
        for k in range(corners):
            further = least + legs[arena, nearest, k]
            to_go[arena, robot, k] = wp.min(further, to_go[arena, robot, k])
        nearest = _nearest(state, to_go, arena, robot)


@wp.func
def _nearest(state: wp.array3d[int], to_go: wp.array3d[float], arena: int, robot: int) -> int:
    """Returns the open corner nearest to the target; -1 if no open corner has a path."""
    nearest, least = wp.int32(-1), wp.float32(_FAR)
    for k in range(to_go.shape[2]):
        if state[arena, robot, k] == _OPEN and to_go[arena, robot, k] < least:
            nearest, least = k, wp.float32(to_go[arena, robot, k])
    return nearest


@wp.kernel(enable_backward=False)
def _path(
    place: wp.array2d[wp.vec2],
    target: wp.array2d[wp.vec2],
    corner: wp.array2d[wp.vec2],
    to_go: wp.array3d[float],
    frame: wp.array3d[float],
    widened: float,
    length: wp.array2d[float],
) -> None:
    """Measures the shortest path of a robot."""
    arena, robot = wp.tid()
    here, goal = place[arena, robot], target[arena, robot]
    least = float(_FAR)
    if not _is_barred(frame, arena, widened, here, goal):
        least = wp.length(goal - here)
    for k in range(corner.shape[1]):
        around = wp.length(corner[arena, k] - here) + to_go[arena, robot, k]
        if around < least and not _is_barred(frame, arena, widened, here, corner[arena, k]):
            least = around
    length[arena, robot] = least
