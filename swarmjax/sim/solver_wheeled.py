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

# A sum with nothing, below, is a copy: names in Warp are references, and what is changed in a loop
# would change what it was called before.

NUMBER = -1  # what `opt.solver` says; MuJoCo has none of it
_ITERATIONS = 20  # of Newton's method, at most; two or three do, thirteen were seen
JOINTS = wp.constant(8)  # of a robot: free in space, and two wheels
# Rows of a robot: 4 of each wheel, 1 of each skid, and contacts of its hull.
MOST_ROWS = wp.constant(24)
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


class _Rows(wp.types.vector(length=MOST_ROWS, dtype=wp.float32)):
    """A number for each row of a robot."""


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
    problem = _problem(m, d, robots)
    forces = [d.qfrc_applied, d.qfrc_bias, d.qfrc_passive, d.qfrc_actuator, d.qacc_warmstart]
    wp.launch(_begin, dim=(d.nworld, m.nv), inputs=[problem, *forces])
    wp.launch(_share_out, dim=d.nworld, inputs=[problem, _sides(m, d), robots])
    most = min(m.opt.iterations, _ITERATIONS)
    wp.launch(_relax_each, dim=(d.nworld, robots), inputs=[problem, most])
    together = _together(m, d, robots)
    wp.launch(_relax_pairs, dim=d.nworld, inputs=[problem, together, robots, most, d.solver_niter])
    mjw.euler(m, d)


@wp.struct
class Problem:
    """The problem of all arenas.

    Attributes:
      force: [A, V] what acts on the joints but contacts, M a0.
      qacc: [A, V] accelerations.
      M: [A, C] inertia matrices; a row has `M_count` entries from `M_first` on.
      M_first: [V].
      M_count: [V].
      M_column: [C].
      count: [A] rows of the Jacobian.
      J: [A, 1, E] Jacobians; a row has `J_count` entries from `J_first` on.
      J_first: [A, N].
      J_count: [A, N].
      J_column: [A, 1, E].
      D: [A, N] weight of a row.
      aref: [A, N] acceleration that it asks for.
      first: [A, N] a robot of a row; -1: none.
      second: [A, N] the other.
      own: [A, R] rows of a robot.
      row: [A, R, K] which they are.
      touches: [A, R] whether any is of another robot too.
    """

    force: wp.array2d[float]
    qacc: wp.array2d[float]
    M: wp.array2d[float]
    M_first: wp.array[int]
    M_count: wp.array[int]
    M_column: wp.array[int]
    count: wp.array[int]
    J: wp.array3d[float]
    J_first: wp.array2d[int]
    J_count: wp.array2d[int]
    J_column: wp.array3d[int]
    D: wp.array2d[float]
    aref: wp.array2d[float]
    first: wp.array2d[int]
    second: wp.array2d[int]
    own: wp.array2d[int]
    row: wp.array3d[int]
    touches: wp.array2d[bool]


@wp.struct
class Together:
    """What is worked out for robots that touch each other.

    Attributes:
      step: [A, V] Newton's; 0 of all other robots.
      gap: [A, N] J a - aref: a row acts below 0.
      slope: [A, N] J times the step.
      slot: [A, N] which of the terms of their own a row is; -1: none.
      taken: [A] how many there are.
      pair: [A, P] the rows that they are.
      factor: [A, R] Cholesky's, of a robot's block.
      response: [A, P, 2] what a unit of the force of a pair's contact brings about in either robot.
    """

    step: wp.array2d[float]
    gap: wp.array2d[float]
    slope: wp.array2d[float]
    slot: wp.array2d[int]
    taken: wp.array[int]
    pair: wp.array2d[int]
    factor: wp.array2d[_Matrix]
    response: wp.array3d[_Vector]


@wp.struct
class Sides:
    """What contacts are between.

    Attributes:
      contact: [A, N] which of all contacts a row is of.
      geom: [C] the two geoms of each contact of all arenas.
      body: [G] of a geom.
      root: [B] the body that carries a body.
      joint: [B] the first joint of a body; -1 of what stands.
    """

    contact: wp.array2d[int]
    geom: wp.array[wp.vec2i]
    body: wp.array[int]
    root: wp.array[int]
    joint: wp.array[int]


