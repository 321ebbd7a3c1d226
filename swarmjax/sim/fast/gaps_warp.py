"""Lists the contacts of robots with each other, with obstacles and with walls, in Warp.

Several threads compare all pairs of an arena. For large swarms, one thread per
obstacle, wall and robot looks into the cells around it (`cells_warp`). Both ways list the same
contacts in the same order.
"""

# Warp's types know neither the arguments of a struct nor the argument `module`.
# pyright: reportCallIssue=false

import jax.numpy as jnp
import warp as wp
from jax import Array

from swarmjax.sim import model as sim_model
from swarmjax.sim.fast import cells_warp
from swarmjax.sim.fast import discs as sim_discs

# Edge of a cell, in radii of the hull. It is 5 % more than a hull's diameter, to allow for
# rounding.
CELL = wp.constant(2.1)
_DEEPEST = wp.constant(sim_discs.DEEPEST)
_WALLS = wp.constant(sim_model.WALLS)
_THICKNESS = wp.constant(sim_model.WALL_HALF_THICKNESS)
_LENGTH = wp.constant(sim_model.WALL_HALF_LENGTH)


def list_by_cells(
    shape: tuple[int, int, int],
    radius: float,
    place: Array,
    side: Array,
    obstacle: Array,
    numbers: Array,
) -> tuple[Array, Array]:
    """Lists the contacts of many arenas as `list_contacts` does, by looking into cells.

    Args:
      shape: N, K, A: the number of rows of `WarpArena.contact`, of contacts that fit into memory,
        and of arenas.
      radius: radius of the hulls, m.
      place: [A, R, 3] x (m), y (m), yaw (rad).
      side: [A] sides of the arenas, m.
      obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m).
      numbers: as in `WarpArena`.

    Returns:
      The number of contacts of each arena [A], which may be larger than K, and an array [N, K, A,
      4] as `WarpArena.contact`, with rows 0 and 1 filled in.
    """
    arenas, robots = place.shape[:2]
    owners, width = (arenas, obstacle.shape[1] + sim_model.WALLS + robots), CELL * radius
    call = wp.jax_kernel(_list_near, num_outputs=2, in_out_argnames=["count"])
    given = place, side, obstacle, numbers, *cells_warp.chain(place, width)

    def run(start: Array, shape: tuple[int, int, int]) -> tuple[Array, Array]:
        return call(*given, start, launch_dims=owners, output_dims={"contact": shape})

    count = run(jnp.ones(owners, jnp.int32), (2, 1, arenas))[0]  # counts only; stores no contact
    end = jnp.cumsum(count, axis=1)
    return end[:, -1], run(end - count, shape)[1]


@wp.struct
class WarpArena:
    """Arrays of one arena, which the arena's threads read and write.

    Attributes:
      place: [R] x (m), y (m), yaw (rad).
      rate: [R] rate of change of `place`, m/s, m/s, rad/s.
      free: [R] acceleration of `place` without contacts, m/s^2, m/s^2, rad/s^2.
      before: [R] acceleration of `place` in the previous step, m/s^2, m/s^2, rad/s^2.
      body: [R] 1 / mass, inverse weight, 1 / moment of inertia.
      side: side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      numbers: [11] radius of the hulls (m), stiffness (1/s^2) and damping (1/s) of contacts, the
        five numbers of `solimp`, friction, largest number of sweeps, number of threads per arena.
      contact: [N, K, A] N rows of four numbers for each contact, for all arenas. Row 0 holds x and
        y of the unit vector along which the contact pushes, and two numbers for the solver, the
        first of which is the gap (m) until the solver overwrites it. Row 1 holds two numbers for
        the solver, the robot that is pushed along the vector, and the robot that is pushed back, or
        -1 if the contact has only one robot. All other rows are for the solver.
      total: [R] acceleration of x, y and yaw under the current forces.
      island: [R] the first robot of each robot's island.
      after: [K, A] the contact that a thread solves next after each contact, for all arenas; -1
        after the last one.
      threads: number of threads of the arena.
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
    island: wp.array[int]
    after: wp.array2d[int]
    threads: int
    index: int


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    if (threads > 1) {
        unsigned first = threadIdx.x % 32 / threads * threads;
        __syncwarp();
        return (__ballot_sync(0xffffffffu, yes) >> first) & (0xffffffffu >> (32 - threads));
    }
#endif
    return yes;
""")
def vote(yes: bool, threads: int) -> wp.uint32:
    """Waits until all threads have written their results; returns a bit per thread of the arena."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
    return __any_sync(0xffffffffu, yes);
#else
    return yes;
#endif
""")
def any_votes(yes: bool) -> bool:
    """Waits as `vote` does; returns whether `yes` is true in any thread of the CUDA warp."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popc(bits);
#else
    return __builtin_popcount(bits);
#endif
""")
def ones(bits: wp.uint32) -> int:
    """Counts bits that are 1."""
    ...


