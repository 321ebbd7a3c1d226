"""The contacts of planar robots in Warp, and the kernels around a solver of their forces.

A kernel has one thread per arena. A thread lists the contacts of its arena, and solves for their
forces (`planar_warp`, and `rubbing_warp` with friction). In a kernel that XLA unrolls over all
possible contacts, most of the work would go to contacts that do not exist.

A thread that compares all pairs of many robots would take too long. For more than `MANY` robots,
one thread per obstacle, wall and robot lists the contacts with robots in the cells around it
(`cells_warp`), in the same order. The thread of the arena then only solves for the forces.

JAX calls the kernel through `warp.jax_kernel`, so XLA can include it in a CUDA graph.
"""

# Warp's types know neither the arguments of a struct nor the argument `module`.
# pyright: reportCallIssue=false

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
import warp as wp
from jax import Array

from swarmjax.sim import model as sim_model
from swarmjax.sim.engine import ROWS_PER_ROBOT
from swarmjax.sim.fast import cells_warp
from swarmjax.sim.fast import discs as sim_discs
from swarmjax.sim.fast.arenas_warp import over_arenas
from swarmjax.sim.fast.discs import DiscRobots, Discs

MANY = 100  # robots; on two cores, cells take less time beyond about this number
_BLOCK = 64  # threads per block; with few arenas, blocks of 256 would leave most of a GPU idle
# Edge of a cell in radii: 5 % more than a hull's diameter, for rounding.
CELL = wp.constant(2.1)
_DEEPEST = wp.constant(sim_discs.DEEPEST)
_WALLS = wp.constant(sim_model.WALLS)
_THICKNESS = wp.constant(sim_model.WALL_HALF_THICKNESS)
_LENGTH = wp.constant(sim_model.WALL_HALF_LENGTH)


def launch(
    kernels: Any, rows: int, discs: Discs, robots: DiscRobots, side: Array, obstacle: Array
) -> Array:
    """Computes the accelerations of one arena's robots, including contacts.

    `vmap` adds arenas to the same kernel, for any axes.

    Args:
      kernels: result of `kernels_of`.
      rows: rows of `WarpArena.contact` that its solver uses.
      discs: constants.
      robots: their state, and their accelerations without contacts.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      [R, 3] accelerations of x and y, m/s^2, and of yaw, rad/s^2.
    """
    return over_arenas(functools.partial(_launch, kernels, rows, discs), robots, side, obstacle)


def _launch(
    kernels: Any, rows: int, discs: Discs, robots: DiscRobots, side: Array, obstacle: Array
) -> Array:
    """Computes the accelerations [A, R, 3] of many arenas."""
    arenas, count = robots.mobility.shape
    fixtures = obstacle.shape[1] + sim_model.WALLS
    pairs = count * fixtures + count * (count - 1) // 2
    contacts = min(pairs, ROWS_PER_ROBOT * count + fixtures)
    hull = discs.radius, *sim_discs.spring(discs), *discs.solimp, discs.friction
    numbers = np.array([*hull, discs.sweeps], np.float32)
    body = jnp.stack([robots.mobility, robots.weight, robots.agility], axis=-1)
    dynamics = jnp.stack([robots.free, robots.before, body], axis=1)
    make = functools.partial(wp.jax_kernel, num_outputs=2, block_dim=_BLOCK)
    shapes = {"contact": (rows, contacts, arenas), "total": (arenas, count)}
    given, (few, many) = (side, obstacle, jnp.asarray(numbers)), kernels
    if count <= MANY:
        moving = robots.place, robots.rate, dynamics
        return make(few)(*moving, *given, launch_dims=arenas, output_dims=shapes)[1]
    listed, contact = list_by_cells(shapes["contact"], discs.radius, robots.place, *given)
    motion = jnp.concatenate([robots.place[:, None], robots.rate[:, None], dynamics], axis=1)
    call = make(many, in_out_argnames=["contact"])
    given = motion, *given, jnp.minimum(listed, contacts), contact
    total = call(*given, launch_dims=arenas, output_dims={"total": shapes["total"]})[1]
    # An arena with more contacts than it has room for is broken.
    return jnp.where((listed > contacts)[:, None, None], jnp.nan, total)


