"""Kernels in Warp that list the contacts of planar robots and call a solver for their forces.

The threads of an arena list its contacts, and solve for the contact forces (with `planar_warp`, or
with `rubbing_warp` if there is friction). A kernel made by XLA would compute all possible contacts,
most of which do not exist.

Robots that touch each other, directly or through others, form an island. A force in one island
changes nothing in another island, so each thread solves whole islands by itself. The fewer arenas
there are, the more threads each arena has, up to the 32 threads of a CUDA warp. On a CPU, each
arena has one thread.

Comparing all pairs of many robots would take too long. With more than `MANY` robots, a first kernel
therefore lists the contacts: one thread for each obstacle, wall and robot looks for robots in the
cells around it (`cells_warp`). Both ways list the contacts in the same order. The threads of the
arena then only solve for the forces.

JAX calls the kernel through `warp.jax_kernel`, so XLA can include it in a CUDA graph.
"""

# Warp's types know neither the arguments of a struct nor the argument `module`.
# pyright: reportCallIssue=false

import functools
import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp
from jax import Array

from swarmjax.sim import model as sim_model
from swarmjax.sim.engine import ROWS_PER_ROBOT
from swarmjax.sim.fast import discs as sim_discs
from swarmjax.sim.fast import gaps_warp
from swarmjax.sim.fast.arenas_warp import over_arenas
from swarmjax.sim.fast.discs import DiscRobots, Discs
from swarmjax.sim.fast.gaps_warp import WarpArena

MANY = 100  # robots; on two cores, cells save time beyond about this number
_BLOCK = 64  # threads per block; with few arenas, blocks of 256 would leave most of a GPU idle
_THREADS = 2**17  # threads of all arenas together; more do not help
_MOST_THREADS = 32


