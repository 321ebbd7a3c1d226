"""Contacts of planar robots with friction, in Warp; `planar_warp` is the version without friction.

`rubbing_jax` describes the problem. `planar_warp` describes how contacts are listed and how JAX
calls the kernel.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp
from jax import Array

from swarmjax.sim import model as sim_model
from swarmjax.sim.engine import ROWS_PER_ROBOT
from swarmjax.sim.fast import discs as sim_discs
from swarmjax.sim.fast import planar_warp
from swarmjax.sim.fast.discs import TOLERANCE, DiscRobots, Discs
from swarmjax.sim.fast.rubbing_jax import FLOOR, KEPT, ROUNDING

_TOLERANCE = wp.constant(TOLERANCE)
_KEPT = wp.constant(KEPT)
_ROUNDING = wp.constant(ROUNDING)
_FLOOR = wp.constant(FLOOR)
_WALLS = wp.constant(sim_model.WALLS)


def push_apart(discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> Array:
    """Computes the accelerations of one arena's robots, including contacts.

    `vmap` adds arenas to the same kernel, for any axes.

    Args:
      discs: constants.
      robots: their state, accelerations without contacts, and `rubbing`.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [R, 3] accelerations of x and y, m/s^2, and of yaw, rad/s^2.
    """
    many = planar_warp.of_arenas(functools.partial(_solve, discs))
    return many(*jax.tree.map(lambda x: x[None], (robots, side, obstacle)))[0]


def _solve(discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> Array:
    """Computes the accelerations [A, R, 3] of many arenas."""
    assert robots.rubbing is not None
    arenas, count = robots.mobility.shape
    fixtures = obstacle.shape[1] + sim_model.WALLS
    pairs = count * fixtures + count * (count - 1) // 2
    rows = min(pairs, ROWS_PER_ROBOT * count + fixtures), arenas
    numbers = np.array([discs.radius, *sim_discs.spring(discs), *discs.solimp], np.float32)
    call = wp.jax_kernel(_push_apart, num_outputs=6, block_dim=planar_warp.BLOCK)
    shapes = dict.fromkeys(("row", "asked", "force", "between"), rows)
    shapes |= {"past": (KEPT, *rows), "found": (arenas, count)}
    given = *robots[:-1], *robots.rubbing, side, obstacle, jnp.asarray(numbers), discs.sweeps
    return call(*given, launch_dims=arenas, output_dims=shapes)[-1]


@wp.struct
class WarpRubbingArena:
    """Arrays that a thread reads and writes.

    Attributes:
      place: [A, R] x, y (m), yaw (rad).
      rate: [A, R] velocity of `place`, 1/s.
      free: [A, R] acceleration of `place` without contacts, 1/s^2.
      before: [A, R] acceleration of `place` in the previous step, 1/s^2.
      mobility: [A, R] 1 / mass.
      weight: [A, R] inverse weight.
      agility: [A, R] 1 / moment of inertia.
      friction: friction between hulls and everything that they touch.
      numbers: radius (m), stiffness (1/s^2), damping (1/s), and `solimp`.
      row: [K, A] numbers of each contact: x and y of the unit vector along which it pushes, its arm
        (m), R.
      asked: [K, A] aref of push and rub, and J M^-1 J' + R of both.
      force: [K, A] push and rub, N.
      between: [K, A] the robot pushed along the vector, and the robot pushed back; -1 for none.
      past: [KEPT, K, A] push and rub after a sweep, and their changes in that sweep, N; sweep i is
        in row i modulo KEPT.
      found: [A, R] acceleration of x, y and yaw.
      index: [A] index of the thread.
    """

    place: wp.array2d[wp.vec3]
    rate: wp.array2d[wp.vec3]
    free: wp.array2d[wp.vec3]
    before: wp.array2d[wp.vec3]
    mobility: wp.array2d[float]
    weight: wp.array2d[float]
    agility: wp.array2d[float]
    friction: float
    numbers: wp.array[float]
    row: wp.array2d[wp.vec4]
    asked: wp.array2d[wp.vec4]
    force: wp.array2d[wp.vec2]
    between: wp.array2d[wp.vec2i]
    past: wp.array3d[wp.vec4]
    found: wp.array2d[wp.vec3]
    index: int


@wp.struct
class WarpSwept:
    """The result of a sweep, with the sums over contacts that the next leap needs.

    Let r be the changes of this sweep. Let a be r minus the changes of the last sweep, and b the
    changes of the last sweep minus those of the sweep before it.

    Attributes:
      moves: whether a force changed.
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


