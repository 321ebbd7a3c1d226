"""Arrays and functions of the contact problem of wheeled robots (see `wheeled_warp`).

Loops over joints have constant bounds, or a bound that is the counter of an enclosing loop. Warp
unrolls such loops, and only then do matrices stay in registers. Functions get copies of their
arguments, so a function that changes a matrix does not change its caller's matrix.
"""

from typing import Any

import warp as wp

JOINTS = wp.constant(8)  # degrees of freedom of a robot: six of the free body, and two wheels
FREE = wp.constant(6)  # degrees of freedom of the free body alone
_INERTIA = wp.constant(35)  # entries of a robot's M, without the zero between both wheels
SHARED = wp.constant(-2)  # third number of a `side` (see `entries_of`) in a row of two robots
# Indices in `Problem.scaled` of the numbers that follow the eight entries of a row.
AREF = wp.constant(8)
GAP = wp.constant(9)
SLOPE = wp.constant(10)
_GEOMS = 5  # geoms of a robot: hull, two wheels, two skids
SEARCHES = wp.constant(12)  # largest number of trials for a step's length
# In the search for a step's length, slopes of the cost below this share of the initial slope count
# as zero. float32 rounds at 1e-7, and the cost of wheel contacts is 1e3 times as steep as that of
# the robot's mass.
FLAT = wp.constant(1e-4)
# Limits of a step's size, as shares of the acceleration. A step below `_SHORT` may be the last
# step; a step below `_ROUNDING` is only rounding.
_SHORT = wp.constant(1e-2)
_ROUNDING = wp.constant(1e-5)


class Vector(wp.types.vector(length=JOINTS, dtype=wp.float32)):
    """One number for each joint of a robot."""


class Matrix(wp.types.matrix(shape=(JOINTS, JOINTS), dtype=wp.float32)):
    """One number for each pair of joints of a robot."""


@wp.struct
class Problem:
    """The contact problem of all arenas; a row is one row of the Jacobian, and of its arrays.

    Attributes:
      force: [A, V] sum of all forces on the joints except contact forces, M a0.
      qacc: [A, V] accelerations.
      M: [A, C] inertia matrices, `_INERTIA` entries per robot.
      count: [A] number of rows of the Jacobian.
      J: [A, 1, E] entries of the sparse Jacobians. A row has `J_count` entries from index `J_first`
        on, from the last joint to the first.
      J_first: [A, N] index of a row's first entry.
      J_count: [A, N] how many entries a row has.
      J_column: [A, 1, E] joint to which an entry belongs.
      D: [A, N] weight of a row.
      aref: [A, N] acceleration that a row demands.
      first: [A, N] the argument `side` of `entries_of` for a row's robot. If a row has two robots,
        this is for the robot with the higher index.
      second: [A, N] the argument `side` for the other robot; -1 for none.
      own: [A, R] number of rows that involve a robot.
      row: [A, R, K] the indices of these rows, and where the robot's entries are in them: the
        argument `side` of `entries_of`, with the index of the row as its first number.
      touches: [A, R] whether any of a robot's rows also involves another robot.
      scaled: [K, 11, A R] eleven numbers of each row, multiplied by the square root of D: the
        robot's eight entries and aref, and in Newton's method also J a - aref and J times the
        step. The last axis is arena and robot, so that threads read adjacent values at the same
        time.
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
    """Work arrays for the joint solution of robots that touch each other.

    Attributes:
      crowded: [1] number of arenas in which robots touch each other.
      arena: [A] indices of these arenas; only the first `crowded` entries are used.
      step: [A, V] Newton's step. Arrays [A, V] are set only for robots that touch another robot.
      rest: [A, V] what the step leaves of the cost's slope.
      way: [A, V] direction of the next step of conjugate gradients.
      bend: [A, V] the Hessian times `way`; then `rest` divided by the robots' blocks.
      factor: [A, R] Cholesky factor of a robot's block.
    """

    crowded: wp.array[int]
    arena: wp.array[int]
    step: wp.array2d[float]
    rest: wp.array2d[float]
    way: wp.array2d[float]
    bend: wp.array2d[float]
    factor: wp.array2d[Matrix]


def gather(m: Any, d: Any, robots: int) -> Any:
    """Gathers the problem from Warp's model and data; `wheeled_warp` fills in the lists of rows."""
    problem = Problem()
    problem.force = wp.empty((d.nworld, m.nv), dtype=float)
    problem.qacc, problem.M = d.qacc, d.M
    problem.count, problem.J, problem.D, problem.aref = d.nefc, d.efc.J, d.efc.D, d.efc.aref
    problem.J_first, problem.J_count = d.efc.J_rowadr, d.efc.J_rownnz
    problem.J_column = d.efc.J_colind
    rows = d.nworld, d.njmax
    problem.first, problem.second = wp.empty(rows, dtype=wp.vec3i), wp.empty(rows, dtype=wp.vec3i)
    problem.own = wp.empty((d.nworld, robots), dtype=int)
    # Largest number of a robot's rows: 4 per wheel, 1 per skid, and 1 per object (other than the
    # floor) that its hull may touch.
    others = m.ngeom - 1 - _GEOMS * robots
    most = 2 * 4 + 2 + robots - 1 + others
    problem.row = wp.empty((d.nworld, robots, most), dtype=wp.vec3i)
    problem.touches = wp.empty((d.nworld, robots), dtype=bool)
    problem.scaled = wp.empty((most, SLOPE + 1, d.nworld * robots), dtype=float)
    return problem