def _problem(m: Any, d: Any, robots: int) -> Any:
    """Gathers the problem; what it lists is not filled in yet."""
    problem = Problem()
    problem.force = wp.empty((d.nworld, m.nv), dtype=float)
    problem.qacc, problem.M = d.qacc, d.M
    problem.M_first, problem.M_count, problem.M_column = m.M_rowadr, m.M_rownnz, m.M_colind
    problem.count, problem.J, problem.D, problem.aref = d.nefc, d.efc.J, d.efc.D, d.efc.aref
    problem.J_first, problem.J_count = d.efc.J_rowadr, d.efc.J_rownnz
    problem.J_column = d.efc.J_colind
    problem.first = wp.empty((d.nworld, d.njmax), dtype=int)
    problem.second = wp.empty((d.nworld, d.njmax), dtype=int)
    problem.own = wp.empty((d.nworld, robots), dtype=int)
    problem.row = wp.empty((d.nworld, robots, MOST_ROWS), dtype=int)
    problem.touches = wp.empty((d.nworld, robots), dtype=bool)
    return problem


def _together(m: Any, d: Any, robots: int) -> Any:
    """Makes room for what is worked out for robots that touch each other."""
    arenas, together = d.nworld, Together()
    together.step = wp.empty((arenas, m.nv), dtype=float)
    together.gap = wp.empty((arenas, d.njmax), dtype=float)
    together.slope = wp.empty((arenas, d.njmax), dtype=float)
    together.slot = wp.empty((arenas, d.njmax), dtype=int)
    together.taken = wp.empty(arenas, dtype=int)
    together.pair = wp.empty((arenas, _PAIRS), dtype=int)
    together.factor = wp.empty((arenas, robots), dtype=_Matrix)
    together.response = wp.empty((arenas, _PAIRS, 2), dtype=_Vector)
    return together


def _sides(m: Any, d: Any) -> Any:
    """Gathers what contacts are between."""
    sides = Sides()
    sides.contact, sides.geom = d.efc.id, d.contact.geom
    sides.body, sides.root, sides.joint = m.geom_bodyid, m.body_rootid, m.body_dofadr
    return sides


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
def _share_out(problem: Problem, sides: Sides, robots: int) -> None:
    """Lists the rows of each robot of an arena."""
    arena = wp.tid()
    for robot in range(robots):
        problem.own[arena, robot] = 0
        problem.touches[arena, robot] = False
    for row in range(_count(problem, arena)):
        geoms = sides.geom[sides.contact[arena, row]]
        first = _robot(sides, geoms[0])
        second = _robot(sides, geoms[1])
        between = first >= 0 and second >= 0
        problem.first[arena, row] = _list(problem, arena, row, first, between)
        problem.second[arena, row] = _list(problem, arena, row, second, between)


@wp.func
def _count(problem: Problem, arena: int) -> int:
    """How many rows there are; of more than there is room for, the rest is left out."""
    return wp.min(problem.count[arena], problem.first.shape[1])


@wp.func
def _robot(sides: Sides, geom: int) -> int:
    """Which robot a geom is of; -1: none."""
    joint = sides.joint[sides.root[sides.body[geom]]]
    return wp.where(joint < 0, -1, joint / JOINTS)


@wp.func
def _list(problem: Problem, arena: int, row: int, robot: int, between: bool) -> int:
    """Adds a row to those of a robot; -1 if it is none's, or the robot has no room for more."""
    if robot < 0 or problem.own[arena, robot] >= MOST_ROWS:
        return -1
    problem.row[arena, robot, problem.own[arena, robot]] = row
    problem.own[arena, robot] = problem.own[arena, robot] + 1
    if between:
        problem.touches[arena, robot] = True
    return robot


@wp.kernel(enable_backward=False)
def _relax_each(problem: Problem, iterations: int) -> None:
    """Finds the accelerations of a robot that touches no other."""
    arena, robot = wp.tid()
    if not problem.touches[arena, robot]:
        _relax(problem, arena, robot, iterations)


