"""Contacts of the wheeled body on the GPU: Newton's method robot by robot, one thread a robot.

MuJoCo's convex problem for the accelerations a (MuJoCo's documentation, Computation, "Primal
problem"), with rows of pyramidal friction cones and of contacts that only push,

    minimise  1/2 (a - a0)' M (a - a0) + sum_i D_i / 2 min(0, J_i a - aref_i)^2,

falls into one of 8 unknowns for each robot that touches the floor, walls and obstacles alone: M
and those rows of J have entries of one robot each. MJX-Warp's Newton method takes all robots of an
arena together and factorises a matrix of 8 R rows at every iteration. Here only robots that touch
each other are taken together, and even their Hessian is one block of 8 x 8 a robot, and a term of
rank one for each contact between two, which the Woodbury identity takes out of the inverse (Golub
and Van Loan 2013, "Matrix Computations", 2.1.4).
"""

from typing import Any

import mujoco.mjx.third_party.mujoco_warp as mjw
import warp as wp

# Loops over joints are unrolled, which Warp does if their ends are constants or the count of a loop
# around them: only then does a matrix stay in registers. Functions get copies of their arguments.

NUMBER = -1  # what `opt.solver` says; MuJoCo has none of it
_ITERATIONS = 20  # of Newton's method, at most; six do where robots touch, 18 were seen
JOINTS = wp.constant(8)  # of a robot: free in space, and two wheels
_FREE = wp.constant(6)  # of these, free in space
_INERTIA = wp.constant(35)  # entries of a robot's M, without that of both wheels, which is 0
_SHARED = wp.constant(-2)  # instead of a wheel, in a row of two robots
# What `Problem.scaled` has after a row's entries.
_AREF = wp.constant(8)
_GAP = wp.constant(9)
_SLOPE = wp.constant(10)
# Threads of which one takes an arena: what 32 read each from its own place takes 32 turns.
_SPREAD = wp.constant(4)
_BLOCK = 64  # threads; each has much to do, and some much more: small blocks wait less
_GEOMS = 5  # of a robot: hull, two wheels, two skids
_SEARCHES = wp.constant(12)  # of a step's length
# Share of the slope at a step's beginning that counts for nothing: float32 rounds at 1e-7, and the
# grips of a robot are 1e3 times as stiff as its mass.
_FLAT = wp.constant(1e-4)
# Shares of the acceleration: a step that may be the last, and one that is nothing but rounding.
_SHORT = wp.constant(1e-2)
_ROUNDING = wp.constant(1e-5)
# Contacts between robots that are taken as terms of their own. More go into the robots' blocks,
# which makes for more and shorter steps: five robots have ten pairs, swarms of more get Newton's
# method (`physics.MOST_WHEELED`). As many as a robot's joints: one size of matrix serves both.
_PAIRS = wp.constant(8)


class _Vector(wp.types.vector(length=JOINTS, dtype=wp.float32)):
    """A number for each joint of a robot."""


class _Matrix(wp.types.matrix(shape=(JOINTS, JOINTS), dtype=wp.float32)):
    """A number for each two of them."""


def step(m: Any, d: Any) -> None:
    """Moves all arenas of wheeled robots on by one physics step (MuJoCo's semi-implicit Euler).

    Of what acts on bodies, `xfrc_applied` is left out: nothing here uses it.

    Args:
      m: Warp's model: robots of eight joints each, and no others; a sparse Jacobian.
      d: Warp's data of all arenas, written to; the forces of contacts are not.
    """
    mjw.fwd_position(m, d, factorize=False)
    mjw.fwd_velocity(m, d)
    mjw.fwd_actuation(m, d)
    robots = m.nv // JOINTS
    problem, together = _problem(m, d, robots), _together(m, d, robots)
    forces = [d.qfrc_applied, d.qfrc_bias, d.qfrc_passive, d.qfrc_actuator, d.qacc_warmstart]
    wp.launch(_begin, dim=(d.nworld, m.nv), inputs=[problem, *forces])
    together.crowded.zero_()
    d.solver_niter.zero_()
    wp.launch(_share_out, dim=(d.nworld, robots), inputs=[problem, together])
    most = min(m.opt.iterations, _ITERATIONS)
    wp.launch(_relax_each, dim=(d.nworld, robots), inputs=[problem, most], block_dim=_BLOCK)
    inputs = [problem, together, robots, most, d.solver_niter]
    wp.launch(_relax_pairs, dim=d.nworld * _SPREAD, inputs=inputs, block_dim=_BLOCK)
    mjw.euler(m, d)


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
      first: [A, N] of a row of two robots, the one with the higher number, and its `_entries`.
      second: [A, N] the other.
      own: [A, R] rows of a robot.
      row: [A, R, K] which they are, and its `_entries` in them.
      touches: [A, R] whether any is of another robot too.
      scaled: [K, 11, A R] times the root of D: its `_entries` in them and aref, and, as `_relax`
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
    factor: wp.array2d[_Matrix]
    response: wp.array3d[_Vector]


