"""Solves the contacts of wheeled robots that touch each other, together for all of an arena.

`wheeled_warp` describes the problem, and solves it for the robots that touch no other robot.

Newton's step solves H x = -g. The Hessian H is a block of 8 x 8 per robot, P, plus a term of rank
one per active contact between two robots. With the preconditioner P, conjugate gradients take at
most one step more than there are such contacts (Golub and Van Loan 2013, "Matrix Computations",
11.3.2 and 11.5.2). On a GPU, each robot has a thread of its own, and threads of an arena share a
CUDA warp.
"""

# Warp's types know neither the arguments of a struct nor the bodies of native functions.
# pyright: reportCallIssue=false

import warp as wp

from swarmjax.sim.fast import wheeled_problem as wheeled
from swarmjax.sim.fast.wheeled_problem import Problem, Together, Vector

MOST_THREADS = 32  # threads of a CUDA warp
_CONJUGATE = wp.constant(64)  # limit of steps of conjugate gradients
# Conjugate gradients end when the squared residual is this share of its first value. Newton's next
# iteration removes what is left.
_CLOSE = wp.constant(1e-8)


def _across_threads(join: str) -> str:
    """Returns CUDA code that joins `value` with the `other` value of each thread of the arena."""
    return f"""
#if defined(__CUDA_ARCH__)
    unsigned mask = 0xffffffffu >> (32 - threads) << (threadIdx.x % 32 / threads * threads);
    __syncwarp(mask);
    for (int away = threads / 2; away > 0; away /= 2) {{
        float other = __shfl_xor_sync(mask, value, away);
        value = {join};
    }}
#endif
    return value;
"""


@wp.func_native(_across_threads("value + other"))
def _sum(value: float, threads: int) -> float:
    """Waits until all threads of the arena have written their results; adds up their values."""
    ...


@wp.func_native(_across_threads("fmaxf(value, other)"))
def _largest(value: float, threads: int) -> float:
    """Waits as `_sum` does; returns the largest value of the arena's threads."""
    ...


@wp.kernel(enable_backward=False)
def relax_pairs(
    problem: Problem, together: Together, iterations: int, threads: int, niter: wp.array[int]
) -> None:
    """Runs Newton's method for those robots of an arena that touch another robot."""
    turn, thread = wp.tid()
    if turn < together.crowded[0]:
        arena = together.arena[turn]
        done = wp.int32(0)
        moves = wp.bool(True)
        while moves and done < iterations:
            close = _begin(problem, together, arena, thread, threads)
            left = close
            steps = wp.int32(0)
            while left > _CLOSE * close and steps < _CONJUGATE:
                left = _conjugate(problem, together, arena, thread, threads, left)
                steps += 1
            moves = _take(problem, together, arena, thread, threads)
            done += 1
        if thread == 0:
            niter[arena] = done


@wp.func
def _far(problem: Problem, arena: int, robot: int, k: int, of_joints: wp.array2d[float]) -> float:
    """Returns J times a vector, but only the other robot's part, for a robot's row k."""
    found = wp.float32(0.0)
    side = problem.row[arena, robot, k]
    if side[2] == wheeled.SHARED:
        other = problem.first[arena, side[0]]
        if other[0] == robot:
            other = problem.second[arena, side[0]]
        entries = wheeled.entries_of(problem, arena, other)
        root = wp.sqrt(problem.D[arena, side[0]])
        found = root * wp.dot(entries, wheeled.of_robot(of_joints, arena, other[0]))
    return found


@wp.func
def _begin(problem: Problem, together: Together, arena: int, thread: int, threads: int) -> float:
    """Begins conjugate gradients for Newton's step; returns the squared residual."""
    total = wp.float32(0.0)
    for robot in range(thread, problem.own.shape[1], threads):
        if problem.touches[arena, robot]:
            wheeled.put_robot(together.step, arena, robot, Vector())
            index = wheeled.index_of(problem, arena, robot)
            hessian = wheeled.inertia_of(problem, arena, robot)
            now = wheeled.of_robot(problem.qacc, arena, robot)
            downhill = wheeled.of_robot(problem.force, arena, robot) - wheeled.times(hessian, now)
            for k in range(problem.own[arena, robot]):
                row = wheeled.scaled(problem, k, index)
                gap = wp.dot(row, now) + _far(problem, arena, robot, k, problem.qacc)
                gap -= problem.scaled[k, wheeled.AREF, index]
                problem.scaled[k, wheeled.GAP, index] = gap
                if gap < 0.0:
                    downhill = downhill - gap * row
                    if problem.row[arena, robot, k][2] != wheeled.SHARED:
                        hessian = wheeled.add(hessian, row, row)
            factor = wheeled.factor_of(hessian)
            way = wheeled.substitute(factor, downhill)
            together.factor[arena, robot] = factor
            wheeled.put_robot(together.rest, arena, robot, downhill)
            wheeled.put_robot(together.way, arena, robot, way)
            total += wp.dot(downhill, way)
    return _sum(total, threads)


