"""Solves the contact forces of planar robots with friction, in Warp.

`rubbing_jax` describes the problem, and `contacts_warp` describes the kernel.
"""

import functools

import warp as wp

from swarmjax.sim.fast import contacts_warp, gaps_warp
from swarmjax.sim.fast.discs import TOLERANCE
from swarmjax.sim.fast.gaps_warp import WarpArena
from swarmjax.sim.fast.rubbing_jax import FLOOR, KEPT, ROUNDING

_TOLERANCE = wp.constant(TOLERANCE)
_KEPT = wp.constant(KEPT)
_ROUNDING = wp.constant(ROUNDING)
_FLOOR = wp.constant(FLOOR)
_PAST = wp.constant(3)  # first row of `WarpArena.contact` that holds forces of past sweeps


@wp.struct
class WarpSwept:
    """The result of a sweep: sums over contacts that the next leap needs.

    In the following, r is the changes of all forces in this sweep, p those in the previous sweep,
    and q those in the sweep before the previous one; a = r - p, and b = p - q.

    Attributes:
      moves: whether this sweep changed a force.
      size: r . r.
      newer: a . a.
      both: a . b.
      older: b . b.
      by_newer: r . a.
      by_older: r . b.
    """

    moves: bool
    size: float
    newer: float
    both: float
    older: float
    by_newer: float
    by_older: float


@wp.func
def _solve(arena: WarpArena, first: int) -> None:
    """Sweeps until no force changes any more, with leaps in between, as `rubbing_jax` does.

    In `WarpArena.contact`, row 0 becomes x and y of the unit vector, the lever arm (m), and R. Row
    1 becomes push and rub (N), and both robots. Row 2 becomes aref of push and of rub, and J M^-1
    J' + R of push and of rub. Each of the last `KEPT` rows holds push and rub after a sweep, and
    their changes in that sweep; sweep i is in row i modulo `KEPT` of these rows.
    """
    k = wp.int32(first)
    while k >= 0:
        _begin(arena, k)
        k = arena.after[k, arena.index]
    sweeps = int(arena.numbers[9])
    done = wp.int32(0)
    size = wp.float32(0.0)
    moves = done < sweeps
    least = _least_change(arena, first)
    while moves and done < sweeps:
        swept = _sweep(arena, first, done, least)
        moves = swept.moves
        done += 1
        if moves and done >= _KEPT and 2 * done <= sweeps and swept.size <= size:
            _leap(arena, first, done - 1, _weights(swept))
        size = swept.size
    # Recompute the accelerations from the forces, without the rounding of the sweeps.
    contacts_warp.let_go(arena, first)
    k = first
    while k >= 0:
        held = arena.contact[1, k, arena.index]
        force = wp.vec2(held[0], held[1])
        _push(arena, arena.contact[0, k, arena.index], gaps_warp.sides_of(held), force)
        k = arena.after[k, arena.index]


@wp.func
def _begin(arena: WarpArena, k: int) -> None:
    """Computes the parameters of a contact, and applies its initial forces."""
    gap = arena.contact[0, k, arena.index]
    sides = gaps_warp.sides_of(arena.contact[1, k, arena.index])
    body = contacts_warp.body_of(arena, sides)
    impedance = contacts_warp.impedance_at(arena.numbers, -gap[2])
    give = contacts_warp.give_at(body[1], impedance)
    arm = arena.numbers[0] + 0.5 * gap[2]  # MuJoCo's contact is midway between the surfaces
    row = wp.vec4(gap[0], gap[1], arm, give)
    speed = _slide(arena.rate, row, sides)
    push = -arena.numbers[2] * speed[0] - arena.numbers[1] * impedance * gap[2]
    rub = -arena.numbers[2] * speed[1]
    turns = arm * arm * body[2]
    arena.contact[0, k, arena.index] = row
    arena.contact[2, k, arena.index] = wp.vec4(push, rub, body[0] + give, body[0] + turns + give)
    # Start with the forces that the contact would have at the previous step's acceleration.
    speed = _slide(arena.before, row, sides)
    short = wp.vec2((push - speed[0]) / give, (rub - speed[1]) / give)
    force = _project(short, give, give, arena.numbers[8])
    _hold(arena, k, force, sides)
    _push(arena, row, sides, force)


