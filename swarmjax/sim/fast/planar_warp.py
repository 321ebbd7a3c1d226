"""Contacts of planar robots in Warp: one kernel, with one thread per arena.

`discs` describes the problem. A thread finds and stores the contacts of its arena, and sweeps
through them until no force changes. In a kernel that XLA unrolls over all possible contacts, most
of a sweep would go to contacts that do not exist.

JAX calls the kernel through `warp.jax_kernel`, so XLA can include it in a CUDA graph.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp
from jax import Array
from jax.custom_batching import custom_vmap

from swarmjax.sim import model as sim_model
from swarmjax.sim.engine import ROWS_PER_ROBOT
from swarmjax.sim.fast import discs as sim_discs
from swarmjax.sim.fast.discs import DiscRobots, Discs

BLOCK = 64  # threads per block; with few arenas, blocks of 256 would leave most of a GPU idle
_TOLERANCE = wp.constant(sim_discs.TOLERANCE)
_DEEPEST = wp.constant(sim_discs.DEEPEST)
_WALLS = wp.constant(sim_model.WALLS)
_THICKNESS = wp.constant(sim_model.WALL_HALF_THICKNESS)
_LENGTH = wp.constant(sim_model.WALL_HALF_LENGTH)


def push_apart(discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> Array:
    """Computes the accelerations of one arena's robots, including contacts.

    `vmap` adds arenas to the same kernel, for any axes.

    Args:
      discs: constants.
      robots: their state, and their accelerations without contacts.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [R, 3] accelerations of x and y, m/s^2, and of yaw, rad/s^2. Contacts do not change the
      acceleration of yaw.
    """
    many = of_arenas(functools.partial(_solve, discs))
    return many(*jax.tree.map(lambda x: x[None], (robots, side, obstacle)))[0]


def of_arenas(solve: Any) -> Any:
    """Makes a function of arrays with an arena axis treat each `vmap` axis as more arenas."""
    many = custom_vmap(solve)

    @many.def_vmap
    def _(size: int, batched: Any, *given: Any) -> tuple[Array, bool]:
        def widen(x: Array, has: bool) -> Array:
            return x if has else jnp.broadcast_to(x, (size, *x.shape))

        whole = jax.tree.map(widen, given, tuple(batched))
        shape = whole[1].shape  # shape of the sides: [size, arenas]
        arenas = shape[0] * shape[1]  # `reshape` cannot infer this number if there are no obstacles
        found = many(*jax.tree.map(lambda x: x.reshape(arenas, *x.shape[2:]), whole))
        return found.reshape(*shape, *found.shape[1:]), True

    return many


def _solve(discs: Discs, robots: DiscRobots, side: Array, obstacle: Array) -> Array:
    """Computes the accelerations [A, R, 3] of many arenas."""
    arenas, count = robots.mobility.shape
    fixtures = obstacle.shape[1] + sim_model.WALLS
    pairs = count * fixtures + count * (count - 1) // 2
    rows = min(pairs, ROWS_PER_ROBOT * count + fixtures), arenas
    numbers = np.array([discs.radius, *sim_discs.spring(discs), *discs.solimp], np.float32)
    call = wp.jax_kernel(_push_apart, num_outputs=4, block_dim=BLOCK)
    shapes = {"row": rows, "soft": rows, "between": rows, "found": (arenas, count)}
    given = *robots[:-1], side, obstacle, jnp.asarray(numbers), discs.sweeps
    return call(*given, launch_dims=arenas, output_dims=shapes)[-1]


@wp.struct
class WarpArena:
    """Arrays that a thread reads and writes.

    Attributes:
      place: [A, R] x, y (m), yaw (rad).
      rate: [A, R] velocity of `place`, 1/s.
      before: [A, R] acceleration of `place` in the previous step, 1/s^2.
      mobility: [A, R] 1 / mass.
      weight: [A, R] inverse weight.
      numbers: radius (m), stiffness (1/s^2), damping (1/s), and `solimp`.
      row: [K, A] numbers of each contact: x and y of the unit vector along which it pushes, aref,
        and J M^-1 J' + R.
      soft: [K, A] R, and the force, N.
      between: [K, A] the robot pushed along the vector, and the robot pushed back; -1 for none.
      found: [A, R] acceleration of x, y and yaw.
      index: [A] index of the thread.
    """

    place: wp.array2d[wp.vec3]
    rate: wp.array2d[wp.vec3]
    before: wp.array2d[wp.vec3]
    mobility: wp.array2d[float]
    weight: wp.array2d[float]
    numbers: wp.array[float]
    row: wp.array2d[wp.vec4]
    soft: wp.array2d[wp.vec2]
    between: wp.array2d[wp.vec2i]
    found: wp.array2d[wp.vec3]
    index: int


@wp.kernel(enable_backward=False)
def _push_apart(  # noqa: PLR0913  # JAX passes arrays one by one
    place: wp.array2d[wp.vec3],
    rate: wp.array2d[wp.vec3],
    free: wp.array2d[wp.vec3],
    before: wp.array2d[wp.vec3],
    mobility: wp.array2d[float],
    weight: wp.array2d[float],
    side: wp.array[float],
    obstacle: wp.array3d[float],
    numbers: wp.array[float],
    sweeps: int,
    row: wp.array2d[wp.vec4],
    soft: wp.array2d[wp.vec2],
    between: wp.array2d[wp.vec2i],
    found: wp.array2d[wp.vec3],
) -> None:
    """Finds the forces of an arena's contacts, and the accelerations that they cause."""
    arena = WarpArena()
    arena.place = place
    arena.rate = rate
    arena.before = before
    arena.mobility = mobility
    arena.weight = weight
    arena.numbers = numbers
    arena.row = row
    arena.soft = soft
    arena.between = between
    arena.found = found
    arena.index = wp.tid()
    _let_go(arena, free)
    count = wp.int32(0)
    for m in range(obstacle.shape[1]):
        count = _touch_box(arena, count, obstacle_box(obstacle, arena.index, m))
    for k in range(_WALLS):
        count = _touch_box(arena, count, wall_box(side[arena.index], k))
    for i in range(place.shape[1]):
        count = _touch_robots(arena, count, i)
    done = wp.int32(0)
    moves = count > 0
    while moves and done < sweeps:
        moves = _sweep(arena, count)
        done += 1
    if count > 0:
        _finish(arena, free, count)


