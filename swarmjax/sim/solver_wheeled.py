"""Contacts of the wheeled body on the GPU: Newton's method robot by robot, one thread a robot.

MuJoCo's convex problem for the accelerations a (MuJoCo's documentation, Computation, "Primal
problem"), with rows of pyramidal friction cones and of contacts that only push,

    minimise  1/2 (a - a0)' M (a - a0) + sum_i D_i / 2 min(0, J_i a - aref_i)^2,

falls into one of 8 unknowns for each robot as long as robots touch the floor, walls and obstacles
alone: M and those rows of J have entries of one robot each. MJX-Warp's Newton method takes all
robots of an arena together and factorises a matrix of 8 R rows at every iteration. Where robots do
touch each other, the robots of that arena are gone through in turn, each with the others'
accelerations given, until none changes any more: the cost is smooth and strictly convex, so this
ends at its one minimum (Bertsekas 1999, "Nonlinear Programming", proposition 2.7.1).
"""

from typing import Any

import mujoco.mjx.third_party.mujoco_warp as mjw
import warp as wp

NUMBER = -1  # what `opt.solver` says; MuJoCo has none of it
JOINTS = wp.constant(8)  # of a robot: free in space, and two wheels
# Rows of a robot: 4 of each wheel, 1 of each skid, and contacts of its hull.
MOST_ROWS = wp.constant(24)
_ITERATIONS = wp.constant(20)  # of Newton's method; two or three do
_SEARCHES = wp.constant(12)  # of a step's length
_SWEEPS = wp.constant(200)
# Shares of the slope at a step's beginning, and of the largest acceleration, that count for
# nothing: float32 rounds at 1e-7, and the grips of a robot are 1e3 times as stiff as its mass.
_FLAT = wp.constant(1e-4)
_STILL = wp.constant(1e-5)
_SHORT = wp.constant(1e-2)  # share of the acceleration that a last step may be


class _Vector(wp.types.vector(length=8, dtype=wp.float32)):
    """A number for each joint of a robot."""


class _Matrix(wp.types.matrix(shape=(8, 8), dtype=wp.float32)):
    """A number for each two of them."""


class _Rows(wp.types.vector(length=24, dtype=wp.float32)):
    """A number for each row of a robot."""


def step(m: Any, d: Any) -> None:
    """Moves all arenas of wheeled robots on by one physics step (MuJoCo's semi-implicit Euler).

    Args:
      m: Warp's model: robots of eight joints each, and no others; a sparse Jacobian.
      d: Warp's data of all arenas, written to; the forces of contacts are not.
    """
    mjw.fwd_position(m, d, factorize=False)
    mjw.fwd_velocity(m, d)
    mjw.fwd_actuation(m, d)
    robots = m.nv // 8
    problem = _problem(m, d, robots)
    forces = [d.qfrc_applied, d.qfrc_bias, d.qfrc_passive, d.qfrc_actuator, d.qacc_warmstart]
    wp.launch(_begin, dim=(d.nworld, m.nv), inputs=[problem, *forces])
    wp.launch(_share_out, dim=d.nworld, inputs=[problem, _sides(m, d), robots])
    wp.launch(_relax_each, dim=(d.nworld, robots), inputs=[problem])
    wp.launch(_relax_touching, dim=d.nworld, inputs=[problem, robots, d.solver_niter])
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
      other: [A, N] sum of the numbers of the two robots of a row, -1 being none.
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
    other: wp.array2d[int]
    own: wp.array2d[int]
    row: wp.array3d[int]
    touches: wp.array2d[bool]


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
    problem.other = wp.empty((d.nworld, d.njmax), dtype=int)
    problem.own = wp.empty((d.nworld, robots), dtype=int)
    problem.row = wp.empty((d.nworld, robots, 24), dtype=int)
    problem.touches = wp.empty((d.nworld, robots), dtype=bool)
    return problem


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
    for row in range(wp.min(problem.count[arena], problem.other.shape[1])):
        geoms = sides.geom[sides.contact[arena, row]]
        first = _robot(sides, geoms[0])
        second = _robot(sides, geoms[1])
        problem.other[arena, row] = first + second
        _list(problem, arena, row, first, first >= 0 and second >= 0)
        _list(problem, arena, row, second, first >= 0 and second >= 0)


@wp.func
def _robot(sides: Sides, geom: int) -> int:
    """Which robot a geom is of; -1: none."""
    joint = sides.joint[sides.root[sides.body[geom]]]
    return wp.where(joint < 0, -1, joint / JOINTS)


@wp.func
def _list(problem: Problem, arena: int, row: int, robot: int, touches: bool) -> None:
    """Adds a row to those of a robot."""
    if robot >= 0 and problem.own[arena, robot] < MOST_ROWS:
        problem.row[arena, robot, problem.own[arena, robot]] = row
        problem.own[arena, robot] = problem.own[arena, robot] + 1
        if touches:
            problem.touches[arena, robot] = True


@wp.kernel(enable_backward=False)
def _relax_each(problem: Problem) -> None:
    """Finds a robot's accelerations by itself."""
    arena, robot = wp.tid()
    _relax(problem, arena, robot)