@wp.func
def _conjugate(
    problem: Problem, together: Together, arena: int, thread: int, threads: int, left: float
) -> float:
    """Takes a step of conjugate gradients; returns the squared residual that is left."""
    curve = wp.float32(0.0)
    for robot in range(thread, problem.own.shape[1], threads):
        if problem.touches[arena, robot]:
            way = wheeled.of_robot(together.way, arena, robot)
            bend = _bend(problem, together, arena, robot, way)
            wheeled.put_robot(together.bend, arena, robot, bend)
            curve += wp.dot(way, bend)
    length = left / _sum(curve, threads)
    rest = wp.float32(0.0)
    for robot in range(thread, problem.own.shape[1], threads):
        if problem.touches[arena, robot]:
            step = wheeled.of_robot(together.step, arena, robot)
            way = wheeled.of_robot(together.way, arena, robot)
            wheeled.put_robot(together.step, arena, robot, step + length * way)
            residual = wheeled.of_robot(together.rest, arena, robot)
            residual = residual - length * wheeled.of_robot(together.bend, arena, robot)
            wheeled.put_robot(together.rest, arena, robot, residual)
            down = wheeled.substitute(together.factor[arena, robot], residual)
            wheeled.put_robot(together.bend, arena, robot, down)
            rest += wp.dot(residual, down)
    rest = _sum(rest, threads)
    for robot in range(thread, problem.own.shape[1], threads):
        if problem.touches[arena, robot]:
            down = wheeled.of_robot(together.bend, arena, robot)
            way = wheeled.of_robot(together.way, arena, robot)
            wheeled.put_robot(together.way, arena, robot, down + rest / left * way)
    return _largest(rest, threads)  # no thread reads a direction before all are written


@wp.func
def _bend(problem: Problem, together: Together, arena: int, robot: int, way: Vector) -> Vector:
    """Multiplies the Hessian by the present direction; returns the robot's eight values."""
    index = wheeled.index_of(problem, arena, robot)
    bend = wheeled.times(wheeled.inertia_of(problem, arena, robot), way)
    for k in range(problem.own[arena, robot]):
        if problem.scaled[k, wheeled.GAP, index] < 0.0:
            row = wheeled.scaled(problem, k, index)
            along = wp.dot(row, way) + _far(problem, arena, robot, k, together.way)
            bend = bend + along * row
    return bend


@wp.func
def _take(problem: Problem, together: Together, arena: int, thread: int, threads: int) -> bool:
    """Takes Newton's step; returns whether another step is needed."""
    switches = wp.float32(0.0)
    for robot in range(thread, problem.own.shape[1], threads):
        if problem.touches[arena, robot]:
            index = wheeled.index_of(problem, arena, robot)
            step = wheeled.of_robot(together.step, arena, robot)
            for k in range(problem.own[arena, robot]):
                slope = wp.dot(wheeled.scaled(problem, k, index), step)
                slope += _far(problem, arena, robot, k, together.step)
                problem.scaled[k, wheeled.SLOPE, index] = slope
                if wheeled.does_switch(problem.scaled[k, wheeled.GAP, index], slope):
                    switches = wp.float32(1.0)
    switches = _largest(switches, threads)
    length = wp.float32(1.0)
    if switches > 0.0:
        length = _length(problem, together, arena, thread, threads)
    most, longest = wp.float32(0.0), wp.float32(0.0)
    for robot in range(thread, problem.own.shape[1], threads):
        if problem.touches[arena, robot]:
            now = wheeled.of_robot(problem.qacc, arena, robot)
            step = wheeled.of_robot(together.step, arena, robot)
            most = wp.max(most, wp.max(wp.abs(now)))
            longest = wp.max(longest, wp.max(wp.abs(step)))
            wheeled.put_robot(problem.qacc, arena, robot, now + length * step)
    most, longest = _largest(most, threads), _largest(longest, threads)
    return wheeled.goes_on(switches > 0.0, longest, most)


@wp.func
def _length(problem: Problem, together: Together, arena: int, thread: int, threads: int) -> float:
    """Returns the best length of the joint step, as `wheeled_warp` does for a single robot."""
    first, curve = wp.float32(0.0), wp.float32(0.0)
    for robot in range(thread, problem.own.shape[1], threads):
        if problem.touches[arena, robot]:
            inertia = wheeled.inertia_of(problem, arena, robot)
            step = wheeled.of_robot(together.step, arena, robot)
            now = wheeled.of_robot(problem.qacc, arena, robot)
            pull = wheeled.times(inertia, now) - wheeled.of_robot(problem.force, arena, robot)
            first += wp.dot(pull, step)
            curve += wp.dot(wheeled.times(inertia, step), step)
    first, curve = _sum(first, threads), _sum(curve, threads)
    begin = _tilt(problem, arena, thread, threads, 0.0)[0] + first
    search = wp.vec3(0.0, 1e6, 1.0)
    for _ in range(wheeled.SEARCHES):
        bend = _tilt(problem, arena, thread, threads, search[2])
        tilt = bend[0] + first + search[2] * curve
        if wp.abs(tilt) <= wheeled.FLAT * wp.abs(begin):
            break
        search = wheeled.narrow(search, tilt, bend[1] + curve)
    return search[2]


@wp.func
def _tilt(problem: Problem, arena: int, thread: int, threads: int, length: float) -> wp.vec2:
    """Returns the first and second derivative of the cost of all these rows along the step."""
    tilt = wp.vec2()
    for robot in range(thread, problem.own.shape[1], threads):
        if problem.touches[arena, robot]:
            for k in range(problem.own[arena, robot]):
                # Both robots of a shared row add it, so each adds half.
                part = wp.where(problem.row[arena, robot, k][2] == wheeled.SHARED, 0.5, 1.0)
                index = wheeled.index_of(problem, arena, robot)
                tilt = tilt + part * wheeled.tilt_of(problem, k, index, length)
    return wp.vec2(_sum(tilt[0], threads), _sum(tilt[1], threads))