@wp.func
def _let_go(arena: WarpArena, free: wp.array2d[wp.vec3]) -> None:
    """Sets the accelerations to their values without contacts."""
    for i in range(free.shape[1]):
        arena.found[arena.index, i] = free[arena.index, i]


@wp.struct
class WarpBox:
    """A rectangle: centre (m), cosine and sine of its yaw, half edges (m)."""

    x: float
    y: float
    cos: float
    sin: float
    half_x: float
    half_y: float


@wp.func
def obstacle_box(obstacle: wp.array3d[float], arena: int, m: int) -> WarpBox:
    """Returns an obstacle of an arena."""
    box = WarpBox()
    box.x = obstacle[arena, m, 0]
    box.y = obstacle[arena, m, 1]
    box.cos = wp.cos(obstacle[arena, m, 2])
    box.sin = wp.sin(obstacle[arena, m, 2])
    box.half_x = obstacle[arena, m, 3]
    box.half_y = obstacle[arena, m, 4]
    return box


@wp.func
def wall_box(side: float, k: int) -> WarpBox:
    """Returns the east, north, west or south wall, as in `model.fixture_rectangles`."""
    box = WarpBox()
    box.cos = wp.where(k % 2 == 1, 0.0, wp.where(k == 0, 1.0, -1.0))
    box.sin = wp.where(k % 2 == 0, 0.0, wp.where(k == 1, 1.0, -1.0))
    away = 0.5 * side + _THICKNESS
    box.x = away * box.cos
    box.y = away * box.sin
    box.half_x = _THICKNESS
    box.half_y = _LENGTH
    return box


@wp.func
def _touch_box(arena: WarpArena, count: int, box: WarpBox) -> int:
    """Stores the contacts of all robots with a box; returns the new number of contacts."""
    known = count
    for i in range(arena.place.shape[1]):
        gap = from_box(arena.place[arena.index, i], box, arena.numbers[0])
        known = _touch(arena, known, gap, i, -1)
    return known


@wp.func
def _touch_robots(arena: WarpArena, count: int, i: int) -> int:
    """Stores the contacts of a robot with later robots; returns the new number of contacts."""
    known = count
    for j in range(i + 1, arena.place.shape[1]):
        apart = arena.place[arena.index, i] - arena.place[arena.index, j]
        known = _touch(arena, known, from_disc(apart[0], apart[1], arena.numbers[0]), i, j)
    return known


@wp.func
def from_box(place: wp.vec3, box: WarpBox, radius: float) -> wp.vec3:
    """Returns x and y of the unit vector from a box to a robot, and the gap between them, m.

    The gap is measured from the box's point nearest to the hull's centre. A centre within the box
    has no such point, so its gap is measured from the nearest face, unless that face is the top or
    the bottom (`discs.DEEPEST`).
    """
    away_x, away_y = place[0] - box.x, place[1] - box.y
    x = box.cos * away_x + box.sin * away_y
    y = box.cos * away_y - box.sin * away_x
    over_x, over_y = wp.abs(x) - box.half_x, wp.abs(y) - box.half_y
    along = wp.vec2(wp.max(over_x, 0.0), wp.max(over_y, 0.0))
    distance = wp.length(along)
    depth = -wp.max(over_x, over_y)
    if depth >= 0.0:
        along = wp.where(over_x > over_y, wp.vec2(1.0, 0.0), wp.vec2(0.0, 1.0))
        distance = wp.where(depth > _DEEPEST, radius, -depth)
    along = wp.normalize(along)
    # A centre midway between two faces is pushed out through the face at the negative end.
    along_x = wp.where(x > 0.0, along[0], -along[0])
    along_y = wp.where(y > 0.0, along[1], -along[1])
    world_x = box.cos * along_x - box.sin * along_y
    world_y = box.sin * along_x + box.cos * along_y
    return wp.vec3(world_x, world_y, distance - radius)


