"""The convex problem of wheeled robots' contacts, as `wheeled_warp` and `wheeled_pairs` solve it.

Loops over joints are unrolled, which Warp does if their ends are constants or the count of a loop
around them: only then does a matrix stay in registers. Functions get copies of their arguments.
"""

from typing import Any

import warp as wp

JOINTS = wp.constant(8)  # of a robot: free in space, and two wheels
FREE = wp.constant(6)  # of these, free in space
_INERTIA = wp.constant(35)  # entries of a robot's M, without that of both wheels, which is 0
SHARED = wp.constant(-2)  # instead of a wheel, in a row of two robots
# What `Problem.scaled` has after a row's entries.
AREF = wp.constant(8)
GAP = wp.constant(9)
SLOPE = wp.constant(10)
_GEOMS = 5  # of a robot: hull, two wheels, two skids
SEARCHES = wp.constant(12)  # of a step's length
# Share of the slope at a step's beginning that counts for nothing: float32 rounds at 1e-7, and the
# grips of a robot are 1e3 times as stiff as its mass.
FLAT = wp.constant(1e-4)
# Shares of the acceleration: a step that may be the last, and one that is nothing but rounding.
_SHORT = wp.constant(1e-2)
_ROUNDING = wp.constant(1e-5)
# Contacts between robots that are taken as terms of their own. More go into the robots' blocks,
# which makes for more and shorter steps: five robots have ten pairs, swarms of more get Newton's
# method (`dispatch.MOST_WHEELED`). As many as a robot's joints: one size of matrix serves both.
PAIRS = wp.constant(8)


class Vector(wp.types.vector(length=JOINTS, dtype=wp.float32)):
    """A number for each joint of a robot."""


class Matrix(wp.types.matrix(shape=(JOINTS, JOINTS), dtype=wp.float32)):
    """A number for each two of them."""


@wp.struct
class Problem:
    """The problem of all arenas.

    Attributes:
      force: [A, V] what acts on the joints but contacts, M a0.
      qacc: [A, V] accelerations.
      M: [A, C] inertia matrices, `_INERTIA` entries a robot.
      count: [A] rows of the Jacobian.
      J: [A, 1, E] Jacobians; a row has `J_count` entries from `J_first` on, of joints that go down.
      J_first: [A, N].
      J_count: [A, N].
      J_column: [A, 1, E].
      D: [A, N] weight of a row.
      aref: [A, N] acceleration that it asks for.
      first: [A, N] of a row of two robots, the one with the higher number, and its `entries_of`.
      second: [A, N] the other.
      own: [A, R] rows of a robot.
      row: [A, R, K] which they are, and its `entries_of` in them.
      touches: [A, R] whether any is of another robot too.
      scaled: [K, 11, A R] times the root of D: its `entries_of` in them and aref, and, as `_relax`
        goes, J a - aref and J times the step. What threads read at once lies side by side.
    """

    force: wp.array2d[float]
    qacc: wp.array2d[float]
    M: wp.array2d[float]
    count: wp.array[int]
    J: wp.array3d[float]
    J_first: wp.array2d[int]
    J_count: wp.array2d[int]
    J_column: wp.array3d[int]
    D: wp.array2d[float]
    aref: wp.array2d[float]
    first: wp.array2d[wp.vec3i]
    second: wp.array2d[wp.vec3i]
    own: wp.array2d[int]
    row: wp.array3d[wp.vec3i]
    touches: wp.array2d[bool]
    scaled: wp.array3d[float]


@wp.struct
class Together:
    """What is worked out for robots that touch each other.

    Attributes:
      crowded: [1] how many arenas have any.
      arena: [A] which they are.
      count: [A] rows between two robots.
      row: [A, N] which they are.
      step: [A, V] Newton's; 0 of all other robots.
      gap: [A, N] J a - aref: a row acts below 0.
      slope: [A, N] J times the step.
      slot: [A, N] which of the terms of their own a row is; -1: none.
      taken: [A] how many there are.
      pair: [A, P] the rows that they are.
      factor: [A, R] Cholesky's, of a robot's block.
      response: [A, P, 2] what a unit of the force of a pair's contact brings about in either robot.
    """

    crowded: wp.array[int]
    arena: wp.array[int]
    count: wp.array[int]
    row: wp.array2d[int]
    step: wp.array2d[float]
    gap: wp.array2d[float]
    slope: wp.array2d[float]
    slot: wp.array2d[int]
    taken: wp.array[int]
    pair: wp.array2d[int]
    factor: wp.array2d[Matrix]
    response: wp.array3d[Vector]


def gather(m: Any, d: Any, robots: int) -> Any:
    """Gathers the problem; what it lists is not filled in yet."""
    problem = Problem()
    problem.force = wp.empty((d.nworld, m.nv), dtype=float)
    problem.qacc, problem.M = d.qacc, d.M
    problem.count, problem.J, problem.D, problem.aref = d.nefc, d.efc.J, d.efc.D, d.efc.aref
    problem.J_first, problem.J_count = d.efc.J_rowadr, d.efc.J_rownnz
    problem.J_column = d.efc.J_colind
    problem.first = wp.empty((d.nworld, d.njmax), dtype=wp.vec3i)
    problem.second = wp.empty((d.nworld, d.njmax), dtype=wp.vec3i)
    problem.own = wp.empty((d.nworld, robots), dtype=int)
    most = _most_rows(m, robots)
    problem.row = wp.empty((d.nworld, robots, most), dtype=wp.vec3i)
    problem.touches = wp.empty((d.nworld, robots), dtype=bool)
    problem.scaled = wp.empty((most, SLOPE + 1, d.nworld * robots), dtype=float)
    return problem


