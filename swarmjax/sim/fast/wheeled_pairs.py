"""Solves the contacts of wheeled robots that touch each other, together for all of them.

`wheeled_warp` describes the problem, and solves it for the robots that touch no other robot.
"""

import warp as wp

from swarmjax.sim.fast import wheeled_problem as wheeled
from swarmjax.sim.fast.wheeled_problem import Matrix, Problem, Together, Vector

# One in SPREAD threads solves an arena, and the others do nothing. If all 32 threads of a CUDA warp
# solved arenas, they would read from 32 different places, one after the other.
SPREAD = wp.constant(4)


@wp.kernel(enable_backward=False)
def relax_pairs(
    problem: Problem, together: Together, robots: int, iterations: int, niter: wp.array[int]
) -> None:
    """Runs Newton's method for those robots of an arena that touch another robot."""
    turn = wp.tid() / SPREAD
    if wp.tid() % SPREAD == 0 and turn < together.crowded[0]:
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
    """Lists the rows of J that involve two robots."""
    count = wp.int32(0)
    for robot in range(robots):
        if problem.touches[arena, robot]:
            for k in range(problem.own[arena, robot]):
                side = problem.row[arena, robot, k]
                if side[2] == wheeled.SHARED and problem.first[arena, side[0]][0] == robot:
                    together.row[arena, count] = side[0]
                    count += 1
    together.count[arena] = count


@wp.func
def _along(problem: Problem, arena: int, row: int, of_joints: wp.array2d[float]) -> float:
    """Multiplies a row of J that involves two robots by one value per joint of these robots."""
    first, second = problem.first[arena, row], problem.second[arena, row]
    total = _along_side(problem, arena, first, of_joints)
    return total + _along_side(problem, arena, second, of_joints)


@wp.func
def _along_side(
    problem: Problem, arena: int, side: wp.vec3i, of_joints: wp.array2d[float]
) -> float:
    """Multiplies a row's entries for one robot by one value per joint of this robot."""
    entries = wheeled.entries_of(problem, arena, side)
    return wp.dot(entries, wheeled.of_robot(of_joints, arena, side[0]))


@wp.func
def _pick(problem: Problem, together: Together, arena: int) -> None:
    """Finds which rows between two robots are active, and which of them become separate terms."""
    taken = wp.int32(0)
    for k in range(together.count[arena]):
        row = together.row[arena, k]
        gap = _along(problem, arena, row, problem.qacc) - problem.aref[arena, row]
        together.gap[arena, row] = gap
        together.slot[arena, row] = -1
        if gap < 0.0 and taken < wheeled.PAIRS:
            together.slot[arena, row] = taken
            together.pair[arena, taken] = row
            taken += 1
    together.taken[arena] = taken


@wp.func
def _descend(problem: Problem, together: Together, arena: int, robot: int) -> None:
    """Computes a robot's step without the separate terms, and its block's Cholesky factor."""
    wheeled.put_robot(together.step, arena, robot, Vector())
    if problem.touches[arena, robot]:
        hessian = wheeled.inertia_of(problem, arena, robot)
        now = wheeled.of_robot(problem.qacc, arena, robot)
        uphill = wheeled.times(hessian, now) - wheeled.of_robot(problem.force, arena, robot)
        for k in range(problem.own[arena, robot]):
            side = problem.row[arena, robot, k]
            slope = wheeled.entries_of(problem, arena, side)
            if side[2] != wheeled.SHARED:
                gap = wp.dot(slope, now) - problem.aref[arena, side[0]]
                together.gap[arena, side[0]] = gap
                together.slot[arena, side[0]] = -1
            if together.gap[arena, side[0]] < 0.0:
                weighted = problem.D[arena, side[0]] * slope
                uphill = uphill + together.gap[arena, side[0]] * weighted
                if together.slot[arena, side[0]] < 0:
                    hessian = wheeled.add(hessian, weighted, slope)
        factor = wheeled.factor_of(hessian)
        together.factor[arena, robot] = factor
        wheeled.put_robot(together.step, arena, robot, wheeled.substitute(factor, -uphill))


@wp.func
def _couple(problem: Problem, together: Together, arena: int) -> None:
    """Adds the separate terms to the step, by the Woodbury identity."""
    taken = together.taken[arena]
    matrix = wp.identity(n=8, dtype=wp.float32) + Matrix()
    right = Vector()
    for i in range(taken):
        row = together.pair[arena, i]
        right[i] = _along(problem, arena, row, together.step)
        for side in range(2):
            mine = _side(problem, arena, row, side)
            factor = together.factor[arena, mine[0]]
            slope = wheeled.entries_of(problem, arena, mine)
            together.response[arena, i, side] = wheeled.substitute(factor, slope)
        matrix[i, i] = 1.0 / problem.D[arena, row]
    for i in range(taken):
        for j in range(i + 1):
            for sides in range(4):
                push = _overlap(problem, together, arena, i, j, sides)
                matrix[i, j] = matrix[i, j] + push
    force = wheeled.substitute(wheeled.factor_of(matrix), right)
    for i in range(taken):
        for side in range(2):
            robot = _side(problem, arena, together.pair[arena, i], side)[0]
            step = wheeled.of_robot(together.step, arena, robot)
            response = together.response[arena, i, side]
            wheeled.put_robot(together.step, arena, robot, step - force[i] * response)