@wp.func
def _relax(problem: Problem, arena: int, robot: int, iterations: int) -> None:
    """Newton's method for a robot alone."""
    now = _of_robot(problem.qacc, arena, robot)
    inertia = _inertia(problem, arena, robot)
    done = wp.int32(0)
    moves = wp.bool(True)
    while moves and done < iterations:
        gap = _gaps(problem, arena, robot, now, 1.0)
        downhill = _newton(problem, arena, robot, inertia, gap, now)
        slope = _gaps(problem, arena, robot, downhill, 0.0)
        length = _length(problem, arena, robot, inertia, gap, slope, now, downhill)
        moves = _switches(problem.own[arena, robot], gap, slope, length) or length != 1.0
        moves = _goes_on(moves, wp.max(wp.abs(downhill)), wp.max(wp.abs(now)))
        now = now + length * downhill
        done += 1
    _set(problem.qacc, arena, robot, now)


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
    """M of a robot."""
    found = _Matrix()
    for i in range(8):
        dof = robot * JOINTS + i
        first = problem.M_first[dof]
        for entry in range(first, first + problem.M_count[dof]):
            j = problem.M_column[entry] - robot * JOINTS
            found[i, j] = problem.M[arena, entry]
            found[j, i] = problem.M[arena, entry]
    return found


@wp.func
def _jacobian(problem: Problem, arena: int, row: int, robot: int) -> _Vector:
    """A row's entries at a robot."""
    found = _Vector()
    first = problem.J_first[arena, row]
    for entry in range(first, first + problem.J_count[arena, row]):
        i = problem.J_column[arena, 0, entry] - robot * JOINTS
        if i >= 0 and i < JOINTS:
            found[i] = problem.J[arena, 0, entry]
    return found


@wp.func
def _gaps(problem: Problem, arena: int, robot: int, along: _Vector, asked: float) -> _Rows:
    """J a of a robot's rows, less what is `asked` of aref; with all of it, below 0 a row acts."""
    found = _Rows()
    for k in range(problem.own[arena, robot]):
        row = problem.row[arena, robot, k]
        slope = _jacobian(problem, arena, row, robot)
        found[k] = wp.dot(slope, along) - asked * problem.aref[arena, row]
    return found


@wp.func
def _newton(
    problem: Problem, arena: int, robot: int, inertia: _Matrix, gap: _Rows, now: _Vector
) -> _Vector:
    """Newton's step, of the rows that act now."""
    hessian = inertia + _Matrix()
    uphill = inertia * now - _of_robot(problem.force, arena, robot)
    for k in range(problem.own[arena, robot]):
        if gap[k] < 0.0:
            row = problem.row[arena, robot, k]
            slope = _jacobian(problem, arena, row, robot)
            weighted = problem.D[arena, row] * slope
            uphill = uphill + gap[k] * weighted
            hessian = hessian + wp.outer(weighted, slope)
    return _substitute(_factor(hessian), -uphill)


@wp.func
def _factor(matrix: _Matrix) -> _Matrix:
    """Cholesky's L, of a symmetric positive definite matrix L L'; above it is what was there."""
    lower = matrix + _Matrix()
    for i in range(8):
        for j in range(i + 1):
            entry = lower[i, j]
            for k in range(j):
                entry = entry - lower[i, k] * lower[j, k]
            if i == j:
                lower[i, i] = wp.sqrt(entry)
            else:
                lower[i, j] = entry / lower[j, j]
    return lower


@wp.func
def _substitute(lower: _Matrix, right: _Vector) -> _Vector:
    """Solves L L' x = right."""
    found = right + _Vector()
    for i in range(8):
        for k in range(i):
            found[i] = found[i] - lower[i, k] * found[k]
        found[i] = found[i] / lower[i, i]
    for back in range(8):
        i = 7 - back
        for k in range(i + 1, 8):
            found[i] = found[i] - lower[k, i] * found[k]
        found[i] = found[i] / lower[i, i]
    return found