def _problem(m: Any, d: Any, robots: int) -> Any:
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
    problem.scaled = wp.empty((most, _SLOPE + 1, d.nworld * robots), dtype=float)
    return problem


def _most_rows(m: Any, robots: int) -> int:
    """Rows that a robot can have: 4 of each wheel, 1 of each skid, 1 of its hull with all else."""
    others = m.ngeom - 1 - _GEOMS * robots  # but the floor
    return 2 * 4 + 2 + robots - 1 + others


def _together(m: Any, d: Any, robots: int) -> Any:
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
    together.pair = wp.empty((arenas, _PAIRS), dtype=int)
    together.factor = wp.empty((arenas, robots), dtype=_Matrix)
    together.response = wp.empty((arenas, _PAIRS, 2), dtype=_Vector)
    return together


@wp.kernel(enable_backward=False)
def _begin(
    problem: Problem,
    applied: wp.array2d[float],
    bias: wp.array2d[float],
    passive: wp.array2d[float],
    actuator: wp.array2d[float],
    warmstart: wp.array2d[float],
) -> None:
    """Adds up what acts on a joint, and starts at the acceleration of the step before."""
    arena, dof = wp.tid()
    given = applied[arena, dof] - bias[arena, dof]
    problem.force[arena, dof] = given + passive[arena, dof] + actuator[arena, dof]
    problem.qacc[arena, dof] = warmstart[arena, dof]


@wp.kernel(enable_backward=False)
def _share_out(problem: Problem, together: Together) -> None:
    """Lists the rows of a robot, and, by its first robot, an arena in which any touch."""
    arena, robot = wp.tid()
    own = wp.int32(0)
    touches, crowded = wp.bool(False), wp.bool(False)
    for row in range(_count(problem, arena)):
        first, second = _sides(problem, arena, row)
        if robot == first[0] and second[0] >= 0:
            problem.first[arena, row] = first
            problem.second[arena, row] = second
        side = wp.where(robot == first[0], first, second)
        if robot == side[0]:
            problem.row[arena, robot, own] = wp.vec3i(row, side[1], side[2])
            own += 1
            touches = touches or second[0] >= 0
        crowded = crowded or second[0] >= 0
    problem.own[arena, robot] = own
    problem.touches[arena, robot] = touches
    if crowded and robot == 0:
        together.arena[wp.atomic_add(together.crowded, 0, 1)] = arena


@wp.func
def _count(problem: Problem, arena: int) -> int:
    """How many rows there are; of more than there is room for, the rest is left out."""
    return wp.min(problem.count[arena], problem.first.shape[1])


@wp.func
def _sides(problem: Problem, arena: int, row: int) -> tuple[wp.vec3i, wp.vec3i]:
    """The robots of a row and their `_entries` in it; of two, the higher number comes first.

    A row has the six entries of a body, after that of a wheel if it is a wheel's; or twelve.
    """
    first = problem.J_first[arena, row]
    joint = problem.J_column[arena, 0, first]
    robot, wheel = joint / JOINTS, wp.where(joint % JOINTS < _FREE, -1, joint % JOINTS)
    mine = wp.vec3i(robot, wp.where(wheel < 0, first, first + 1), wheel)
    other = wp.vec3i(-1, -1, -1)
    if problem.J_count[arena, row] > JOINTS:
        mine = wp.vec3i(robot, first, _SHARED)
        body = first + _FREE
        other = wp.vec3i(problem.J_column[arena, 0, body] / JOINTS, body, _SHARED)
    return mine, other