def launch(solver: str, discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> Array:
    """Computes the accelerations of one arena's robots, including contacts.

    Under `vmap`, over any number of axes, one kernel computes all arenas.

    Args:
      solver: name of a module with the constants `KERNELS`, a result of `kernels_of`, and `ROWS`,
        the number of rows of `WarpArena.contact` that these kernels use.
      discs: constants.
      robots: the state of the robots, and their accelerations without contacts.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [R, 3] accelerations of x and y, m/s^2, and of yaw, rad/s^2.
    """
    return over_arenas(functools.partial(_launch, solver, discs), robots, side, obstacle)


def _launch(solver: str, discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> Array:
    """Computes the accelerations [A, R, 3] of many arenas."""
    arenas, count = robots.mobility.shape
    fixtures = obstacle.shape[1] + sim_model.WALLS
    pairs = count * fixtures + count * (count - 1) // 2
    contacts = min(pairs, ROWS_PER_ROBOT * count + fixtures)
    hull = discs.radius, *sim_discs.spring(discs), *discs.solimp, discs.friction
    threads = _threads_each(arenas)
    numbers = jnp.asarray(np.array([*hull, discs.sweeps, threads], np.float32))
    body = jnp.stack([robots.mobility, robots.weight, robots.agility], axis=-1)
    motion = robots.place, robots.rate, robots.free, robots.before, body
    made = importlib.import_module(solver)
    motion, (few, many) = jnp.stack(motion, axis=1), made.KERNELS
    call = functools.partial(wp.jax_kernel, num_outputs=4, block_dim=_BLOCK)
    shapes = {"total": (arenas, count), "island": (arenas, count), "after": (contacts, arenas)}
    room, dims = (made.ROWS, contacts, arenas), {"launch_dims": (arenas, threads)}
    if count <= MANY:
        given, shapes = (motion, side, obstacle, numbers), shapes | {"contact": room}
        return call(few)(*given, output_dims=shapes, **dims)[1]
    listed, contact = gaps_warp.list_by_cells(
        room, discs.radius, robots.place, side, obstacle, numbers
    )
    given = motion, numbers, jnp.minimum(listed, contacts), contact
    total = call(many, in_out_argnames=["contact"])(*given, output_dims=shapes, **dims)[1]
    # An arena with more contacts than there is memory for gets NaN, so it counts as broken.
    return jnp.where((listed > contacts)[:, None, None], jnp.nan, total)


def _threads_each(arenas: int) -> int:
    """Returns the number of threads of an arena, a power of two."""
    if jax.default_backend() != "gpu":
        return 1
    return min(_MOST_THREADS, 2 ** max(0, (_THREADS // arenas).bit_length() - 1))


def kernels_of(solve: Any) -> Any:
    """Makes two kernels that compute the accelerations of the robots in many arenas.

    Args:
      solve: a Warp function that takes a `WarpArena` and the first of the contacts to solve. When
        it is called, `total` of the arena equals `free`. The function sets `total` of the robots in
        these contacts.

    Returns:
      Two kernels for `launch`: the first one lists the contacts itself, the second one gets a list
      of contacts.
    """

    @wp.kernel(enable_backward=False, module="unique")
    def push_apart(
        motion: wp.array3d[wp.vec3],
        side: wp.array[float],
        obstacle: wp.array3d[float],
        numbers: wp.array[float],
        contact: wp.array3d[wp.vec4],
        total: wp.array2d[wp.vec3],
        island: wp.array2d[int],
        after: wp.array2d[int],
    ) -> None:
        i, thread = wp.tid()
        arena = _arena_of(motion[i], numbers, contact, total[i], island[i], after, i)
        arena.side = side[i]
        arena.obstacle = obstacle[i]
        first = _deal_out(arena, gaps_warp.list_contacts(arena, thread), thread)
        if first >= 0:
            solve(arena, first)

    @wp.kernel(enable_backward=False, module="unique")
    def push_listed_apart(
        motion: wp.array3d[wp.vec3],
        numbers: wp.array[float],
        listed: wp.array[int],
        contact: wp.array3d[wp.vec4],
        total: wp.array2d[wp.vec3],
        island: wp.array2d[int],
        after: wp.array2d[int],
    ) -> None:
        i, thread = wp.tid()
        arena = _arena_of(motion[i], numbers, contact, total[i], island[i], after, i)
        first = _deal_out(arena, listed[i], thread)
        if first >= 0:
            solve(arena, first)

    return push_apart, push_listed_apart


@wp.func
def _arena_of(
    motion: wp.array2d[wp.vec3],
    numbers: wp.array[float],
    contact: wp.array3d[wp.vec4],
    total: wp.array[wp.vec3],
    island: wp.array[int],
    after: wp.array2d[int],
    index: int,
) -> WarpArena:
    """Returns an arena whose side and obstacles are not set."""
    arena = WarpArena()
    arena.place = motion[0]
    arena.rate = motion[1]
    arena.free = motion[2]
    arena.before = motion[3]
    arena.body = motion[4]
    arena.numbers = numbers
    arena.threads = int(numbers[10])
    arena.contact = contact
    arena.total = total
    arena.island = island
    arena.after = after
    arena.index = index
    return arena


@wp.func
def let_go(arena: WarpArena, first: int) -> None:
    """Resets the accelerations of the robots in a thread's contacts to those without contacts."""
    k = wp.int32(first)
    while k >= 0:
        sides = gaps_warp.sides_of(arena.contact[1, k, arena.index])
        arena.total[sides[0]] = arena.free[sides[0]]
        if sides[1] >= 0:
            arena.total[sides[1]] = arena.free[sides[1]]
        k = arena.after[k, arena.index]


@wp.func
def _deal_out(arena: WarpArena, count: int, thread: int) -> int:
    """Assigns the islands to the threads; returns this thread's first contact, -1 if it has none.

    Also sets all accelerations to their values without contacts.
    """
    for i in range(thread, arena.free.shape[0], arena.threads):
        arena.total[i] = arena.free[i]
        arena.island[i] = i
    if arena.threads > 1:
        while gaps_warp.any_votes(_join(arena, count, thread)):
            pass
    first = wp.int32(-1)
    for j in range(count):
        k = count - 1 - j
        robot = gaps_warp.sides_of(arena.contact[1, k, arena.index])[0]
        if arena.island[robot] % arena.threads == thread:
            arena.after[k, arena.index] = first
            first = k
    return first


@wp.func
def _join(arena: WarpArena, count: int, thread: int) -> bool:
    """Joins the islands of touching robots; returns whether any robots had different islands."""
    moves = wp.bool(False)
    for k in range(thread, count, arena.threads):
        sides = gaps_warp.sides_of(arena.contact[1, k, arena.index])
        if sides[1] >= 0:
            one, other = arena.island[sides[0]], arena.island[sides[1]]
            if one != other:
                wp.atomic_min(arena.island, sides[0], other)
                wp.atomic_min(arena.island, sides[1], one)
                moves = wp.bool(True)
    return moves


@wp.func
def body_of(arena: WarpArena, sides: wp.vec2i) -> wp.vec3:
    """Returns the sum of `arena.body` over the one or two robots of a contact."""
    total = arena.body[sides[0]]
    if sides[1] >= 0:
        total = total + arena.body[sides[1]]
    return total


@wp.func
def impedance_at(numbers: wp.array[float], depth: float) -> float:
    """Returns the impedance at a depth (m): d(r) in MuJoCo's documentation, "Solver parameters"."""
    least, most, middle, power = numbers[3], numbers[4], numbers[6], numbers[7]
    share = wp.min(depth / numbers[5], 1.0)
    rise = wp.pow(share, power) / wp.pow(middle, power - 1.0)
    if share >= middle:
        rise = 1.0 - wp.pow(1.0 - share, power) / wp.pow(1.0 - middle, power - 1.0)
    return least + rise * (most - least)


@wp.func
def give_at(weight: float, impedance: float) -> float:
    """Returns the softness R (1 / kg) in MuJoCo's documentation, "Solver parameters"."""
    return wp.max(weight * (1.0 - impedance) / impedance, 1.0e-15)  # mjMINVAL