@wp.kernel(enable_backward=False)
def _push_apart(  # noqa: PLR0913  # JAX passes arrays one by one
    place: wp.array2d[wp.vec3],
    rate: wp.array2d[wp.vec3],
    free: wp.array2d[wp.vec3],
    before: wp.array2d[wp.vec3],
    mobility: wp.array2d[float],
    weight: wp.array2d[float],
    agility: wp.array2d[float],
    friction: wp.array[float],
    side: wp.array[float],
    obstacle: wp.array3d[float],
    numbers: wp.array[float],
    sweeps: int,
    row: wp.array2d[wp.vec4],
    asked: wp.array2d[wp.vec4],
    force: wp.array2d[wp.vec2],
    between: wp.array2d[wp.vec2i],
    past: wp.array3d[wp.vec4],
    found: wp.array2d[wp.vec3],
) -> None:
    """Finds the forces of an arena's contacts, and the accelerations that they cause."""
    arena = WarpRubbingArena()
    arena.place = place
    arena.rate = rate
    arena.free = free
    arena.before = before
    arena.mobility = mobility
    arena.weight = weight
    arena.agility = agility
    arena.numbers = numbers
    arena.row = row
    arena.asked = asked
    arena.force = force
    arena.between = between
    arena.past = past
    arena.found = found
    arena.index = wp.tid()
    arena.friction = friction[arena.index]
    _let_go(arena)
    count = wp.int32(0)
    for m in range(obstacle.shape[1]):
        count = _touch_box(arena, count, planar_warp.obstacle_box(obstacle, arena.index, m))
    for k in range(_WALLS):
        count = _touch_box(arena, count, planar_warp.wall_box(side[arena.index], k))
    for i in range(place.shape[1]):
        count = _touch_robots(arena, count, i)
    if count > 0:
        _solve_contacts(arena, count, sweeps)
        _finish(arena, count)


@wp.func
def _let_go(arena: WarpRubbingArena) -> None:
    """Sets the accelerations to their values without contacts."""
    for i in range(arena.free.shape[1]):
        arena.found[arena.index, i] = arena.free[arena.index, i]


@wp.func
def _touch_box(arena: WarpRubbingArena, count: int, box: planar_warp.WarpBox) -> int:
    """Stores the contacts of all robots with a box; returns the new number of contacts."""
    known = count
    for i in range(arena.place.shape[1]):
        gap = planar_warp.from_box(arena.place[arena.index, i], box, arena.numbers[0])
        known = _touch(arena, known, gap, i, -1)
    return known


@wp.func
def _touch_robots(arena: WarpRubbingArena, count: int, i: int) -> int:
    """Stores the contacts of a robot with later robots; returns the new number of contacts."""
    known = count
    for j in range(i + 1, arena.place.shape[1]):
        apart = arena.place[arena.index, i] - arena.place[arena.index, j]
        gap = planar_warp.from_disc(apart[0], apart[1], arena.numbers[0])
        known = _touch(arena, known, gap, i, j)
    return known