@wp.func
def _length(
    problem: Problem,
    arena: int,
    robot: int,
    inertia: _Matrix,
    gap: _Rows,
    slope: _Rows,
    now: _Vector,
    downhill: _Vector,
) -> float:
    """How far to go along a step: where the cost, which is convex along it, is least."""
    pull = inertia * now - _of_robot(problem.force, arena, robot)
    first, curve = wp.dot(pull, downhill), wp.dot(downhill, inertia * downhill)
    begin = _tilt(problem, arena, robot, gap, slope, 0.0)[0] + first
    search = wp.vec3(0.0, 1e6, 1.0)
    for _ in range(_SEARCHES):
        bend = _tilt(problem, arena, robot, gap, slope, search[2])
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
def _tilt(
    problem: Problem, arena: int, robot: int, gap: _Rows, slope: _Rows, length: float
) -> wp.vec2:
    """First and second derivative of the rows' cost along a step."""
    tilt = wp.vec2()
    for k in range(problem.own[arena, robot]):
        there = gap[k] + length * slope[k]
        if there < 0.0:
            weighted = problem.D[arena, problem.row[arena, robot, k]] * slope[k]
            tilt = tilt + weighted * wp.vec2(there, slope[k])
    return tilt


@wp.func
def _switches(count: int, gap: _Rows, slope: _Rows, length: float) -> bool:
    """Whether any row acts before a step and not after it, or the other way round."""
    switches = wp.bool(False)
    for k in range(count):
        if (gap[k] < 0.0) != (gap[k] + length * slope[k] < 0.0):
            switches = True
    return switches


@wp.kernel(enable_backward=False)
def _relax_pairs(
    problem: Problem, together: Together, robots: int, iterations: int, niter: wp.array[int]
) -> None:
    """Newton's method for the robots of an arena that touch each other."""
    arena = wp.tid()
    done = wp.int32(0)
    moves = wp.bool(False)
    for robot in range(robots):
        moves = moves or problem.touches[arena, robot]
    while moves and done < iterations:
        _pick(problem, together, arena)
        for robot in range(robots):
            _descend(problem, together, arena, robot)
        _couple(problem, together, arena)
        length = _length_together(problem, together, arena, robots)
        moves = _moves(problem, together, arena, length)
        done += 1
    niter[arena] = done


@wp.func
def _along(problem: Problem, arena: int, row: int, of_joints: wp.array2d[float]) -> float:
    """A row of J times what all joints of its arena have."""
    found = wp.float32(0.0)
    first = problem.J_first[arena, row]
    for entry in range(first, first + problem.J_count[arena, row]):
        found += problem.J[arena, 0, entry] * of_joints[arena, problem.J_column[arena, 0, entry]]
    return found


@wp.func
def _pick(problem: Problem, together: Together, arena: int) -> None:
    """Finds out which rows act, and which of those between robots become terms of their own."""
    taken = wp.int32(0)
    for row in range(_count(problem, arena)):
        gap = _along(problem, arena, row, problem.qacc) - problem.aref[arena, row]
        together.gap[arena, row] = gap
        together.slot[arena, row] = -1
        between = problem.first[arena, row] >= 0 and problem.second[arena, row] >= 0
        if between and gap < 0.0 and taken < _PAIRS:
            together.slot[arena, row] = taken
            together.pair[arena, taken] = row
            taken += 1
    together.taken[arena] = taken