@wp.func
def _scale(problem: Problem, arena: int, robot: int, k: int) -> None:
    """Copies a robot's row to where neighbouring threads read it at once."""
    side = problem.row[arena, robot, k]
    root = wp.sqrt(problem.D[arena, side[0]])
    entries = root * _entries(problem, arena, side)
    lane = arena * problem.own.shape[1] + robot
    for i in range(8):
        problem.scaled[k, i, lane] = entries[i]
    problem.scaled[k, _AREF, lane] = root * problem.aref[arena, side[0]]


@wp.kernel(enable_backward=False)
def _relax_each(problem: Problem, iterations: int) -> None:
    """Finds the accelerations of a robot that touches no other."""
    arena, robot = wp.tid()
    if not problem.touches[arena, robot]:
        _relax(problem, arena, robot, iterations)


@wp.func
def _relax(problem: Problem, arena: int, robot: int, iterations: int) -> None:
    """Newton's method for a robot alone."""
    lane, own = arena * problem.own.shape[1] + robot, problem.own[arena, robot]
    # Not where rows are listed: there, neighbouring threads come to theirs one after the other.
    for k in range(own):
        _scale(problem, arena, robot, k)
    now = _of_robot(problem.qacc, arena, robot)
    done = wp.int32(0)
    moves = wp.bool(True)
    while moves and done < iterations:
        downhill = _newton(problem, arena, robot, now)
        moves = wp.bool(False)
        for k in range(own):
            slope = wp.dot(_scaled(problem, k, lane), downhill)
            problem.scaled[k, _SLOPE, lane] = slope
            moves = moves or _switches(problem.scaled[k, _GAP, lane], slope)
        length = wp.float32(1.0)
        if moves:
            length = _length(problem, arena, robot, now, downhill)
        moves = _goes_on(moves, wp.max(wp.abs(downhill)), wp.max(wp.abs(now)))
        now = now + length * downhill
        done += 1
    _set(problem.qacc, arena, robot, now)


@wp.func
def _newton(problem: Problem, arena: int, robot: int, now: _Vector) -> _Vector:
    """Newton's step, of the rows that act now."""
    lane = arena * problem.own.shape[1] + robot
    hessian = _inertia(problem, arena, robot)
    uphill = _times(hessian, now) - _of_robot(problem.force, arena, robot)
    for k in range(problem.own[arena, robot]):
        row = _scaled(problem, k, lane)
        gap = wp.dot(row, now) - problem.scaled[k, _AREF, lane]
        problem.scaled[k, _GAP, lane] = gap
        if gap < 0.0:
            uphill = uphill + gap * row
            hessian = _add(hessian, row, row)
    return _substitute(_factor(hessian), -uphill)


@wp.func
def _scaled(problem: Problem, k: int, lane: int) -> _Vector:
    """A robot's entries in a row of its own, times the root of D."""
    found = _Vector()
    for i in range(8):
        found[i] = problem.scaled[k, i, lane]
    return found


@wp.func
def _switches(gap: float, slope: float) -> bool:
    """Whether a row acts before a whole step and not after it, or the other way round.

    If none does, the cost is quadratic along the step, and its whole length the best.
    """
    return (gap < 0.0) != (gap + slope < 0.0)


@wp.func
def _goes_on(moves: bool, step: float, acceleration: float) -> bool:
    """Whether there is more to do: a long step leaves its rounding behind, a tiny one is that."""
    return (moves or step > _SHORT * acceleration) and step > _ROUNDING * acceleration


@wp.func
def _of_robot(of_joints: wp.array2d[float], arena: int, robot: int) -> _Vector:
    """What a robot has at its joints."""
    found = _Vector()
    for i in range(8):
        found[i] = of_joints[arena, robot * JOINTS + i]
    return found


@wp.func
def _set(of_joints: wp.array2d[float], arena: int, robot: int, numbers: _Vector) -> None:
    """Gives a robot's joints their numbers."""
    for i in range(8):
        of_joints[arena, robot * JOINTS + i] = numbers[i]


