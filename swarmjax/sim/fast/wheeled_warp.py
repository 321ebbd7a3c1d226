"""Solves the contacts of the wheeled body in MJX-Warp, by Newton's method per robot.

MJX looks up the function `step` of MJX-Warp by name, and this module replaces that function. The
model's `opt.solver` selects what the new function does: `NUMBER` selects the step made for wheels,
and any other value selects MJX-Warp's own step.

MuJoCo solves a convex problem for the accelerations a (MuJoCo's documentation, Computation, "Primal
problem"), where each index i is a row of the Jacobian J, for an edge of a pyramidal friction cone
or for a contact without friction:

    minimise  1/2 (a - a0)' M (a - a0) + sum_i D_i / 2 min(0, J_i a - aref_i)^2.

If robots touch only the floor, walls and obstacles, each row of M and J involves one robot. The
problem then splits into one problem per robot, with 8 unknowns. MJX-Warp's Newton method instead
solves for all robots of an arena together, and factorises a matrix of 8 R rows per iteration.

This solver solves robots together only if they touch each other (`wheeled_pairs`).
"""

import copy
from dataclasses import replace
from typing import Any

import mujoco
import mujoco.mjx.third_party.mujoco_warp as mjw
import warp as wp
from mujoco.mjx.warp import forward

from swarmjax.sim import engine
from swarmjax.sim.engine import Engine
from swarmjax.sim.fast import wheeled_problem as wheeled
from swarmjax.sim.fast.wheeled_pairs import MOST_THREADS, relax_pairs
from swarmjax.sim.fast.wheeled_problem import Problem, Together, Vector

NUMBER = -1  # value of `opt.solver` that selects this solver; MuJoCo does not use this value
_ITERATIONS = 20  # limit of Newton's iterations; touching robots usually take 6, at most 18 so far
_BLOCK = 64  # threads per block; small, since blocks wait for their slowest thread


_mjx_step = mjw.step


def load_engine(model: mujoco.MjModel, robots: int, arenas: int) -> Engine:
    """Loads MJX-Warp with the contact solver made for wheeled robots.

    Args:
      model: compiled, one arena.
      robots: R.
      arenas: number of arenas stepped together.

    Returns:
      The engine.
    """
    model = copy.copy(model)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE  # the format that this solver reads
    plain = engine.load_mjx(model, robots, "warp", arenas)
    forward.mjwarp.step = _step
    chosen = plain.model.tree_replace({"opt.solver": NUMBER})
    # The label gives the speed of the whole environment, not of the physics alone.
    label = "MJX with swarmjax's contact solver (3.2 times as fast as sim.solver=mjx on an H200)"
    return replace(plain, label=label, model=chosen)


def _step(m: Any, d: Any) -> None:
    """Advances all arenas by the physics step that the model selects."""
    (_step_wheels if m.opt.solver == NUMBER else _mjx_step)(m, d)


def _step_wheels(m: Any, d: Any) -> None:
    """Advances all arenas of wheeled robots by one physics step (MuJoCo's semi-implicit Euler).

    The step ignores the external forces `xfrc_applied`, since swarmjax does not use them. `m` is
    Warp's model, in which all joints belong to robots of eight degrees of freedom and the Jacobian
    is sparse. `d` is Warp's data of all arenas; it is modified in place, but contact forces are not
    written.
    """
    mjw.fwd_position(m, d, factorize=False)
    mjw.fwd_velocity(m, d)
    mjw.fwd_actuation(m, d)
    robots = m.nv // wheeled.JOINTS
    problem = wheeled.gather(m, d, robots)
    together = wheeled.make_room(m, d, robots)
    forces = [d.qfrc_applied, d.qfrc_bias, d.qfrc_passive, d.qfrc_actuator, d.qacc_warmstart]
    wp.launch(_begin, dim=(d.nworld, m.nv), inputs=[problem, *forces])
    together.crowded.zero_()
    d.solver_niter.zero_()
    wp.launch(_find_sides, dim=(d.nworld, d.njmax), inputs=[problem])
    wp.launch(_share_out, dim=(d.nworld, robots), inputs=[problem, together])
    most = min(m.opt.iterations, _ITERATIONS)
    wp.launch(_relax_each, dim=(d.nworld, robots), inputs=[problem, most], block_dim=_BLOCK)
    threads = min(MOST_THREADS, 2 ** (robots - 1).bit_length()) if d.qpos.device.is_cuda else 1
    inputs = [problem, together, most, threads, d.solver_niter]
    wp.launch(relax_pairs, dim=(d.nworld, threads), inputs=inputs, block_dim=_BLOCK)
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
    """Sums the forces on a joint, and sets its acceleration to that of the previous step."""
    arena, dof = wp.tid()
    given = applied[arena, dof] - bias[arena, dof]
    problem.force[arena, dof] = given + passive[arena, dof] + actuator[arena, dof]
    problem.qacc[arena, dof] = warmstart[arena, dof]