@wp.func
def _descend(problem: Problem, together: Together, arena: int, robot: int) -> None:
    """Works out a robot's step as if its pairs' terms were not there, and its block's factor."""
    _set(together.step, arena, robot, _Vector())
    if problem.touches[arena, robot]:
        inertia = _inertia(problem, arena, robot)
        now = _of_robot(problem.qacc, arena, robot)
        uphill = inertia * now - _of_robot(problem.force, arena, robot)
        for k in range(problem.own[arena, robot]):
            row = problem.row[arena, robot, k]
            gap = together.gap[arena, row]
            if gap < 0.0:
                slope = _jacobian(problem, arena, row, robot)
                weighted = problem.D[arena, row] * slope
                uphill = uphill + gap * weighted
                if together.slot[arena, row] < 0:
                    inertia = inertia + wp.outer(weighted, slope)
        factor = _factor(inertia)
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
            robot = _side(problem, arena, row, side)
            slope = _jacobian(problem, arena, row, robot)
            factor = together.factor[arena, robot]
            together.response[arena, i, side] = _substitute(factor, slope)
        matrix[i, i] = 1.0 / problem.D[arena, row]
    for i in range(taken):
        for j in range(taken):
            for sides in range(4):
                push = _overlap(problem, together, arena, i, j, sides)
                matrix[i, j] = matrix[i, j] + push
    force = _substitute(_factor(matrix), right)
    for i in range(taken):
        for side in range(2):
            robot = _side(problem, arena, together.pair[arena, i], side)
            step = _of_robot(together.step, arena, robot)
            response = together.response[arena, i, side]
            _set(together.step, arena, robot, step - force[i] * response)


@wp.func
def _side(problem: Problem, arena: int, row: int, side: int) -> int:
    """The first or the second robot of a row."""
    return wp.where(side == 0, problem.first[arena, row], problem.second[arena, row])


@wp.func
def _overlap(problem: Problem, together: Together, arena: int, i: int, j: int, sides: int) -> float:
    """What pair j brings about along pair i in the robot that is on these sides of both."""
    row = together.pair[arena, i]
    mine = _side(problem, arena, row, sides % 2)
    theirs = _side(problem, arena, together.pair[arena, j], sides // 2)
    if mine != theirs:
        return 0.0
    slope = _jacobian(problem, arena, row, mine)
    return wp.dot(slope, together.response[arena, j, sides // 2])


@wp.func
def _length_together(problem: Problem, together: Together, arena: int, robots: int) -> float:
    """How far to go along the step of all, as `_length` says of one."""
    first, curve = wp.float32(0.0), wp.float32(0.0)
    for robot in range(robots):
        if problem.touches[arena, robot]:
            inertia = _inertia(problem, arena, robot)
            step = _of_robot(together.step, arena, robot)
            now = _of_robot(problem.qacc, arena, robot)
            first += wp.dot(inertia * now - _of_robot(problem.force, arena, robot), step)
            curve += wp.dot(inertia * step, step)
    for row in range(_count(problem, arena)):
        together.slope[arena, row] = _along(problem, arena, row, together.step)
    begin = _tilt_together(problem, together, arena, 0.0)[0] + first
    search = wp.vec3(0.0, 1e6, 1.0)
    for _ in range(_SEARCHES):
        bend = _tilt_together(problem, together, arena, search[2])
        tilt = bend[0] + first + search[2] * curve
        if wp.abs(tilt) <= _FLAT * wp.abs(begin):
            break
        search = _narrow(search, tilt, bend[1] + curve)
    return search[2]


@wp.func
def _tilt_together(problem: Problem, together: Together, arena: int, length: float) -> wp.vec2:
    """First and second derivative of all rows' cost along the step."""
    tilt = wp.vec2()
    for row in range(_count(problem, arena)):
        slope = together.slope[arena, row]
        there = together.gap[arena, row] + length * slope
        if there < 0.0:
            tilt = tilt + problem.D[arena, row] * slope * wp.vec2(there, slope)
    return tilt


@wp.func
def _moves(problem: Problem, together: Together, arena: int, length: float) -> bool:
    """Takes the step; says whether another is needed."""
    moves = length != 1.0
    for row in range(_count(problem, arena)):
        gap = together.gap[arena, row]
        if (gap < 0.0) != (gap + length * together.slope[arena, row] < 0.0):
            moves = wp.bool(True)
    largest, longest = wp.float32(0.0), wp.float32(0.0)
    for dof in range(problem.qacc.shape[1]):
        step = together.step[arena, dof]
        if step != 0.0:
            largest = wp.max(largest, wp.abs(problem.qacc[arena, dof]))
            longest = wp.max(longest, wp.abs(step))
            problem.qacc[arena, dof] = problem.qacc[arena, dof] + length * step
    return _goes_on(moves, longest, largest)