@wp.func
def _inertia(problem: Problem, arena: int, robot: int) -> _Matrix:
    """M of a robot, the lower half of it: MuJoCo keeps its rows one after the other."""
    found = _Matrix()
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
def _entries(problem: Problem, arena: int, side: wp.vec3i) -> _Vector:
    """A row's entries at a robot.

    Args:
      side: the robot or the row, which is not looked at; where the body's six entries are, which
        come from the last joint to the first; and which wheel's joint has the one before them.
    """
    found = _Vector()
    for i in range(6):
        found[i] = problem.J[arena, 0, side[1] + 5 - i]
    for wheel in range(6, 8):
        if side[2] == wheel:
            found[wheel] = problem.J[arena, 0, side[1] - 1]
    return found


@wp.func
def _times(matrix: _Matrix, vector: _Vector) -> _Vector:
    """Product with a symmetric matrix of which there is the lower half."""
    found = _Vector()
    for i in range(8):
        for j in range(i):
            found[i] = found[i] + matrix[i, j] * vector[j]
            found[j] = found[j] + matrix[i, j] * vector[i]
        found[i] = found[i] + matrix[i, i] * vector[i]
    return found


@wp.func
def _add(matrix: _Matrix, left: _Vector, right: _Vector) -> _Matrix:
    """The lower half of matrix + left right', which is symmetric."""
    for i in range(8):
        for j in range(i):
            matrix[i, j] = matrix[i, j] + left[i] * right[j]
        matrix[i, i] = matrix[i, i] + left[i] * right[i]
    return matrix


@wp.func
def _factor(matrix: _Matrix) -> _Matrix:
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
def _substitute(lower: _Matrix, right: _Vector) -> _Vector:
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
def _length(problem: Problem, arena: int, robot: int, now: _Vector, downhill: _Vector) -> float:
    """How far to go along a step: where the cost, which is convex along it, is least."""
    inertia = _inertia(problem, arena, robot)
    pull = _times(inertia, now) - _of_robot(problem.force, arena, robot)
    first, curve = wp.dot(pull, downhill), wp.dot(downhill, _times(inertia, downhill))
    begin = _tilt(problem, arena, robot, 0.0)[0] + first
    search = wp.vec3(0.0, 1e6, 1.0)
    for _ in range(_SEARCHES):
        bend = _tilt(problem, arena, robot, search[2])
        tilt = bend[0] + first + search[2] * curve
        if wp.abs(tilt) <= _FLAT * wp.abs(begin):
            break
        search = _narrow(search, tilt, bend[1] + curve)
    return search[2]


@wp.func
def _narrow(search: wp.vec3, tilt: float, curve: float) -> wp.vec3:
    """Too short a length, too long a one, and where to look next: by Newton, or halfway."""
    low = wp.where(tilt < 0.0, search[2], search[0])
    high = wp.where(tilt < 0.0, search[1], search[2])
    there = search[2] - tilt / curve
    return wp.vec3(low, high, wp.where(low < there and there < high, there, 0.5 * (low + high)))


@wp.func
def _tilt(problem: Problem, arena: int, robot: int, length: float) -> wp.vec2:
    """First and second derivative of the rows' cost along a step."""
    lane = arena * problem.own.shape[1] + robot
    tilt = wp.vec2()
    for k in range(problem.own[arena, robot]):
        slope = problem.scaled[k, _SLOPE, lane]
        there = problem.scaled[k, _GAP, lane] + length * slope
        if there < 0.0:
            tilt = tilt + slope * wp.vec2(there, slope)
    return tilt


@wp.kernel(enable_backward=False)
def _relax_pairs(
    problem: Problem, together: Together, robots: int, iterations: int, niter: wp.array[int]
) -> None:
    """Newton's method for the robots of an arena that touch each other."""
    turn = wp.tid() / _SPREAD
    if wp.tid() % _SPREAD == 0 and turn < together.crowded[0]:
        arena = together.arena[turn]
        _collect(problem, together, arena, robots)
        done = wp.int32(0)
        moves = wp.bool(True)
        while moves and done < iterations:
            _pick(problem, together, arena)
            for robot in range(robots):
                _descend(problem, together, arena, robot)
            _couple(problem, together, arena)
            moves = _take(problem, together, arena, robots)
            done += 1
        niter[arena] = done


