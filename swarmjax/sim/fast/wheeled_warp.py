"""Contacts of the wheeled body on the GPU: Newton's method with one thread per robot.

MuJoCo solves a convex problem for the accelerations a (MuJoCo's documentation, Computation, "Primal
problem"), with rows for pyramidal friction cones and for contacts that only push,

    minimise  1/2 (a - a0)' M (a - a0) + sum_i D_i / 2 min(0, J_i a - aref_i)^2.

For robots that touch only the floor, walls and obstacles, the rows of M and J involve one robot
each. The problem then splits into one problem with 8 unknowns per robot. MJX-Warp's Newton method
instead solves for all robots of an arena together, and factorises a matrix of 8 R rows per
iteration.

Here, only robots that touch each other are solved together. Their Hessian is one 8 x 8 block per
robot, plus a rank-one term per contact between two robots. The Woodbury identity moves these terms
out of the inverse (Golub and Van Loan 2013, "Matrix Computations", 2.1.4).
"""

from typing import Any

import mujoco.mjx.third_party.mujoco_warp as mjw
import warp as wp

from swarmjax.sim.fast.wheeled_pairs import SPREAD, relax_pairs
from swarmjax.sim.fast.wheeled_problem import (
    AREF,
    FLAT,
    FREE,
    GAP,
    JOINTS,
    SEARCHES,
    SHARED,
    SLOPE,
    Problem,
    Together,
    Vector,
    add,
    does_switch,
    entries_of,
    factor_of,
    gather,
    goes_on,
    inertia_of,
    make_room,
    narrow,
    of_robot,
    put_robot,
    substitute,
    times,
)

NUMBER = -1  # value of `opt.solver` for this solver; MuJoCo does not use it
_ITERATIONS = 20  # limit of Newton's method; touching robots usually need six, at most 18 so far
_BLOCK = 64  # threads per block; a thread's work is long and uneven, so small blocks wait less


def step(m: Any, d: Any) -> None:
    """Advances all arenas of wheeled robots by one physics step (MuJoCo's semi-implicit Euler).

    The step ignores the external forces `xfrc_applied`, since nothing here uses them.

    Args:
      m: Warp's model: only robots, with eight joints each; a sparse Jacobian.
      d: Warp's data of all arenas, modified in place, except for the contact forces.
    """
    mjw.fwd_position(m, d, factorize=False)
    mjw.fwd_velocity(m, d)
    mjw.fwd_actuation(m, d)
    robots = m.nv // JOINTS
    problem, together = gather(m, d, robots), make_room(m, d, robots)
    forces = [d.qfrc_applied, d.qfrc_bias, d.qfrc_passive, d.qfrc_actuator, d.qacc_warmstart]
    wp.launch(_begin, dim=(d.nworld, m.nv), inputs=[problem, *forces])
    together.crowded.zero_()
    d.solver_niter.zero_()
    wp.launch(_share_out, dim=(d.nworld, robots), inputs=[problem, together])
    most = min(m.opt.iterations, _ITERATIONS)
    wp.launch(_relax_each, dim=(d.nworld, robots), inputs=[problem, most], block_dim=_BLOCK)
    inputs = [problem, together, robots, most, d.solver_niter]
    wp.launch(relax_pairs, dim=d.nworld * SPREAD, inputs=inputs, block_dim=_BLOCK)
    mjw.euler(m, d)


@wp.kernel(enable_backward=False)
def _begin(
    problem: Problem,
    applied: wp.array2d[float],
    bias: wp.array2d[float],
    passive: wp.array2d[float],
    actuator: wp.array2d[float],
    warmstart: wp.array2d[float],
) -> None:
    """Sums the forces on a joint, and starts from the previous step's acceleration."""
    arena, dof = wp.tid()
    given = applied[arena, dof] - bias[arena, dof]
    problem.force[arena, dof] = given + passive[arena, dof] + actuator[arena, dof]
    problem.qacc[arena, dof] = warmstart[arena, dof]


@wp.kernel(enable_backward=False)
def _share_out(problem: Problem, together: Together) -> None:
    """Lists the rows of a robot.

    The thread of the first robot also lists the arena if any robots touch each other.
    """
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
    """Returns the number of rows; rows beyond the memory's size are left out."""
    return wp.min(problem.count[arena], problem.first.shape[1])


@wp.func
def _sides(problem: Problem, arena: int, row: int) -> tuple[wp.vec3i, wp.vec3i]:
    """Returns the `side` of a row's robots, as for `entries_of`; the higher number comes first.

    A row has the six entries of a body. A wheel's row has the wheel's entry before them. A row of
    two robots has twelve entries.
    """
    first = problem.J_first[arena, row]
    joint = problem.J_column[arena, 0, first]
    robot, wheel = joint / JOINTS, wp.where(joint % JOINTS < FREE, -1, joint % JOINTS)
    mine = wp.vec3i(robot, wp.where(wheel < 0, first, first + 1), wheel)
    other = wp.vec3i(-1, -1, -1)
    if problem.J_count[arena, row] > JOINTS:
        mine = wp.vec3i(robot, first, SHARED)
        body = first + FREE
        other = wp.vec3i(problem.J_column[arena, 0, body] / JOINTS, body, SHARED)
    return mine, other