def list_by_cells(
    shape: tuple[int, int, int],
    radius: float,
    place: Array,
    side: Array,
    obstacle: Array,
    numbers: Array,
) -> tuple[Array, Array]:
    """Lists the contacts of many arenas as `_list_contacts` does, by looking into cells.

    Args:
      shape: N, K, A.
      radius: radius of the hulls, m.
      place: [A, R, 3] x (m), y (m), yaw (rad).
      side: [A] m.
      obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m).
      numbers: as in `WarpArena`.

    Returns:
      [A] number of contacts, which may be larger than K, and [N, K, A, 4] their rows 0 and 1, as in
      `WarpArena`.
    """
    arenas, robots = place.shape[:2]
    owners, width = (arenas, obstacle.shape[1] + sim_model.WALLS + robots), CELL * radius
    call = wp.jax_kernel(_list_near, num_outputs=2, in_out_argnames=["count"])
    given = place, side, obstacle, numbers, *cells_warp.chain(place, width)

    def run(start: Array, shape: tuple[int, int, int]) -> tuple[Array, Array]:
        return call(*given, start, launch_dims=owners, output_dims={"contact": shape})

    count = run(jnp.ones(owners, jnp.int32), (2, 1, arenas))[0]  # no room to list any
    end = jnp.cumsum(count, axis=1)
    return end[:, -1], run(end - count, shape)[1]


@wp.struct
class WarpArena:
    """Arrays of an arena, which one thread reads and writes.

    Attributes:
      place: [R] x, y (m), yaw (rad).
      rate: [R] velocity of `place`, 1/s.
      free: [R] acceleration of `place` without contacts, 1/s^2.
      before: [R] acceleration of `place` in the previous step, 1/s^2.
      body: [R] 1 / mass, inverse weight, 1 / moment of inertia.
      side: side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      numbers: radius (m), stiffness (1/s^2), damping (1/s), `solimp` (5), friction, largest number
        of sweeps.
      contact: [N, K, A] numbers of each contact of all arenas. Row 0 is x and y of the unit vector
        along which it pushes, and two numbers of the solver; at first, the third is the gap, m. Row
        1 is two numbers of the solver, the robot pushed along the vector, and the robot pushed
        back; -1 for none. All other rows are the solver's.
      total: [R] acceleration of x, y and yaw under the current forces.
      index: index of the arena.
    """

    place: wp.array[wp.vec3]
    rate: wp.array[wp.vec3]
    free: wp.array[wp.vec3]
    before: wp.array[wp.vec3]
    body: wp.array[wp.vec3]
    side: float
    obstacle: wp.array2d[float]
    numbers: wp.array[float]
    contact: wp.array3d[wp.vec4]
    total: wp.array[wp.vec3]
    index: int


def kernels_of(solve: Any) -> Any:
    """Makes two kernels that compute the accelerations of arenas.

    Args:
      solve: a Warp function that takes a `WarpArena`, whose `total` is `free`, and its number of
        contacts, and sets `total`.

    Returns:
      The kernels, for `launch`: one lists the contacts, the other takes them from a list.
    """

    @wp.kernel(enable_backward=False, module="unique")
    def push_apart(
        place: wp.array2d[wp.vec3],
        rate: wp.array2d[wp.vec3],
        dynamics: wp.array3d[wp.vec3],
        side: wp.array[float],
        obstacle: wp.array3d[float],
        numbers: wp.array[float],
        contact: wp.array3d[wp.vec4],
        total: wp.array2d[wp.vec3],
    ) -> None:
        i = wp.tid()
        arena = WarpArena(
            place[i],
            rate[i],
            dynamics[i, 0],
            dynamics[i, 1],
            dynamics[i, 2],
            side[i],
            obstacle[i],
            numbers,
            contact,
            total[i],
            i,
        )
        let_go(arena)
        count = _list_contacts(arena)
        if count > 0:
            solve(arena, count)

    @wp.kernel(enable_backward=False, module="unique")
    def push_listed_apart(
        motion: wp.array3d[wp.vec3],
        side: wp.array[float],
        obstacle: wp.array3d[float],
        numbers: wp.array[float],
        listed: wp.array[int],
        contact: wp.array3d[wp.vec4],
        total: wp.array2d[wp.vec3],
    ) -> None:
        i = wp.tid()
        place, rate, free, before = motion[i, 0], motion[i, 1], motion[i, 2], motion[i, 3]
        body, edge, box, result = motion[i, 4], side[i], obstacle[i], total[i]
        arena = WarpArena(place, rate, free, before, body, edge, box, numbers, contact, result, i)
        let_go(arena)
        if listed[i] > 0:
            solve(arena, listed[i])

    return push_apart, push_listed_apart