@wp.kernel(enable_backward=False)
def _find_sides(problem: Problem) -> None:
    """Finds where the entries of a row's robots are; the robot with the higher index is first.

    A row has six entries for a robot's free body. The row of a wheel's contact has one more entry
    before these, for the wheel. A row of two robots has twelve entries.
    """
    arena, row = wp.tid()
    if row >= problem.count[arena]:
        return
    first = problem.J_first[arena, row]
    joint = problem.J_column[arena, 0, first]
    robot, wheel = joint / wheeled.JOINTS, joint % wheeled.JOINTS
    mine = wp.vec3i(robot, first + 1, wheel)
    if wheel < wheeled.FREE:
        mine = wp.vec3i(robot, first, -1)
    other = wp.vec3i(-1, -1, -1)
    if problem.J_count[arena, row] > wheeled.JOINTS:
        body = first + wheeled.FREE
        mine = wp.vec3i(robot, first, wheeled.SHARED)
        other = wp.vec3i(problem.J_column[arena, 0, body] / wheeled.JOINTS, body, wheeled.SHARED)
    problem.first[arena, row] = mine
    problem.second[arena, row] = other


@wp.kernel(enable_backward=False)
def _share_out(problem: Problem, together: Together) -> None:
    """Lists the rows that involve a robot.

    If any robots of the arena touch each other, the thread of the first robot also adds the arena
    to `Together.arena`.
    """
    arena, robot = wp.tid()
    own = wp.int32(0)
    touches, crowded = wp.bool(False), wp.bool(False)
    # Rows for which there is no memory are left out.
    for row in range(wp.min(problem.count[arena], problem.first.shape[1])):
        first, second = problem.first[arena, row], problem.second[arena, row]
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
def _scale(problem: Problem, arena: int, robot: int, k: int) -> None:
    """Copies a robot's row to `scaled`, where neighbouring threads read from adjacent memory."""
    side = problem.row[arena, robot, k]
    root = wp.sqrt(problem.D[arena, side[0]])
    entries = root * wheeled.entries_of(problem, arena, side)
    index = wheeled.index_of(problem, arena, robot)
    for i in range(8):
        problem.scaled[k, i, index] = entries[i]
    problem.scaled[k, wheeled.AREF, index] = root * problem.aref[arena, side[0]]


@wp.kernel(enable_backward=False)
def _relax_each(problem: Problem, iterations: int) -> None:
    """Copies a robot's rows, and runs Newton's method if the robot touches no other robot."""
    arena, robot = wp.tid()
    index, own = wheeled.index_of(problem, arena, robot), problem.own[arena, robot]
    # Copy rows here and not in `_share_out`: there, neighbouring threads would copy one by one.
    for k in range(own):
        _scale(problem, arena, robot, k)
    if problem.touches[arena, robot]:
        return
    now = wheeled.of_robot(problem.qacc, arena, robot)
    done = wp.int32(0)
    moves = wp.bool(True)
    while moves and done < iterations:
        downhill = _newton(problem, arena, robot, now)
        moves = wp.bool(False)
        for k in range(own):
            slope = wp.dot(wheeled.scaled(problem, k, index), downhill)
            problem.scaled[k, wheeled.SLOPE, index] = slope
            moves = moves or wheeled.does_switch(problem.scaled[k, wheeled.GAP, index], slope)
        length = wp.float32(1.0)
        if moves:
            length = _length(problem, arena, robot, now, downhill)
        moves = wheeled.goes_on(moves, wp.max(wp.abs(downhill)), wp.max(wp.abs(now)))
        now = now + length * downhill
        done += 1
    wheeled.put_robot(problem.qacc, arena, robot, now)


@wp.func
def _newton(problem: Problem, arena: int, robot: int, now: Vector) -> Vector:
    """Returns Newton's step for the rows that are active at the accelerations `now`."""
    index = wheeled.index_of(problem, arena, robot)
    hessian = wheeled.inertia_of(problem, arena, robot)
    uphill = wheeled.times(hessian, now) - wheeled.of_robot(problem.force, arena, robot)
    for k in range(problem.own[arena, robot]):
        row = wheeled.scaled(problem, k, index)
        gap = wp.dot(row, now) - problem.scaled[k, wheeled.AREF, index]
        problem.scaled[k, wheeled.GAP, index] = gap
        if gap < 0.0:
            uphill = uphill + gap * row
            hessian = wheeled.add(hessian, row, row)
    return wheeled.substitute(wheeled.factor_of(hessian), -uphill)


@wp.func
def _length(problem: Problem, arena: int, robot: int, now: Vector, downhill: Vector) -> float:
    """Returns the step length with the least cost; the cost is convex along the step."""
    inertia = wheeled.inertia_of(problem, arena, robot)
    pull = wheeled.times(inertia, now) - wheeled.of_robot(problem.force, arena, robot)
    first, curve = wp.dot(pull, downhill), wp.dot(downhill, wheeled.times(inertia, downhill))
    begin = _tilt(problem, arena, robot, 0.0)[0] + first
    search = wp.vec3(0.0, 1e6, 1.0)
    for _ in range(wheeled.SEARCHES):
        bend = _tilt(problem, arena, robot, search[2])
        tilt = bend[0] + first + search[2] * curve
        if wp.abs(tilt) <= wheeled.FLAT * wp.abs(begin):
            break
        search = wheeled.narrow(search, tilt, bend[1] + curve)
    return search[2]


@wp.func
def _tilt(problem: Problem, arena: int, robot: int, length: float) -> wp.vec2:
    """Returns the first and second derivative of the cost of a robot's rows along a step."""
    index = wheeled.index_of(problem, arena, robot)
    tilt = wp.vec2()
    for k in range(problem.own[arena, robot]):
        tilt = tilt + wheeled.tilt_of(problem, k, index, length)
    return tilt