@wp.func
def from_disc(x: float, y: float, radius: float) -> wp.vec3:
    """Returns the unit vector from the second robot to the first, and their gap, m.

    x and y (m) lead from the second robot to the first. Two hulls at the same place push each other
    along x, as in MuJoCo. The first is pushed towards negative x.
    """
    apart = wp.length(wp.vec2(x, y))
    along = wp.vec2(-1.0, 0.0)
    if apart > 0.0:
        along = wp.vec2(x / apart, y / apart)
    return wp.vec3(along[0], along[1], apart - 2.0 * radius)


@wp.func
def _touch(arena: WarpArena, count: int, gap: wp.vec3, first: int, second: int) -> int:
    """Stores a closed gap as a contact with an initial force; returns the number of contacts."""
    if not (gap[2] < 0.0) or count >= arena.row.shape[0]:
        return count
    arena.between[count, arena.index] = wp.vec2i(first, second)
    weight = arena.weight[arena.index, first]
    mobility = arena.mobility[arena.index, first]
    if second >= 0:
        weight += arena.weight[arena.index, second]
        mobility += arena.mobility[arena.index, second]
    impedance = impedance_at(arena.numbers, -gap[2])
    give = wp.max(weight * (1.0 - impedance) / impedance, 1.0e-15)  # mjMINVAL
    speed = _along(arena, arena.rate, gap[0], gap[1], first, second)
    demand = -arena.numbers[2] * speed - arena.numbers[1] * impedance * gap[2]
    arena.row[count, arena.index] = wp.vec4(gap[0], gap[1], demand, mobility + give)
    # Start with the force that the contact would have at the previous step's acceleration.
    short = demand - _along(arena, arena.before, gap[0], gap[1], first, second)
    force = wp.max(short / give, 0.0)
    arena.soft[count, arena.index] = wp.vec2(give, force)
    _push(arena, count, force)
    return count + 1


@wp.func
def impedance_at(numbers: wp.array[float], depth: float) -> float:
    """Returns the impedance at a depth, m: MuJoCo, "Solver parameters", d(r) of `solimp`."""
    least, most, middle, power = numbers[3], numbers[4], numbers[6], numbers[7]
    share = wp.min(depth / numbers[5], 1.0)
    rise = wp.pow(share, power) / wp.pow(middle, power - 1.0)
    if share >= middle:
        rise = 1.0 - wp.pow(1.0 - share, power) / wp.pow(1.0 - middle, power - 1.0)
    return least + rise * (most - least)


@wp.func
def _along(
    arena: WarpArena, motion: wp.array2d[wp.vec3], x: float, y: float, first: int, second: int
) -> float:
    """Returns J a: how fast the two sides of a contact move apart."""
    apart = motion[arena.index, first]
    if second >= 0:
        apart = apart - motion[arena.index, second]
    return x * apart[0] + y * apart[1]


@wp.func
def _push(arena: WarpArena, contact: int, force: float) -> None:
    """Adds the accelerations due to a force, a += M^-1 J' f."""
    row = arena.row[contact, arena.index]
    between = arena.between[contact, arena.index]
    push = wp.vec3(force * row[0], force * row[1], 0.0)
    _push_robot(arena, between[0], push)
    if between[1] >= 0:
        _push_robot(arena, between[1], -push)


@wp.func
def _push_robot(arena: WarpArena, robot: int, push: wp.vec3) -> None:
    """Adds a robot's acceleration due to a push."""
    kick = arena.mobility[arena.index, robot] * push
    arena.found[arena.index, robot] = arena.found[arena.index, robot] + kick


@wp.func
def _sweep(arena: WarpArena, count: int) -> bool:
    """Sets each force to its best value, given the others; returns whether any force changed."""
    largest = wp.float32(0.0)
    change = wp.float32(0.0)
    for k in range(count):
        row = arena.row[k, arena.index]
        soft = arena.soft[k, arena.index]
        between = arena.between[k, arena.index]
        along = _along(arena, arena.found, row[0], row[1], between[0], between[1])
        more = wp.max((row[2] - along - soft[0] * soft[1]) / row[3], -soft[1])
        arena.soft[k, arena.index] = wp.vec2(soft[0], soft[1] + more)
        _push(arena, k, more)
        largest = wp.max(largest, soft[1] + more)
        change = wp.max(change, wp.abs(more))
    return change > _TOLERANCE * largest


@wp.func
def _finish(arena: WarpArena, free: wp.array2d[wp.vec3], count: int) -> None:
    """Recomputes the accelerations from the forces, without the rounding of the sweeps."""
    _let_go(arena, free)
    for k in range(count):
        _push(arena, k, arena.soft[k, arena.index][1])