@wp.func
def _collect(problem: Problem, together: Together, arena: int, robots: int) -> None:
    """Lists the rows between two robots."""
    count = wp.int32(0)
    for robot in range(robots):
        if problem.touches[arena, robot]:
            for k in range(problem.own[arena, robot]):
                side = problem.row[arena, robot, k]
                if side[2] == _SHARED and problem.first[arena, side[0]][0] == robot:
                    together.row[arena, count] = side[0]
                    count += 1
    together.count[arena] = count


@wp.func
def _along(problem: Problem, arena: int, row: int, of_joints: wp.array2d[float]) -> float:
    """A row of J between two robots times what their joints have."""
    first, second = problem.first[arena, row], problem.second[arena, row]
    found = wp.dot(_entries(problem, arena, first), _of_robot(of_joints, arena, first[0]))
    return found + wp.dot(_entries(problem, arena, second), _of_robot(of_joints, arena, second[0]))


@wp.func
def _pick(problem: Problem, together: Together, arena: int) -> None:
    """Finds out which rows between robots act, and which of those become terms of their own."""
    taken = wp.int32(0)
    for k in range(together.count[arena]):
        row = together.row[arena, k]
        gap = _along(problem, arena, row, problem.qacc) - problem.aref[arena, row]
        together.gap[arena, row] = gap
        together.slot[arena, row] = -1
        if gap < 0.0 and taken < _PAIRS:
            together.slot[arena, row] = taken
            together.pair[arena, taken] = row
            taken += 1
    together.taken[arena] = taken


@wp.func
def _descend(problem: Problem, together: Together, arena: int, robot: int) -> None:
    """Works out a robot's step as if its pairs' terms were not there, and its block's factor."""
    _set(together.step, arena, robot, _Vector())
    if problem.touches[arena, robot]:
        hessian = _inertia(problem, arena, robot)
        now = _of_robot(problem.qacc, arena, robot)
        uphill = _times(hessian, now) - _of_robot(problem.force, arena, robot)
        for k in range(problem.own[arena, robot]):
            side = problem.row[arena, robot, k]
            slope = _entries(problem, arena, side)
            if side[2] != _SHARED:
                gap = wp.dot(slope, now) - problem.aref[arena, side[0]]
                together.gap[arena, side[0]] = gap
                together.slot[arena, side[0]] = -1
            if together.gap[arena, side[0]] < 0.0:
                weighted = problem.D[arena, side[0]] * slope
                uphill = uphill + together.gap[arena, side[0]] * weighted
                if together.slot[arena, side[0]] < 0:
                    hessian = _add(hessian, weighted, slope)
        factor = _factor(hessian)
        together.factor[arena, robot] = factor
        _set(together.step, arena, robot, _substitute(factor, -uphill))


@wp.func
def _couple(problem: Problem, together: Together, arena: int) -> None:
    """Takes the pairs' terms into the step: Woodbury's identity."""
    taken = together.taken[arena]
    matrix = wp.identity(n=8, dtype=wp.float32) + _Matrix()
    right = _Vector()
    for i in range(taken):
        row = together.pair[arena, i]
        right[i] = _along(problem, arena, row, together.step)
        for side in range(2):
            mine = _side(problem, arena, row, side)
            factor = together.factor[arena, mine[0]]
            slope = _entries(problem, arena, mine)
            together.response[arena, i, side] = _substitute(factor, slope)
        matrix[i, i] = 1.0 / problem.D[arena, row]
    for i in range(taken):
        for j in range(i + 1):
            for sides in range(4):
                push = _overlap(problem, together, arena, i, j, sides)
                matrix[i, j] = matrix[i, j] + push
    force = _substitute(_factor(matrix), right)
    for i in range(taken):
        for side in range(2):
            robot = _side(problem, arena, together.pair[arena, i], side)[0]
            step = _of_robot(together.step, arena, robot)
            response = together.response[arena, i, side]
            _set(together.step, arena, robot, step - force[i] * response)


@wp.func
def _side(problem: Problem, arena: int, row: int, side: int) -> wp.vec3i:
    """The first or the second robot of a row, and its `_entries` there."""
    return wp.where(side == 0, problem.first[arena, row], problem.second[arena, row])