@wp.func
def _touch(arena: WarpRubbingArena, count: int, gap: wp.vec3, first: int, second: int) -> int:
    """Stores a closed gap as a contact with initial forces; returns the number of contacts."""
    if not (gap[2] < 0.0) or count >= arena.row.shape[0]:
        return count
    between = wp.vec2i(first, second)
    weight = _both(arena, arena.weight, between)
    mobility = _both(arena, arena.mobility, between)
    impedance = planar_warp.impedance_at(arena.numbers, -gap[2])
    give = wp.max(weight * (1.0 - impedance) / impedance, 1.0e-15)  # mjMINVAL
    arm = arena.numbers[0] + 0.5 * gap[2]  # MuJoCo's contact is midway between the surfaces
    row = wp.vec4(gap[0], gap[1], arm, give)
    speed = _slide(arena, arena.rate, row, between)
    push = -arena.numbers[2] * speed[0] - arena.numbers[1] * impedance * gap[2]
    rub = -arena.numbers[2] * speed[1]
    turns = arm * arm * _both(arena, arena.agility, between)
    arena.row[count, arena.index] = row
    arena.asked[count, arena.index] = wp.vec4(push, rub, mobility + give, mobility + turns + give)
    arena.between[count, arena.index] = between
    # Start with the forces that the contact would have at the previous step's acceleration.
    speed = _slide(arena, arena.before, row, between)
    short = wp.vec2((push - speed[0]) / give, (rub - speed[1]) / give)
    force = _project(short, give, give, arena.friction)
    arena.force[count, arena.index] = force
    _push(arena, row, between, force)
    return count + 1


@wp.func
def _both(arena: WarpRubbingArena, of_robots: wp.array2d[float], between: wp.vec2i) -> float:
    """Returns the sum of a number over both sides of a contact."""
    total = of_robots[arena.index, between[0]]
    if between[1] >= 0:
        total += of_robots[arena.index, between[1]]
    return total


@wp.func
def _slide(
    arena: WarpRubbingArena, motion: wp.array2d[wp.vec3], row: wp.vec4, between: wp.vec2i
) -> wp.vec2:
    """Returns J a: how fast the two sides of a contact move apart, and how fast they slide."""
    apart = _apart(arena, motion, between)
    along = row[0] * apart[1] - row[1] * apart[0] - row[2] * apart[2]
    return wp.vec2(row[0] * apart[0] + row[1] * apart[1], along)


@wp.func
def _apart(arena: WarpRubbingArena, motion: wp.array2d[wp.vec3], between: wp.vec2i) -> wp.vec3:
    """Returns the motion of one side of a contact relative to the other."""
    apart = motion[arena.index, between[0]]
    if between[1] >= 0:
        other = motion[arena.index, between[1]]
        apart = wp.vec3(apart[0] - other[0], apart[1] - other[1], apart[2] + other[2])
    return apart


@wp.func
def _push(arena: WarpRubbingArena, row: wp.vec4, between: wp.vec2i, force: wp.vec2) -> None:
    """Adds the accelerations due to forces, a += M^-1 J' f."""
    x = row[0] * force[0] - row[1] * force[1]
    y = row[1] * force[0] + row[0] * force[1]
    turn = -row[2] * force[1]
    _push_robot(arena, between[0], wp.vec3(x, y, turn))
    if between[1] >= 0:
        _push_robot(arena, between[1], wp.vec3(-x, -y, turn))


@wp.func
def _push_robot(arena: WarpRubbingArena, robot: int, push: wp.vec3) -> None:
    """Adds a robot's acceleration due to a push and a torque."""
    mobility = arena.mobility[arena.index, robot]
    turn = arena.agility[arena.index, robot] * push[2]
    kick = wp.vec3(mobility * push[0], mobility * push[1], turn)
    arena.found[arena.index, robot] = arena.found[arena.index, robot] + kick


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
def _solve_contacts(arena: WarpRubbingArena, count: int, sweeps: int) -> None:
    """Sweeps until no force changes, with leaps in between (`rubbing_jax.solve`)."""
    done = wp.int32(0)
    size = wp.float32(0.0)
    moves = done < sweeps
    least = _least_change(arena, count)
    while moves and done < sweeps:
        swept = _sweep(arena, count, done, least)
        moves = swept.moves
        done += 1
        if moves and done >= _KEPT and 2 * done <= sweeps and swept.size <= size:
            _leap(arena, count, done - 1, _weights(swept))
        size = swept.size


