"""Episodes in MuJoCo's C engine: the independent judge of policies.

It is independent of training in four ways: the policy is computed with NumPy, the engine is another
one, its solver converges, and the infrared sensors are MuJoCo's rays on the real shapes. Training
and judge share only the rules of the task; a step here mirrors `task/env.py`. No JAX.

Episode n of a seed always starts from the same level, and every arena is computed by itself. So a
result does not depend on how the work is split up.
"""

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from swarmjax import policy
from swarmjax.config import ConfigError
from swarmjax.evaluate import contacts, measures, rays
from swarmjax.evaluate.judge import Judge
from swarmjax.evaluate.judge import draw_level as draw_level
from swarmjax.evaluate.judge import load as load
from swarmjax.evaluate.measures import Outcome
from swarmjax.policy import PolicyError
from swarmjax.sim import drive as sim_drive
from swarmjax.sim import gaps, noise
from swarmjax.sim import model as sim_model
from swarmjax.sim.noise import Stream
from swarmjax.task import electronics, level, observation
from swarmjax.task import factors as task_factors
from swarmjax.task.electronics import Memory, Sight
from swarmjax.task.factors import Factors
from swarmjax.task.goals.goal import Turn
from swarmjax.task.level import Level


class Arenas(NamedTuple):
    """Arenas between two control steps. MuJoCo edits `data` in place.

    Attributes:
      model: [A] of `MjModel`, one for all unless robots or boxes differ between episodes.
      data: [A] of `MjData`, positions up to date.
      factors: [A] factors of the episodes' robots.
      memory: [A] state of the robots' electronics.
      target: [A, R, 2] current targets, x (m), y (m).
      obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m).
      level: [A] levels that the episodes started from.
      goal: [A] state of the goal.
      earns: [A, R] whether the last step earned the reward `arrival`.
      pose: [A, R, 3] x (m), y (m), yaw (rad).
      observation: [A, R, O].
      apart: [A, R, 3] time since the last contact of each kind, s.
      outcome: Outcome since the start.
    """

    model: np.ndarray
    data: np.ndarray
    factors: Factors
    memory: Memory
    target: np.ndarray
    obstacle: np.ndarray
    level: Level
    goal: Any
    earns: np.ndarray
    pose: np.ndarray
    observation: np.ndarray
    apart: np.ndarray
    outcome: Outcome


def act(
    judge: Judge, memory: np.ndarray | None, arenas: Arenas
) -> tuple[np.ndarray | None, np.ndarray]:
    """Returns the policy's memory after this control step, and its actions [A, R, U].

    The random numbers of an action depend only on level and clock.

    Args:
      judge: Data that the arenas share.
      memory: The policy's memory, from `policy.begin` or the step before.
      arenas: The arenas.
    """
    normal: Any = 0.0
    if judge.config.action == "sampled":
        shape = (arenas.pose.shape[1], judge.policy.log_std.shape[1])
        normal = noise.normal(arenas.level.seed, arenas.outcome.clock, Stream.ACTION, shape, np)
    return policy.step(judge.policy, memory, arenas.observation, normal)


def simulate(judge: Judge, levels: Sequence[level.Level]) -> Outcome:
    """Runs episodes side by side, each until all its robots have arrived or the time is out.

    With `task.arrival=hold` an episode ends once all its robots are at their targets.

    Args:
      judge: Data that the arenas share.
      levels: Levels to start from.

    Returns:
      The outcomes of the episodes, in the order of `levels`.

    Raises:
      ConfigError: The physics of an episode breaks down.
    """
    rows, arenas = np.arange(len(levels)), start(judge, levels)
    memory = policy.begin(judge.policy, arenas.pose.shape[:2])
    total = Outcome(*(np.zeros_like(field) for field in arenas.outcome))
    for _ in range(judge.config.step_limit):
        memory, action = act(judge, memory, arenas)
        arenas = step(judge, arenas, action)
        for whole, part in zip(total, arenas.outcome, strict=True):
            whole[rows] = part
        running = ~is_over(judge, arenas.outcome)
        if not running.all():
            rows, arenas, memory = rows[running], *(_select(x, running) for x in (arenas, memory))
        if not len(rows):
            break
    return total


def is_over(judge: Judge, outcome: Outcome) -> np.ndarray:
    """Returns whether episodes [A] end because all robots have arrived."""
    return judge.goal.is_over(outcome.arrived, np.ones_like(outcome.arrived))