@wp.func
def let_go(arena: WarpArena) -> None:
    """Sets the accelerations to their values without contacts."""
    for i in range(arena.free.shape[0]):
        arena.total[i] = arena.free[i]


@wp.func
def _list_contacts(arena: WarpArena) -> int:
    """Lists the contacts with obstacles, walls and other robots; returns their number."""
    count = wp.int32(0)
    for m in range(arena.obstacle.shape[0]):
        count = _list_box(arena, count, _obstacle_box(arena, m))
    for k in range(_WALLS):
        count = _list_box(arena, count, _wall_box(arena.side, k))
    for i in range(arena.place.shape[0]):
        for j in range(i + 1, arena.place.shape[0]):
            count = _list_gap(arena, count, _from_disc(arena, i, j), i, j)
    return count


@wp.struct
class WarpBox:
    """A rectangle: centre (m), cosine and sine of its yaw, half edges (m)."""

    x: float
    y: float
    cos: float
    sin: float
    half_x: float
    half_y: float


@wp.kernel(enable_backward=False)
def _list_near(
    place: wp.array2d[wp.vec3],
    side: wp.array[float],
    obstacle: wp.array3d[float],
    numbers: wp.array[float],
    first: wp.array3d[int],
    after: wp.array2d[int],
    count: wp.array2d[int],
    contact: wp.array3d[wp.vec4],
) -> None:
    """Lists the contacts of an obstacle, wall or robot with robots, from index `count` on.

    Sets `count` to their number. A robot has contacts only with the robots after it.
    """
    i, owner = wp.tid()
    arena = WarpArena()
    arena.index = i
    arena.place = place[i]
    arena.side = side[i]
    arena.obstacle = obstacle[i]
    arena.numbers = numbers
    arena.contact = contact
    fixtures, across, width = obstacle.shape[1] + _WALLS, first.shape[1], CELL * numbers[0]
    start = wp.int32(count[i, owner])
    box = _box_of(arena, owner, width)
    reach_x = wp.abs(box.cos) * box.half_x + wp.abs(box.sin) * box.half_y + 0.5 * width
    reach_y = wp.abs(box.sin) * box.half_x + wp.abs(box.cos) * box.half_y + 0.5 * width
    x, y = cells_warp.cell_at(box.x - reach_x, width), cells_warp.cell_at(box.y - reach_y, width)
    # No more columns and rows than the grid has, or a robot would be found twice.
    end_x = wp.min(cells_warp.cell_at(box.x + reach_x, width) + 1, x + across)
    end_y = wp.min(cells_warp.cell_at(box.y + reach_y, width) + 1, y + across)
    known = wp.int32(0)
    for column in range(x, end_x):
        for row in range(y, end_y):
            robot = wp.int32(first[i, column & (across - 1), row & (across - 1)])
            while robot >= 0:
                known = _list_robot(arena, start, known, box, owner - fixtures, robot)
                robot = after[i, robot]
    count[i, owner] = known


@wp.func
def _list_robot(
    arena: WarpArena, start: int, count: int, box: WarpBox, owner: int, robot: int
) -> int:
    """Lists a robot's contact with a robot before it, or with a box if there is no `owner`.

    The contacts from `start` on are in the order of the robots. Returns their new number.
    """
    gap, first, second = wp.vec3(), robot, wp.int32(-1)
    if owner < 0:
        gap = _from_box(arena.place[robot], box, arena.numbers[0])
    elif owner < robot:
        gap, first, second = _from_disc(arena, owner, robot), owner, robot
    if not (gap[2] < 0.0):
        return count
    k = start + count
    if k < arena.contact.shape[1]:
        while k > start and _last_robot(arena, k - 1) > robot:
            arena.contact[0, k, arena.index] = arena.contact[0, k - 1, arena.index]
            arena.contact[1, k, arena.index] = arena.contact[1, k - 1, arena.index]
            k -= 1
        _list_gap(arena, k, gap, first, second)
    return count + 1