def _most_rows(m: Any, robots: int) -> int:
    """Rows that a robot can have: 4 of each wheel, 1 of each skid, 1 of its hull with all else."""
    others = m.ngeom - 1 - _GEOMS * robots  # but the floor
    return 2 * 4 + 2 + robots - 1 + others


def make_room(m: Any, d: Any, robots: int) -> Any:
    """Makes room for what is worked out for robots that touch each other."""
    arenas, together = d.nworld, Together()
    together.crowded = wp.empty(1, dtype=int)
    together.arena = wp.empty(arenas, dtype=int)
    together.count = wp.empty(arenas, dtype=int)
    together.row = wp.empty((arenas, d.njmax), dtype=int)
    together.step = wp.empty((arenas, m.nv), dtype=float)
    together.gap = wp.empty((arenas, d.njmax), dtype=float)
    together.slope = wp.empty((arenas, d.njmax), dtype=float)
    together.slot = wp.empty((arenas, d.njmax), dtype=int)
    together.taken = wp.empty(arenas, dtype=int)
    together.pair = wp.empty((arenas, PAIRS), dtype=int)
    together.factor = wp.empty((arenas, robots), dtype=Matrix)
    together.response = wp.empty((arenas, PAIRS, 2), dtype=Vector)
    return together


@wp.func
def does_switch(gap: float, slope: float) -> bool:
    """Whether a row acts before a whole step and not after it, or the other way round.

    If none does, the cost is quadratic along the step, and its whole length the best.
    """
    return (gap < 0.0) != (gap + slope < 0.0)


@wp.func
def goes_on(moves: bool, step: float, acceleration: float) -> bool:
    """Whether there is more to do: a long step leaves its rounding behind, a tiny one is that."""
    return (moves or step > _SHORT * acceleration) and step > _ROUNDING * acceleration


@wp.func
def of_robot(of_joints: wp.array2d[float], arena: int, robot: int) -> Vector:
    """What a robot has at its joints."""
    found = Vector()
    for i in range(8):
        found[i] = of_joints[arena, robot * JOINTS + i]
    return found


@wp.func
def put_robot(of_joints: wp.array2d[float], arena: int, robot: int, numbers: Vector) -> None:
    """Gives a robot's joints their numbers."""
    for i in range(8):
        of_joints[arena, robot * JOINTS + i] = numbers[i]


@wp.func
def inertia_of(problem: Problem, arena: int, robot: int) -> Matrix:
    """M of a robot, the lower half of it: MuJoCo keeps its rows one after the other."""
    found = Matrix()
    entry = robot * _INERTIA
    for i in range(6):
        for j in range(i):
            found[i, j] = problem.M[arena, entry]
            entry += 1
        found[i, i] = problem.M[arena, entry]
        entry += 1
    for wheel in range(6, 8):
        for j in range(6):
            found[wheel, j] = problem.M[arena, entry]
            entry += 1
        found[wheel, wheel] = problem.M[arena, entry]
        entry += 1
    return found


@wp.func
def entries_of(problem: Problem, arena: int, side: wp.vec3i) -> Vector:
    """A row's entries at a robot.

    Args:
      side: the robot or the row, which is not looked at; where the body's six entries are, which
        come from the last joint to the first; and which wheel's joint has the one before them.
    """
    found = Vector()
    for i in range(6):
        found[i] = problem.J[arena, 0, side[1] + 5 - i]
    for wheel in range(6, 8):
        if side[2] == wheel:
            found[wheel] = problem.J[arena, 0, side[1] - 1]
    return found


@wp.func
def times(matrix: Matrix, vector: Vector) -> Vector:
    """Product with a symmetric matrix of which there is the lower half."""
    found = Vector()
    for i in range(8):
        for j in range(i):
            found[i] = found[i] + matrix[i, j] * vector[j]
            found[j] = found[j] + matrix[i, j] * vector[i]
        found[i] = found[i] + matrix[i, i] * vector[i]
    return found


@wp.func
def add(matrix: Matrix, left: Vector, right: Vector) -> Matrix:
    """The lower half of matrix + left right', which is symmetric."""
    for i in range(8):
        for j in range(i):
            matrix[i, j] = matrix[i, j] + left[i] * right[j]
        matrix[i, i] = matrix[i, i] + left[i] * right[i]
    return matrix


@wp.func
def factor_of(matrix: Matrix) -> Matrix:
    """Cholesky's L of a positive definite matrix L L' of which there is the lower half."""
    for i in range(8):
        for j in range(i):
            for k in range(j):
                matrix[i, j] = matrix[i, j] - matrix[i, k] * matrix[j, k]
            matrix[i, j] = matrix[i, j] / matrix[j, j]
            matrix[i, i] = matrix[i, i] - matrix[i, j] * matrix[i, j]
        matrix[i, i] = wp.sqrt(matrix[i, i])
    return matrix


@wp.func
def substitute(lower: Matrix, right: Vector) -> Vector:
    """Solves L L' x = right."""
    for i in range(8):
        for j in range(i):
            right[i] = right[i] - lower[i, j] * right[j]
        right[i] = right[i] / lower[i, i]
    for i in range(7, -1, -1):
        right[i] = right[i] / lower[i, i]
        for j in range(i):
            right[j] = right[j] - lower[i, j] * right[i]
    return right


@wp.func
def narrow(search: wp.vec3, tilt: float, curve: float) -> wp.vec3:
    """Too short a length, too long a one, and where to look next: by Newton, or halfway."""
    low = wp.where(tilt < 0.0, search[2], search[0])
    high = wp.where(tilt < 0.0, search[1], search[2])
    there = search[2] - tilt / curve
    return wp.vec3(low, high, wp.where(low < there and there < high, there, 0.5 * (low + high)))