@wp.func
def _side(problem: Problem, arena: int, row: int, side: int) -> wp.vec3i:
    """Returns the argument `side` of `entries_of` for the first or the second robot of a row."""
    return wp.where(side == 0, problem.first[arena, row], problem.second[arena, row])


@wp.func
def _overlap(problem: Problem, together: Together, arena: int, i: int, j: int, sides: int) -> float:
    """Returns the effect of pair j along pair i through one robot, which `sides` picks in both."""
    row = together.pair[arena, i]
    mine = _side(problem, arena, row, sides % 2)
    theirs = _side(problem, arena, together.pair[arena, j], sides // 2)
    if mine[0] != theirs[0]:
        return 0.0
    return wp.dot(wheeled.entries_of(problem, arena, mine), together.response[arena, j, sides // 2])


@wp.func
def _take(problem: Problem, together: Together, arena: int, robots: int) -> bool:
    """Takes the step; returns whether another step is needed."""
    switches = wp.bool(False)
    for k in range(together.count[arena]):
        row = together.row[arena, k]
        slope = _along(problem, arena, row, together.step)
        together.slope[arena, row] = slope
        switches = switches or wheeled.does_switch(together.gap[arena, row], slope)
    for robot in range(robots):
        if problem.touches[arena, robot]:
            switches = _slopes(problem, together, arena, robot) or switches
    length = wp.float32(1.0)
    if switches:
        length = _length_together(problem, together, arena, robots)
    largest, longest = wp.float32(0.0), wp.float32(0.0)
    for robot in range(robots):
        if problem.touches[arena, robot]:
            now = wheeled.of_robot(problem.qacc, arena, robot)
            step = wheeled.of_robot(together.step, arena, robot)
            largest = wp.max(largest, wp.max(wp.abs(now)))
            longest = wp.max(longest, wp.max(wp.abs(step)))
            wheeled.put_robot(problem.qacc, arena, robot, now + length * step)
    return wheeled.goes_on(switches, longest, largest)


@wp.func
def _slopes(problem: Problem, together: Together, arena: int, robot: int) -> bool:
    """Computes J times the step for a robot's own rows; returns whether any row switches."""
    switches = wp.bool(False)
    step = wheeled.of_robot(together.step, arena, robot)
    for k in range(problem.own[arena, robot]):
        side = problem.row[arena, robot, k]
        if side[2] != wheeled.SHARED:
            slope = wp.dot(wheeled.entries_of(problem, arena, side), step)
            together.slope[arena, side[0]] = slope
            switches = switches or wheeled.does_switch(together.gap[arena, side[0]], slope)
    return switches


@wp.func
def _length_together(problem: Problem, together: Together, arena: int, robots: int) -> float:
    """Returns the best length of the joint step, as `_length` does for a single robot."""
    first, curve = wp.float32(0.0), wp.float32(0.0)
    for robot in range(robots):
        if problem.touches[arena, robot]:
            inertia = wheeled.inertia_of(problem, arena, robot)
            step = wheeled.of_robot(together.step, arena, robot)
            now = wheeled.of_robot(problem.qacc, arena, robot)
            pull = wheeled.times(inertia, now) - wheeled.of_robot(problem.force, arena, robot)
            first += wp.dot(pull, step)
            curve += wp.dot(wheeled.times(inertia, step), step)
    begin = _tilt_together(problem, together, arena, robots, 0.0)[0] + first
    search = wp.vec3(0.0, 1e6, 1.0)
    for _ in range(wheeled.SEARCHES):
        bend = _tilt_together(problem, together, arena, robots, search[2])
        tilt = bend[0] + first + search[2] * curve
        if wp.abs(tilt) <= wheeled.FLAT * wp.abs(begin):
            break
        search = wheeled.narrow(search, tilt, bend[1] + curve)
    return search[2]


@wp.func
def _tilt_together(
    problem: Problem, together: Together, arena: int, robots: int, length: float
) -> wp.vec2:
    """Returns the first and second derivative of the cost of all these rows along the step."""
    tilt = wp.vec2()
    for k in range(together.count[arena]):
        tilt = tilt + _tilt_of(problem, together, arena, together.row[arena, k], length)
    for robot in range(robots):
        if problem.touches[arena, robot]:
            for k in range(problem.own[arena, robot]):
                side = problem.row[arena, robot, k]
                if side[2] != wheeled.SHARED:
                    tilt = tilt + _tilt_of(problem, together, arena, side[0], length)
    return tilt


@wp.func
def _tilt_of(problem: Problem, together: Together, arena: int, row: int, length: float) -> wp.vec2:
    """Returns the first and second derivative of one row's cost along the step."""
    slope = together.slope[arena, row]
    push = wp.min(0.0, together.gap[arena, row] + length * slope)
    weight = wp.where(push < 0.0, problem.D[arena, row] * slope, 0.0)
    return weight * wp.vec2(push, slope)