def _select(tree: Any, rows: Any) -> Any:
    """Keeps some of the arenas, in nested tuples of arrays."""
    if tree is None:
        return None
    if isinstance(tree, np.ndarray):
        return tree[rows]
    parts = [_select(part, rows) for part in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else type(tree)(parts)


def start(judge: Judge, levels: Sequence[level.Level]) -> Arenas:
    """Starts episodes.

    Args:
      judge: Data that the arenas share.
      levels: [A], with as many robots and boxes as the judge has.

    Returns:
      The arenas at rest, with their first observations.
    """
    begun = Level(*map(np.stack, zip(*levels, strict=True)))
    pose, target, obstacle = (
        x.astype(np.float64) for x in (begun.start, begun.target, begun.obstacle)
    )
    realism, boxes = judge.config.realism, obstacle.shape[1]
    robots, sensors = judge.spacing.robots, len(judge.config.robot.sensor_poses)
    factors = task_factors.draw(begun.seed, realism, robots, boxes, np, sensors)
    model = _models(judge, factors, obstacle[..., 3:])
    data = np.empty(len(levels), object)
    data[:] = [place(judge, *each) for each in zip(model, pose, obstacle, begun.side, strict=True)]
    goal, target = judge.goal.begin(begun._replace(target=target))
    outcome = measures.begin(pose[..., :2], np, len(judge.goal.measures))
    sight = look(judge, data, factors, pose, target, obstacle)
    sight = _look_by_extension(
        judge, sight, pose, begun._replace(target=target), outcome.arrived, outcome.clock
    )
    memory, seen = electronics.begin(judge.electronics, factors, sight, outcome.clock, np)
    return Arenas(
        model=model,
        data=data,
        factors=factors,
        memory=memory,
        target=target,
        obstacle=obstacle,
        level=begun,
        goal=goal,
        earns=outcome.arrived,
        pose=pose,
        observation=seen,
        apart=np.full(outcome.contacts.shape, gaps.CONTACT_PAUSE),
        outcome=outcome,
    )


def _models(judge: Judge, factors: Factors, half: np.ndarray) -> np.ndarray:
    """Returns the models [A] of arenas, with the robots and boxes [A, M, 2] of each episode."""
    models = _with_boxes(judge, half)
    chassis = electronics.chassis(factors)
    if all(part is None for part in chassis):
        return models
    body = sim_model.BODIES[judge.config.robot.body]
    for i in range(len(models)):
        models[i] = copy.copy(models[i])
        mine = _select(chassis, i)
        changes = body.changes(mine, judge.ids.robots, judge.config.robot, judge.model)
        for name, (rows, values) in changes.items():
            getattr(models[i], name)[rows] = values
        # Updates MuJoCo's derived constants, such as the inertia of a planar robot.
        mujoco.mj_setConst(models[i], mujoco.MjData(models[i]))
    return models


def _with_boxes(judge: Judge, half: np.ndarray) -> np.ndarray:
    """Returns models [A] with boxes of these half edges [A, M, 2].

    All arenas whose boxes equal those in the judge's model share that model.
    """
    models = np.full(len(half), judge.model, object)
    compiled = judge.model.geom_size[judge.ids.obstacle_geom, :2]
    for i in np.flatnonzero((half != compiled).any(axis=(1, 2))):
        models[i] = sim_model.resize_obstacles(judge.model, judge.ids, half[i])
    return models


def place(
    judge: Judge,
    model: mujoco.MjModel,
    pose: np.ndarray,
    obstacle: np.ndarray,
    side: np.float32 | None = None,
) -> mujoco.MjData:
    """Sets an arena up, at rest.

    Args:
      judge: Data that the arenas share.
      model: Model of the arena.
      pose: [R, 3] x (m), y (m), yaw (rad).
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m; equal to the model's).
      side: Side of the arena, m; None: the side that the stage gives.

    Returns:
      The arena, with positions up to date.
    """
    data = mujoco.MjData(model)
    length = np.float64(judge.stage.side if side is None else side)
    where, turn = sim_model.fixture_poses(length, obstacle, np)
    data.mocap_pos[judge.ids.fixture_mocap] = where
    data.mocap_quat[judge.ids.fixture_mocap] = turn
    data.qpos = sim_model.BODIES[judge.config.robot.body].qpos(pose, np)
    mujoco.mj_step1(model, data)
    return data


def step(judge: Judge, arenas: Arenas, action: np.ndarray | None = None) -> Arenas:
    """Moves arenas by one control step, by the rules of `task.env.step`.

    Args:
      judge: Data that the arenas share.
      arenas: Their state before the step.
      action: [A, R, U] actions of the robots, -1..1; None: the policy chooses them, and must have
        no memory.

    Returns:
      Their state after the step.

    Raises:
      ConfigError: A position is not finite.
    """
    task, before = judge.config.task, arenas.outcome.arrived
    if action is None:
        if judge.policy.carried:
            raise PolicyError("the policy has a memory: pass the action that `act` chooses.")
        _, action = act(judge, None, arenas)
    active, present = judge.goal.drives(before), np.ones_like(before)
    memory, pose = _drive(judge, arenas, action, active)
    sight = look(judge, arenas.data, arenas.factors, pose, arenas.target, arenas.obstacle)
    clock = arenas.outcome.clock + 1
    turn, level, sight = _turn(judge, arenas, sight, pose)
    arrived = turn.arrived
    touches = contacts.touching(judge, arenas.data)
    gap = np.where(touches, 0.0, np.inf)
    begins, apart = gaps.count_contacts(gap, arenas.apart, task.control_step, np)
    sight = _look_by_extension(judge, sight, pose, level, arrived, clock)
    memory, seen = electronics.sense(judge.electronics, memory, arenas.factors, sight, clock, np)
    events = measures.Events(
        start=arenas.pose[..., :2],
        place=pose[..., :2],
        arrived=arrived,
        begins=begins,
        touches=touches,
        sensed=(sight.ray < judge.config.robot.sensor_range).any(axis=-1),
        under_way=judge.goal.is_under_way(before),
        rests=~judge.goal.is_under_way(arrived),
        measured=judge.goal.measured(turn),
    )
    outcome = measures.tally(arenas.outcome, events, np)
    ends = judge.goal.terminates(before, arrived, present)
    return arenas._replace(
        memory=memory,
        target=level.target,
        goal=turn.state,
        earns=ends if turn.earns is None else turn.earns,
        pose=pose,
        observation=seen,
        apart=apart,
        outcome=outcome,
    )


def _turn(
    judge: Judge, arenas: Arenas, sight: Sight, pose: np.ndarray
) -> tuple[Turn, Level, Sight]:
    """Advances the goal; returns its turn, levels with new targets, and the sight of these."""
    levels, before = arenas.level._replace(target=arenas.target), arenas.outcome
    view = electronics.view(sight, pose, levels, before.arrived, before.clock + 1)
    turn = judge.goal.turn(arenas.goal, levels, view)
    if not judge.goal.moves:
        return turn, levels, sight
    levels = levels._replace(target=np.asarray(turn.target, np.float64))
    distance, bearing = observation.to_target(pose, levels.target, np)
    return turn, levels, sight._replace(distance=distance, bearing=bearing)


def _look_by_extension(
    judge: Judge,
    sight: Sight,
    pose: np.ndarray,
    levels: Level,
    arrived: np.ndarray,
    clock: np.ndarray,
) -> Sight:
    """Adds the observations of an extension."""
    if judge.own is None:
        return sight
    return sight._replace(own=judge.own(electronics.view(sight, pose, levels, arrived, clock)))


def _drive(
    judge: Judge, arenas: Arenas, action: np.ndarray, active: np.ndarray
) -> tuple[Memory, np.ndarray]:
    """Lets the active robots drive; returns memory and new poses [A, R, 3]."""
    wanted = sim_drive.command(action, judge.drive, np)
    memory, wheels = electronics.drive(
        judge.electronics,
        arenas.memory,
        arenas.factors,
        wanted,
        judge.drive,
        arenas.outcome.clock,
        np,
    )
    wheels = np.where(active[..., None], wheels, 0.0)
    body, robot = sim_model.BODIES[judge.config.robot.body], judge.config.robot
    ctrl = body.ctrl(wheels, electronics.chassis(arenas.factors), robot, np)
    for each in zip(arenas.model, arenas.data, ctrl, strict=True):
        _advance(judge, *each)
    qpos = np.stack([data.qpos for data in arenas.data])
    if not np.isfinite(qpos).all():
        raise ConfigError(
            "the physics broke down: some positions are not finite; raise substeps above "
            f"{judge.substeps}, or give a robot closer to the e-puck."
        )
    return memory, body.pose(qpos, np)


def _advance(judge: Judge, model: mujoco.MjModel, data: mujoco.MjData, ctrl: np.ndarray) -> None:
    """Moves one arena by a control step."""
    data.ctrl = ctrl
    # The two halves of mj_step run in reverse order, so that the rays of this control step see the
    # positions from which the next step starts.
    for _ in range(judge.substeps):
        mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)


def look(
    judge: Judge,
    data: np.ndarray,
    factors: Factors,
    pose: np.ndarray,
    target: np.ndarray,
    obstacle: np.ndarray,
) -> Sight:
    """Computes what the sensors measure.

    Args:
      judge: Data that the arenas share.
      data: [A] of `MjData`, positions up to date.
      factors: [A] factors of the episodes' robots.
      pose: [A, R, 3] x (m), y (m), yaw (rad).
      target: [A, R, 2] x (m), y (m).
      obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
      The sensors' view: rays, and the target's distance and bearing.
    """
    shades = electronics.reflectance(factors)
    ray, geom = rays.cast_rays(judge.scene, data, pose, obstacle, factors.infrared_yaw)
    bright = None if shades is None else rays.brightness(judge.scene, shades, geom)
    return Sight(ray, bright, *observation.to_target(pose, target, np))
