"""Solves the contact forces of planar robots without friction, in Warp.

`discs` describes the problem, and `contacts_warp` describes the kernel. A thread sweeps through its
contacts until no force changes any more.
"""

import functools

import warp as wp

from swarmjax.sim.fast import contacts_warp, discs, gaps_warp
from swarmjax.sim.fast.gaps_warp import WarpArena

_TOLERANCE = wp.constant(discs.TOLERANCE)


@wp.func
def _solve(arena: WarpArena, first: int) -> None:
    """Finds the forces, and the accelerations that they cause.

    In `WarpArena.contact`, row 0 becomes x and y of the unit vector, aref, and J M^-1 J' + R. Row 1
    becomes R, the force (N), and both robots.
    """
    k = wp.int32(first)
    while k >= 0:
        _begin(arena, k)
        k = arena.after[k, arena.index]
    done = wp.int32(0)
    moves = wp.bool(True)
    while moves and done < int(arena.numbers[9]):
        moves = _sweep(arena, first)
        done += 1
    # Recompute the accelerations from the forces, without the rounding of the sweeps.
    contacts_warp.let_go(arena, first)
    k = first
    while k >= 0:
        held = arena.contact[1, k, arena.index]
        _push(arena, arena.contact[0, k, arena.index], gaps_warp.sides_of(held), held[1])
        k = arena.after[k, arena.index]


@wp.func
def _begin(arena: WarpArena, k: int) -> None:
    """Computes the parameters of a contact, and applies its initial force."""
    gap = arena.contact[0, k, arena.index]
    sides = gaps_warp.sides_of(arena.contact[1, k, arena.index])
    body = contacts_warp.body_of(arena, sides)
    impedance = contacts_warp.impedance_at(arena.numbers, -gap[2])
    give = contacts_warp.give_at(body[1], impedance)
    speed = _along(arena.rate, gap, sides)
    demand = -arena.numbers[2] * speed - arena.numbers[1] * impedance * gap[2]
    # Start with the force that the contact would have at the previous step's acceleration.
    force = wp.max((demand - _along(arena.before, gap, sides)) / give, 0.0)
    row = wp.vec4(gap[0], gap[1], demand, body[0] + give)
    arena.contact[0, k, arena.index] = row
    arena.contact[1, k, arena.index] = wp.vec4(give, force, float(sides[0]), float(sides[1]))
    _push(arena, row, sides, force)


@wp.func
def _along(motion: wp.array[wp.vec3], row: wp.vec4, sides: wp.vec2i) -> float:
    """Returns J a, the part of a motion in which the two sides of a contact move apart."""
    apart = motion[sides[0]]
    if sides[1] >= 0:
        apart = apart - motion[sides[1]]
    return row[0] * apart[0] + row[1] * apart[1]


@wp.func
def _push(arena: WarpArena, row: wp.vec4, sides: wp.vec2i, force: float) -> None:
    """Adds the accelerations due to a force, a += M^-1 J' f."""
    push = wp.vec3(force * row[0], force * row[1], 0.0)
    arena.total[sides[0]] = arena.total[sides[0]] + arena.body[sides[0]][0] * push
    if sides[1] >= 0:
        arena.total[sides[1]] = arena.total[sides[1]] + arena.body[sides[1]][0] * -push


@wp.func
def _sweep(arena: WarpArena, first: int) -> bool:
    """Sets each force to its optimum, given the other forces; returns whether any force changed."""
    largest = wp.float32(0.0)
    change = wp.float32(0.0)
    k = wp.int32(first)
    while k >= 0:
        row = arena.contact[0, k, arena.index]
        held = arena.contact[1, k, arena.index]
        sides = gaps_warp.sides_of(held)
        along = _along(arena.total, row, sides)
        more = wp.max((row[2] - along - held[0] * held[1]) / row[3], -held[1])
        force = held[1] + more
        arena.contact[1, k, arena.index] = wp.vec4(held[0], force, held[2], held[3])
        _push(arena, row, sides, more)
        largest = wp.max(largest, force)
        change = wp.max(change, wp.abs(more))
        k = arena.after[k, arena.index]
    return change > _TOLERANCE * largest


KERNELS, ROWS = contacts_warp.kernels_of(_solve), 2
push_apart = functools.partial(contacts_warp.launch, __name__)