@wp.func
def _last_robot(arena: WarpArena, k: int) -> int:
    """Returns the later robot of a contact."""
    sides = sides_of(arena.contact[1, k, arena.index])
    return wp.max(sides[0], sides[1])


@wp.func
def _box_of(arena: WarpArena, owner: int, width: float) -> WarpBox:
    """Returns an obstacle, a wall, or a square of this width around a robot, in this order."""
    obstacles = arena.obstacle.shape[0]
    if owner < obstacles:
        return _obstacle_box(arena, owner)
    if owner < obstacles + _WALLS:
        return _wall_box(arena.side, owner - obstacles)
    place = arena.place[owner - obstacles - _WALLS]
    return WarpBox(place[0], place[1], 1.0, 0.0, 0.5 * width, 0.5 * width)


@wp.func
def _obstacle_box(arena: WarpArena, m: int) -> WarpBox:
    """Returns an obstacle."""
    x, y, yaw = arena.obstacle[m, 0], arena.obstacle[m, 1], arena.obstacle[m, 2]
    return WarpBox(x, y, wp.cos(yaw), wp.sin(yaw), arena.obstacle[m, 3], arena.obstacle[m, 4])


@wp.func
def _wall_box(side: float, k: int) -> WarpBox:
    """Returns the east, north, west or south wall, as in `model.fixture_rectangles`."""
    cos = wp.where(k % 2 == 1, 0.0, wp.where(k == 0, 1.0, -1.0))
    sin = wp.where(k % 2 == 0, 0.0, wp.where(k == 1, 1.0, -1.0))
    away = 0.5 * side + _THICKNESS
    return WarpBox(away * cos, away * sin, cos, sin, _THICKNESS, _LENGTH)


@wp.func
def _list_box(arena: WarpArena, count: int, box: WarpBox) -> int:
    """Lists the contacts of all robots with a box; returns the new number of contacts."""
    known = count
    for i in range(arena.place.shape[0]):
        known = _list_gap(arena, known, _from_box(arena.place[i], box, arena.numbers[0]), i, -1)
    return known


@wp.func
def _list_gap(arena: WarpArena, count: int, gap: wp.vec3, first: int, second: int) -> int:
    """Lists a gap if it is closed; returns the new number of contacts."""
    if not (gap[2] < 0.0) or count >= arena.contact.shape[1]:
        return count
    arena.contact[0, count, arena.index] = wp.vec4(gap[0], gap[1], gap[2], 0.0)
    arena.contact[1, count, arena.index] = wp.vec4(0.0, 0.0, float(first), float(second))
    return count + 1


@wp.func
def _from_box(place: wp.vec3, box: WarpBox, radius: float) -> wp.vec3:
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
def _from_disc(arena: WarpArena, i: int, j: int) -> wp.vec3:
    """Returns the unit vector from the second robot to the first, and their gap, m.

    Two hulls at the same place push each other along x, as in MuJoCo. The first is pushed towards
    negative x.
    """
    away = arena.place[i] - arena.place[j]
    apart = wp.length(wp.vec2(away[0], away[1]))
    along = wp.vec2(-1.0, 0.0)
    if apart > 0.0:
        along = wp.vec2(away[0] / apart, away[1] / apart)
    return wp.vec3(along[0], along[1], apart - 2.0 * arena.numbers[0])


@wp.func
def sides_of(held: wp.vec4) -> wp.vec2i:
    """Returns the robots of a contact, given its row 1."""
    return wp.vec2i(int(held[2]), int(held[3]))


@wp.func
def body_of(arena: WarpArena, sides: wp.vec2i) -> wp.vec3:
    """Returns the sum of `body` over both robots of a contact."""
    total = arena.body[sides[0]]
    if sides[1] >= 0:
        total = total + arena.body[sides[1]]
    return total


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
def give_at(weight: float, impedance: float) -> float:
    """Returns the softness R, 1 / kg: MuJoCo, "Solver parameters"."""
    return wp.max(weight * (1.0 - impedance) / impedance, 1.0e-15)  # mjMINVAL