@wp.func
def list_contacts(arena: WarpArena, thread: int) -> int:
    """Lists all contacts of an arena, by comparing all pairs; returns the number of contacts."""
    robots, fixtures = arena.place.shape[0], arena.obstacle.shape[0] + _WALLS
    gaps, before = robots * (fixtures + robots), (wp.uint32(1) << wp.uint32(thread)) - wp.uint32(1)
    count, owner, robot = wp.int32(0), wp.int32(thread // robots), wp.int32(thread % robots)
    box = _box_of(arena, owner % (fixtures + robots), 0.0)
    for start in range(0, gaps, arena.threads):
        gap = wp.vec3(0.0, 0.0, 1.0)
        if start + thread < gaps:
            gap = _gap_to(arena, box, owner - fixtures, robot)
        closed = vote(gap[2] < 0.0, arena.threads)
        if gap[2] < 0.0:
            _list_gap(arena, count + ones(closed & before), gap, owner - fixtures, robot)
        count += ones(closed)
        robot += arena.threads
        if robot >= robots:
            owner += robot // robots
            robot = robot % robots
            box = _box_of(arena, owner % (fixtures + robots), 0.0)
    return wp.min(count, arena.contact.shape[1])


@wp.struct
class WarpBox:
    """A rectangle: its centre (m), the cosine and sine of its yaw, and its half edges (m)."""

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
    """Lists the contacts of an obstacle, wall or robot (the owner), from index `count` on.

    Sets `count` to the number of these contacts. If the owner is a robot, only contacts with robots
    of a higher index are listed, so that each contact is listed once.
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
    columns = cells_warp.cells_around(box.x, reach_x, width, across)
    rows = cells_warp.cells_around(box.y, reach_y, width, across)
    known = wp.int32(0)
    for column in range(columns[0], columns[1]):
        for row in range(rows[0], rows[1]):
            robot = wp.int32(first[i, column & (across - 1), row & (across - 1)])
            while robot >= 0:
                known = _list_robot(arena, start, known, box, owner - fixtures, robot)
                robot = after[i, robot]
    count[i, owner] = known


@wp.func
def _list_robot(
    arena: WarpArena, start: int, count: int, box: WarpBox, owner: int, robot: int
) -> int:
    """Lists a robot's contact, if any, with the robot `owner`, or with a box if `owner` < 0.

    The contacts from `start` on are sorted by the index of the robot. Returns their new number.
    """
    gap = _gap_to(arena, box, owner, robot)
    if not (gap[2] < 0.0):
        return count
    k = start + count
    if k < arena.contact.shape[1]:
        while k > start and _last_robot(arena, k - 1) > robot:
            arena.contact[0, k, arena.index] = arena.contact[0, k - 1, arena.index]
            arena.contact[1, k, arena.index] = arena.contact[1, k - 1, arena.index]
            k -= 1
        _list_gap(arena, k, gap, owner, robot)
    return count + 1


@wp.func
def _gap_to(arena: WarpArena, box: WarpBox, owner: int, robot: int) -> wp.vec3:
    """Returns a robot's gap to the robot `owner` before it, or to a box if `owner` is negative."""
    if owner < 0:
        return _from_box(arena.place[robot], box, arena.numbers[0])
    if owner < robot:
        return _from_disc(arena, owner, robot)
    return wp.vec3(0.0, 0.0, 1.0)


@wp.func
def _last_robot(arena: WarpArena, k: int) -> int:
    """Returns the higher of the indices of a contact's robots."""
    sides = sides_of(arena.contact[1, k, arena.index])
    return wp.max(sides[0], sides[1])


@wp.func
def _box_of(arena: WarpArena, owner: int, width: float) -> WarpBox:
    """Returns an owner's box: an obstacle, a wall, or a square of this width around a robot."""
    obstacles = arena.obstacle.shape[0]
    if owner < obstacles:
        return _obstacle_box(arena, owner)
    if owner < obstacles + _WALLS:
        return _wall_box(arena.side, owner - obstacles)
    place = arena.place[owner - obstacles - _WALLS]
    return WarpBox(place[0], place[1], 1.0, 0.0, 0.5 * width, 0.5 * width)


@wp.func
def _obstacle_box(arena: WarpArena, m: int) -> WarpBox:
    """Returns the box of an obstacle."""
    x, y, yaw = arena.obstacle[m, 0], arena.obstacle[m, 1], arena.obstacle[m, 2]
    return WarpBox(x, y, wp.cos(yaw), wp.sin(yaw), arena.obstacle[m, 3], arena.obstacle[m, 4])


@wp.func
def _wall_box(side: float, k: int) -> WarpBox:
    """Returns the box of the east, north, west or south wall (`model.fixture_rectangles`)."""
    cos = wp.where(k % 2 == 1, 0.0, wp.where(k == 0, 1.0, -1.0))
    sin = wp.where(k % 2 == 0, 0.0, wp.where(k == 1, 1.0, -1.0))
    away = 0.5 * side + _THICKNESS
    return WarpBox(away * cos, away * sin, cos, sin, _THICKNESS, _LENGTH)


@wp.func
def _list_gap(arena: WarpArena, k: int, gap: wp.vec3, owner: int, robot: int) -> None:
    """Stores a robot's contact with the robot `owner`, or with a box if `owner` is negative."""
    if k < arena.contact.shape[1]:
        first, second = wp.where(owner < 0, robot, owner), wp.where(owner < 0, -1, robot)
        arena.contact[0, k, arena.index] = wp.vec4(gap[0], gap[1], gap[2], 0.0)
        arena.contact[1, k, arena.index] = wp.vec4(0.0, 0.0, float(first), float(second))


@wp.func
def _from_box(place: wp.vec3, box: WarpBox, radius: float) -> wp.vec3:
    """Returns x and y of the unit vector from a box to a robot, and their gap (m).

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

    Two hulls at the same place push each other along x, as in MuJoCo; the first robot is pushed
    towards negative x.
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