@wp.func
def _least_change(arena: WarpRubbingArena, count: int) -> float:
    """Returns the force, N, that rounding can cause, as in `rubbing_jax`."""
    largest = wp.float32(0.0)
    for k in range(count):
        apart = _apart(arena, arena.free, arena.between[k, arena.index])
        turn = arena.row[k, arena.index][2] * wp.abs(apart[2])
        size = wp.abs(apart[0]) + wp.abs(apart[1]) + turn
        largest = wp.max(largest, size / arena.asked[k, arena.index][2])
    return _FLOOR * largest


@wp.func
def _sweep(arena: WarpRubbingArena, count: int, index: int, least: float) -> WarpSwept:
    """Sets all forces to their best values, contact by contact."""
    swept = WarpSwept()
    largest = wp.float32(0.0)
    change = wp.float32(0.0)
    for k in range(count):
        row = arena.row[k, arena.index]
        asked = arena.asked[k, arena.index]
        force = arena.force[k, arena.index]
        between = arena.between[k, arena.index]
        speed = _slide(arena, arena.found, row, between)
        push = (asked[0] - speed[0] - row[3] * force[0]) / asked[2]
        rub = (asked[1] - speed[1] - row[3] * force[1]) / asked[3]
        wanted = wp.vec2(force[0] + push, force[1] + rub)
        best = _project(wanted, asked[2], asked[3], arena.friction)
        arena.force[k, arena.index] = best
        more = wp.vec2(best[0] - force[0], best[1] - force[1])
        _push(arena, row, between, more)
        largest = wp.max(largest, best[0])
        change = wp.max(change, wp.max(wp.abs(more[0]), wp.abs(more[1])))
        swept = _remember(arena, swept, k, index, more)
    swept.moves = change > wp.max(_TOLERANCE * largest, least)
    return swept


@wp.func
def _remember(
    arena: WarpRubbingArena, swept: WarpSwept, k: int, index: int, more: wp.vec2
) -> WarpSwept:
    """Stores the forces of a contact after a sweep, and adds to the sums."""
    force = arena.force[k, arena.index]
    last = arena.past[(index + 2) % _KEPT, k, arena.index]
    before = arena.past[(index + 1) % _KEPT, k, arena.index]
    arena.past[index % _KEPT, k, arena.index] = wp.vec4(force[0], force[1], more[0], more[1])
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
    """Returns the weights of the newer and the older step in a leap (`rubbing_jax`)."""
    if not (swept.older > 0.0):
        return wp.vec2(0.0, 0.0)
    both = swept.both / swept.older
    left = swept.newer * (1.0 + _ROUNDING) - both * swept.both
    if not (left > 0.0):
        return wp.vec2(0.0, 0.0)
    newer = (swept.by_newer - both * swept.by_older) / left
    return wp.vec2(newer, (swept.by_older - newer * swept.both) / swept.older)


@wp.func
def _leap(arena: WarpRubbingArena, count: int, index: int, weights: wp.vec2) -> None:
    """Continues from the mix of the last three sweeps' forces that should change least."""
    for k in range(count):
        row = arena.row[k, arena.index]
        asked = arena.asked[k, arena.index]
        force = arena.force[k, arena.index]
        last = arena.past[(index + 2) % _KEPT, k, arena.index]
        before = arena.past[(index + 1) % _KEPT, k, arena.index]
        push = weights[0] * (force[0] - last[0]) + weights[1] * (last[0] - before[0])
        rub = weights[0] * (force[1] - last[1]) + weights[1] * (last[1] - before[1])
        wanted = wp.vec2(force[0] - push, force[1] - rub)
        mixed = _project(wanted, asked[2], asked[3], arena.friction)
        arena.force[k, arena.index] = mixed
        more = wp.vec2(mixed[0] - force[0], mixed[1] - force[1])
        _push(arena, row, arena.between[k, arena.index], more)


@wp.func
def _finish(arena: WarpRubbingArena, count: int) -> None:
    """Recomputes the accelerations from the forces, without the rounding of the sweeps."""
    _let_go(arena)
    for k in range(count):
        between = arena.between[k, arena.index]
        _push(arena, arena.row[k, arena.index], between, arena.force[k, arena.index])