@wp.func
def _overlap(problem: Problem, together: Together, arena: int, i: int, j: int, sides: int) -> float:
    """What pair j brings about along pair i in the robot that is on these sides of both."""
    row = together.pair[arena, i]
    mine = _side(problem, arena, row, sides % 2)
    theirs = _side(problem, arena, together.pair[arena, j], sides // 2)
    if mine[0] != theirs[0]:
        return 0.0
    return wp.dot(_entries(problem, arena, mine), together.response[arena, j, sides // 2])


@wp.func
def _take(problem: Problem, together: Together, arena: int, robots: int) -> bool:
    """Takes the step; says whether another is needed."""
    switches = wp.bool(False)
    for k in range(together.count[arena]):
        row = together.row[arena, k]
        slope = _along(problem, arena, row, together.step)
        together.slope[arena, row] = slope
        switches = switches or _switches(together.gap[arena, row], slope)
    for robot in range(robots):
        if problem.touches[arena, robot]:
            switches = _slopes(problem, together, arena, robot) or switches
    length = wp.float32(1.0)
    if switches:
        length = _length_together(problem, together, arena, robots)
    largest, longest = wp.float32(0.0), wp.float32(0.0)
    for robot in range(robots):
        if problem.touches[arena, robot]:
            now = _of_robot(problem.qacc, arena, robot)
            step = _of_robot(together.step, arena, robot)
            largest = wp.max(largest, wp.max(wp.abs(now)))
            longest = wp.max(longest, wp.max(wp.abs(step)))
            _set(problem.qacc, arena, robot, now + length * step)
    return _goes_on(switches, longest, largest)


@wp.func
def _slopes(problem: Problem, together: Together, arena: int, robot: int) -> bool:
    """Works out J times the step for the rows of a robot alone; says whether any switches."""
    switches = wp.bool(False)
    step = _of_robot(together.step, arena, robot)
    for k in range(problem.own[arena, robot]):
        side = problem.row[arena, robot, k]
        if side[2] != _SHARED:
            slope = wp.dot(_entries(problem, arena, side), step)
            together.slope[arena, side[0]] = slope
            switches = switches or _switches(together.gap[arena, side[0]], slope)
    return switches


@wp.func
def _length_together(problem: Problem, together: Together, arena: int, robots: int) -> float:
    """How far to go along the step of all, as `_length` says of one."""
    first, curve = wp.float32(0.0), wp.float32(0.0)
    for robot in range(robots):
        if problem.touches[arena, robot]:
            inertia = _inertia(problem, arena, robot)
            step = _of_robot(together.step, arena, robot)
            now = _of_robot(problem.qacc, arena, robot)
            pull = _times(inertia, now) - _of_robot(problem.force, arena, robot)
            first += wp.dot(pull, step)
            curve += wp.dot(_times(inertia, step), step)
    begin = _tilt_together(problem, together, arena, robots, 0.0)[0] + first
    search = wp.vec3(0.0, 1e6, 1.0)
    for _ in range(_SEARCHES):
        bend = _tilt_together(problem, together, arena, robots, search[2])
        tilt = bend[0] + first + search[2] * curve
        if wp.abs(tilt) <= _FLAT * wp.abs(begin):
            break
        search = _narrow(search, tilt, bend[1] + curve)
    return search[2]


@wp.func
def _tilt_together(
    problem: Problem, together: Together, arena: int, robots: int, length: float
) -> wp.vec2:
    """First and second derivative of those robots' rows' cost along the step."""
    tilt = wp.vec2()
    for k in range(together.count[arena]):
        tilt = tilt + _tilt_of(problem, together, arena, together.row[arena, k], length)
    for robot in range(robots):
        if problem.touches[arena, robot]:
            for k in range(problem.own[arena, robot]):
                side = problem.row[arena, robot, k]
                if side[2] != _SHARED:
                    tilt = tilt + _tilt_of(problem, together, arena, side[0], length)
    return tilt


@wp.func
def _tilt_of(problem: Problem, together: Together, arena: int, row: int, length: float) -> wp.vec2:
    """First and second derivative of a row's cost along the step."""
    slope = together.slope[arena, row]
    push = wp.min(0.0, together.gap[arena, row] + length * slope)
    weight = wp.where(push < 0.0, problem.D[arena, row] * slope, 0.0)
    return weight * wp.vec2(push, slope)