@wp.func
def _scale(problem: Problem, arena: int, robot: int, k: int) -> None:
    """Copies a robot's row so that neighbouring threads read from adjacent memory."""
    side = problem.row[arena, robot, k]
    root = wp.sqrt(problem.D[arena, side[0]])
    entries = root * entries_of(problem, arena, side)
    lane = arena * problem.own.shape[1] + robot
    for i in range(8):
        problem.scaled[k, i, lane] = entries[i]
    problem.scaled[k, AREF, lane] = root * problem.aref[arena, side[0]]


@wp.kernel(enable_backward=False)
def _relax_each(problem: Problem, iterations: int) -> None:
    """Finds the accelerations of a robot that touches no other robot."""
    arena, robot = wp.tid()
    if not problem.touches[arena, robot]:
        _relax(problem, arena, robot, iterations)


@wp.func
def _relax(problem: Problem, arena: int, robot: int, iterations: int) -> None:
    """Runs Newton's method for a single robot."""
    lane, own = arena * problem.own.shape[1] + robot, problem.own[arena, robot]
    # Copy here, not where rows are listed: there, neighbouring threads would copy one by one.
    for k in range(own):
        _scale(problem, arena, robot, k)
    now = of_robot(problem.qacc, arena, robot)
    done = wp.int32(0)
    moves = wp.bool(True)
    while moves and done < iterations:
        downhill = _newton(problem, arena, robot, now)
        moves = wp.bool(False)
        for k in range(own):
            slope = wp.dot(_scaled(problem, k, lane), downhill)
            problem.scaled[k, SLOPE, lane] = slope
            moves = moves or does_switch(problem.scaled[k, GAP, lane], slope)
        length = wp.float32(1.0)
        if moves:
            length = _length(problem, arena, robot, now, downhill)
        moves = goes_on(moves, wp.max(wp.abs(downhill)), wp.max(wp.abs(now)))
        now = now + length * downhill
        done += 1
    put_robot(problem.qacc, arena, robot, now)


@wp.func
def _newton(problem: Problem, arena: int, robot: int, now: Vector) -> Vector:
    """Returns Newton's step for the rows that are active now."""
    lane = arena * problem.own.shape[1] + robot
    hessian = inertia_of(problem, arena, robot)
    uphill = times(hessian, now) - of_robot(problem.force, arena, robot)
    for k in range(problem.own[arena, robot]):
        row = _scaled(problem, k, lane)
        gap = wp.dot(row, now) - problem.scaled[k, AREF, lane]
        problem.scaled[k, GAP, lane] = gap
        if gap < 0.0:
            uphill = uphill + gap * row
            hessian = add(hessian, row, row)
    return substitute(factor_of(hessian), -uphill)


@wp.func
def _scaled(problem: Problem, k: int, lane: int) -> Vector:
    """Returns a robot's entries in one of its rows, times the root of D."""
    found = Vector()
    for i in range(8):
        found[i] = problem.scaled[k, i, lane]
    return found


@wp.func
def _length(problem: Problem, arena: int, robot: int, now: Vector, downhill: Vector) -> float:
    """Returns the step length with the least cost; the cost is convex along the step."""
    inertia = inertia_of(problem, arena, robot)
    pull = times(inertia, now) - of_robot(problem.force, arena, robot)
    first, curve = wp.dot(pull, downhill), wp.dot(downhill, times(inertia, downhill))
    begin = _tilt(problem, arena, robot, 0.0)[0] + first
    search = wp.vec3(0.0, 1e6, 1.0)
    for _ in range(SEARCHES):
        bend = _tilt(problem, arena, robot, search[2])
        tilt = bend[0] + first + search[2] * curve
        if wp.abs(tilt) <= FLAT * wp.abs(begin):
            break
        search = narrow(search, tilt, bend[1] + curve)
    return search[2]


@wp.func
def _tilt(problem: Problem, arena: int, robot: int, length: float) -> wp.vec2:
    """Returns first and second derivative of the rows' cost along a step."""
    lane = arena * problem.own.shape[1] + robot
    tilt = wp.vec2()
    for k in range(problem.own[arena, robot]):
        slope = problem.scaled[k, SLOPE, lane]
        there = problem.scaled[k, GAP, lane] + length * slope
        if there < 0.0:
            tilt = tilt + slope * wp.vec2(there, slope)
    return tilt