@wp.kernel(enable_backward=False)
def _relax_touching(problem: Problem, robots: int, niter: wp.array[int]) -> None:
    """Goes through the robots of an arena that touch each other until none changes any more."""
    arena = wp.tid()
    sweeps = wp.int32(0)
    moves = wp.bool(True)
    while moves and sweeps < _SWEEPS:
        moves = wp.bool(False)
        for robot in range(robots):
            if problem.touches[arena, robot] and _relax(problem, arena, robot):
                moves = True
        sweeps += 1
    niter[arena] = sweeps


@wp.func
def _relax(problem: Problem, arena: int, robot: int) -> bool:
    """Sets a robot's accelerations to their best, the others' given; says whether they changed."""
    begin = _accelerations(problem, arena, robot)
    now = begin + _Vector()  # a copy: Warp's names are references
    rest = _rest(problem, arena, robot)
    inertia = _inertia(problem, arena, robot)
    done = wp.int32(0)
    moves = wp.bool(True)
    while moves and done < _ITERATIONS:
        gap = _gaps(problem, arena, robot, rest, now)
        downhill = _newton(problem, arena, robot, inertia, gap, now)
        slope = _gaps(problem, arena, robot, _Rows(), downhill)
        length = _length(problem, arena, robot, inertia, gap, slope, now, downhill)
        moves = _switches(problem.own[arena, robot], gap, slope, length) or length != 1.0
        # A long step leaves its rounding behind, which one more takes out.
        moves = moves or wp.max(wp.abs(downhill)) > _SHORT * wp.max(wp.abs(now))
        now = now + length * downhill
        done += 1
    for i in range(8):
        problem.qacc[arena, robot * JOINTS + i] = now[i]
    return wp.max(wp.abs(now - begin)) > _STILL * wp.max(wp.abs(now))


@wp.func
def _accelerations(problem: Problem, arena: int, robot: int) -> _Vector:
    """Those of a robot's joints."""
    found = _Vector()
    for i in range(8):
        found[i] = problem.qacc[arena, robot * JOINTS + i]
    return found


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
def _rest(problem: Problem, arena: int, robot: int) -> _Rows:
    """Of a robot's rows, J a - aref without its own part."""
    rest = _Rows()
    for k in range(problem.own[arena, robot]):
        row = problem.row[arena, robot, k]
        rest[k] = -problem.aref[arena, row]
        other = problem.other[arena, row] - robot
        if other >= 0:
            slope = _jacobian(problem, arena, row, other)
            rest[k] = rest[k] + wp.dot(slope, _accelerations(problem, arena, other))
    return rest


@wp.func
def _gaps(problem: Problem, arena: int, robot: int, rest: _Rows, along: _Vector) -> _Rows:
    """Of a robot's rows, the rest and the robot's own part; below 0 a row acts."""
    found = rest + _Rows()
    for k in range(problem.own[arena, robot]):
        slope = _jacobian(problem, arena, problem.row[arena, robot, k], robot)
        found[k] = rest[k] + wp.dot(slope, along)
    return found


@wp.func
def _newton(
    problem: Problem, arena: int, robot: int, inertia: _Matrix, gap: _Rows, now: _Vector
) -> _Vector:
    """Newton's step, of the rows that act now."""
    hessian = inertia + _Matrix()
    uphill = inertia * now
    for i in range(8):
        uphill[i] = uphill[i] - problem.force[arena, robot * JOINTS + i]
    for k in range(problem.own[arena, robot]):
        if gap[k] < 0.0:
            row = problem.row[arena, robot, k]
            slope = _jacobian(problem, arena, row, robot)
            weighted = problem.D[arena, row] * slope
            uphill = uphill + gap[k] * weighted
            hessian = hessian + wp.outer(weighted, slope)
    return _solve(hessian, -uphill)


@wp.func
def _solve(matrix: _Matrix, right: _Vector) -> _Vector:
    """Solves for a symmetric positive definite matrix, by Cholesky's factors L L'."""
    lower, found = matrix + _Matrix(), right + _Vector()
    for i in range(8):
        for j in range(i + 1):
            entry = lower[i, j]
            for k in range(j):
                entry = entry - lower[i, k] * lower[j, k]
            if i == j:
                lower[i, i] = wp.sqrt(entry)
            else:
                lower[i, j] = entry / lower[j, j]
        for k in range(i):
            found[i] = found[i] - lower[i, k] * found[k]
        found[i] = found[i] / lower[i, i]
    for step_back in range(8):
        i = 7 - step_back
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
    pull = inertia * now
    for i in range(8):
        pull[i] = pull[i] - problem.force[arena, robot * JOINTS + i]
    first, curve = wp.dot(pull, downhill), wp.dot(downhill, inertia * downhill)
    begin = _tilt(problem, arena, robot, gap, slope, 0.0)[0] + first
    low, high, length = wp.float32(0.0), wp.float32(1e6), wp.float32(1.0)
    for _ in range(_SEARCHES):
        bend = _tilt(problem, arena, robot, gap, slope, length)
        tilt = bend[0] + first + length * curve
        if wp.abs(tilt) <= _FLAT * wp.abs(begin):
            break
        low = wp.where(tilt < 0.0, length, low)
        high = wp.where(tilt < 0.0, high, length)
        there = length - tilt / (bend[1] + curve)
        length = wp.where(low < there and there < high, there, 0.5 * (low + high))
    return length


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