@wp.func
def _hold(arena: WarpArena, k: int, force: wp.vec2, sides: wp.vec2i) -> None:
    """Stores the forces of a contact."""
    held = wp.vec4(force[0], force[1], float(sides[0]), float(sides[1]))
    arena.contact[1, k, arena.index] = held


@wp.func
def _slide(motion: wp.array[wp.vec3], row: wp.vec4, sides: wp.vec2i) -> wp.vec2:
    """Returns J a: the parts of a motion in which a contact's sides move apart, and slide."""
    apart = _apart(motion, sides)
    along = row[0] * apart[1] - row[1] * apart[0] - row[2] * apart[2]
    return wp.vec2(row[0] * apart[0] + row[1] * apart[1], along)


@wp.func
def _apart(motion: wp.array[wp.vec3], sides: wp.vec2i) -> wp.vec3:
    """Returns the motion of one side of a contact relative to the other."""
    apart = motion[sides[0]]
    if sides[1] >= 0:
        other = motion[sides[1]]
        apart = wp.vec3(apart[0] - other[0], apart[1] - other[1], apart[2] + other[2])
    return apart


@wp.func
def _push(arena: WarpArena, row: wp.vec4, sides: wp.vec2i, force: wp.vec2) -> None:
    """Adds the accelerations due to forces, a += M^-1 J' f."""
    x = row[0] * force[0] - row[1] * force[1]
    y = row[1] * force[0] + row[0] * force[1]
    turn = -row[2] * force[1]
    _push_robot(arena, sides[0], wp.vec3(x, y, turn))
    if sides[1] >= 0:
        _push_robot(arena, sides[1], wp.vec3(-x, -y, turn))


@wp.func
def _push_robot(arena: WarpArena, robot: int, push: wp.vec3) -> None:
    """Adds a robot's acceleration due to a force along x and y and a torque."""
    body = arena.body[robot]
    kick = wp.vec3(body[0] * push[0], body[0] * push[1], body[2] * push[2])
    arena.total[robot] = arena.total[robot] + kick


@wp.func
def _project(force: wp.vec2, push: float, rub: float, friction: float) -> wp.vec2:
    """Returns the point of the friction cone nearest to these forces (`rubbing_jax.project`)."""
    size = wp.abs(force[1])
    if size <= friction * force[0]:
        return force
    edge = (push * force[0] + friction * rub * size) / (push + friction * friction * rub)
    edge = wp.max(edge, 0.0)
    return wp.vec2(edge, wp.sign(force[1]) * friction * edge)


@wp.func
def _least_change(arena: WarpArena, first: int) -> float:
    """Returns the change of a force (N) that rounding can cause (`rubbing_jax._least_change`)."""
    largest = wp.float32(0.0)
    k = wp.int32(first)
    while k >= 0:
        sides = gaps_warp.sides_of(arena.contact[1, k, arena.index])
        apart = _apart(arena.free, sides)
        turn = arena.contact[0, k, arena.index][2] * wp.abs(apart[2])
        size = wp.abs(apart[0]) + wp.abs(apart[1]) + turn
        largest = wp.max(largest, size / arena.contact[2, k, arena.index][2])
        k = arena.after[k, arena.index]
    return _FLOOR * largest