def make_room(m: Any, d: Any, robots: int) -> Any:
    """Allocates the work arrays for robots that touch each other."""
    together, joints = Together(), (d.nworld, m.nv)
    together.crowded, together.arena = wp.empty(1, dtype=int), wp.empty(d.nworld, dtype=int)
    together.step, together.rest = wp.empty(joints, dtype=float), wp.empty(joints, dtype=float)
    together.way, together.bend = wp.empty(joints, dtype=float), wp.empty(joints, dtype=float)
    together.factor = wp.empty((d.nworld, robots), dtype=Matrix)
    return together


@wp.func
def does_switch(gap: float, slope: float) -> bool:
    """Returns whether a row becomes active or inactive in a whole step.

    If no row switches, the cost is quadratic along the step, and the whole step is best.
    """
    return (gap < 0.0) != (gap + slope < 0.0)


@wp.func
def goes_on(moves: bool, step: float, acceleration: float) -> bool:
    """Returns whether Newton's method should take another step.

    After a long step, another one is needed to remove rounding errors. A tiny step is only
    rounding.
    """
    return (moves or step > _SHORT * acceleration) and step > _ROUNDING * acceleration


@wp.func
def of_robot(of_joints: wp.array2d[float], arena: int, robot: int) -> Vector:
    """Returns the robot's eight values in an array that has one value per joint."""
    found = Vector()
    for i in range(8):
        found[i] = of_joints[arena, robot * JOINTS + i]
    return found


@wp.func
def put_robot(of_joints: wp.array2d[float], arena: int, robot: int, numbers: Vector) -> None:
    """Sets the robot's eight values in an array that has one value per joint."""
    for i in range(8):
        of_joints[arena, robot * JOINTS + i] = numbers[i]


@wp.func
def inertia_of(problem: Problem, arena: int, robot: int) -> Matrix:
    """Returns the lower half of a robot's inertia matrix, which MuJoCo stores row by row."""
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
    """Returns a row's entries for one robot.

    Args:
      problem: the problem.
      arena: index of the arena.
      side: three numbers. The first number is the index of the robot or of the row, and is not read
        here. The second number is the place of the body's six entries, which are stored from the
        last joint to the first. The third number is the wheel with an entry before those six
        entries.
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
    """Multiplies a symmetric matrix, given as its lower half, by a vector."""
    found = Vector()
    for i in range(8):
        for j in range(i):
            found[i] = found[i] + matrix[i, j] * vector[j]
            found[j] = found[j] + matrix[i, j] * vector[i]
        found[i] = found[i] + matrix[i, i] * vector[i]
    return found


@wp.func
def add(matrix: Matrix, left: Vector, right: Vector) -> Matrix:
    """Returns the lower half of matrix + left right', which is symmetric."""
    for i in range(8):
        for j in range(i):
            matrix[i, j] = matrix[i, j] + left[i] * right[j]
        matrix[i, i] = matrix[i, i] + left[i] * right[i]
    return matrix


@wp.func
def factor_of(matrix: Matrix) -> Matrix:
    """Returns the Cholesky factor L of a positive definite matrix L L', given as its lower half."""
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
    """Narrows a range of step lengths; returns its two ends and the next length to try."""
    low = wp.where(tilt < 0.0, search[2], search[0])
    high = wp.where(tilt < 0.0, search[1], search[2])
    there = search[2] - tilt / curve
    return wp.vec3(low, high, wp.where(low < there and there < high, there, 0.5 * (low + high)))


@wp.func
def index_of(problem: Problem, arena: int, robot: int) -> int:
    """Returns a robot's index on the last axis of `Problem.scaled`."""
    return arena * problem.own.shape[1] + robot


@wp.func
def scaled(problem: Problem, k: int, index: int) -> Vector:
    """Returns a robot's entries in one of its rows, times the square root of D."""
    found = Vector()
    for i in range(8):
        found[i] = problem.scaled[k, i, index]
    return found


@wp.func
def tilt_of(problem: Problem, k: int, index: int, length: float) -> wp.vec2:
    """Returns the first and second derivative of the cost of a robot's row along a step."""
    slope = problem.scaled[k, SLOPE, index]
    there = wp.min(0.0, problem.scaled[k, GAP, index] + length * slope)
    return slope * wp.vec2(there, wp.where(there < 0.0, slope, 0.0))