@wp.func
def _sweep(arena: WarpArena, first: int, index: int, least: float) -> WarpSwept:
    """Sets all forces to their optimal values, contact by contact."""
    swept = WarpSwept()
    largest = wp.float32(0.0)
    change = wp.float32(0.0)
    k = wp.int32(first)
    while k >= 0:
        row = arena.contact[0, k, arena.index]
        force = arena.contact[1, k, arena.index]
        asked = arena.contact[2, k, arena.index]
        sides = gaps_warp.sides_of(force)
        speed = _slide(arena.total, row, sides)
        push = (asked[0] - speed[0] - row[3] * force[0]) / asked[2]
        rub = (asked[1] - speed[1] - row[3] * force[1]) / asked[3]
        wanted = wp.vec2(force[0] + push, force[1] + rub)
        best = _project(wanted, asked[2], asked[3], arena.numbers[8])
        _hold(arena, k, best, sides)
        more = wp.vec2(best[0] - force[0], best[1] - force[1])
        _push(arena, row, sides, more)
        largest = wp.max(largest, best[0])
        change = wp.max(change, wp.max(wp.abs(more[0]), wp.abs(more[1])))
        swept = _remember(arena, swept, k, index, wp.vec4(best[0], best[1], more[0], more[1]))
        k = arena.after[k, arena.index]
    swept.moves = change > wp.max(_TOLERANCE * largest, least)
    return swept


@wp.func
def _remember(arena: WarpArena, swept: WarpSwept, k: int, index: int, now: wp.vec4) -> WarpSwept:
    """Stores a contact's forces after a sweep and their changes, and adds them to the sums."""
    last = arena.contact[_PAST + (index + 2) % _KEPT, k, arena.index]
    before = arena.contact[_PAST + (index + 1) % _KEPT, k, arena.index]
    arena.contact[_PAST + index % _KEPT, k, arena.index] = now
    more = wp.vec2(now[2], now[3])
    newer = wp.vec2(more[0] - last[2], more[1] - last[3])
    older = wp.vec2(last[2] - before[2], last[3] - before[3])
    swept.size += wp.dot(more, more)
    swept.newer += wp.dot(newer, newer)
    swept.both += wp.dot(newer, older)
    swept.older += wp.dot(older, older)
    swept.by_newer += wp.dot(more, newer)
    swept.by_older += wp.dot(more, older)
    return swept


@wp.func
def _weights(swept: WarpSwept) -> wp.vec2:
    """Returns the weights of the newer and the older step in a leap (`rubbing_jax._weights`)."""
    if not (swept.older > 0.0):
        return wp.vec2(0.0, 0.0)
    both = swept.both / swept.older
    left = swept.newer * (1.0 + _ROUNDING) - both * swept.both
    if not (left > 0.0):
        return wp.vec2(0.0, 0.0)
    newer = (swept.by_newer - both * swept.by_older) / left
    return wp.vec2(newer, (swept.by_older - newer * swept.both) / swept.older)


@wp.func
def _leap(arena: WarpArena, first: int, index: int, weights: wp.vec2) -> None:
    """Sets the forces to a mix of the last three sweeps' forces (`rubbing_jax._leap`)."""
    k = wp.int32(first)
    while k >= 0:
        force = arena.contact[1, k, arena.index]
        asked = arena.contact[2, k, arena.index]
        last = arena.contact[_PAST + (index + 2) % _KEPT, k, arena.index]
        before = arena.contact[_PAST + (index + 1) % _KEPT, k, arena.index]
        push = weights[0] * (force[0] - last[0]) + weights[1] * (last[0] - before[0])
        rub = weights[0] * (force[1] - last[1]) + weights[1] * (last[1] - before[1])
        wanted = wp.vec2(force[0] - push, force[1] - rub)
        mixed = _project(wanted, asked[2], asked[3], arena.numbers[8])
        sides = gaps_warp.sides_of(force)
        _hold(arena, k, mixed, sides)
        more = wp.vec2(mixed[0] - force[0], mixed[1] - force[1])
        _push(arena, arena.contact[0, k, arena.index], sides, more)
        k = arena.after[k, arena.index]


KERNELS, ROWS = contacts_warp.kernels_of(_solve), _PAST + KEPT
push_apart = functools.partial(contacts_warp.launch, __name__)
