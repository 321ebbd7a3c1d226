"""Episodes in MuJoCo's C engine: the independent judge of policies.

The policy is NumPy, the engine is not the one that trained, its solver converges, and the
infrared sensors are MuJoCo's rays on the real shapes. Only the rules of the task are shared with
training; `task/env.py` is what a step here mirrors. No JAX.

Episode n of a seed starts from the same level whatever else is asked for, and every arena is
computed on its own, so that a result does not depend on how the work is split up.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import mujoco
import numpy as np

from swarmjax import epuck, policy
from swarmjax.config import ConfigError, EvaluateConfig, substeps
from swarmjax.policy import Policy, PolicyError
from swarmjax.sim import drive as sim_drive
from swarmjax.sim import gaps, infrared
from swarmjax.sim import model as sim_model
from swarmjax.sim.geom import FLOOR_GROUP, HULL_GROUP
from swarmjax.task import factors as task_factors
from swarmjax.task import level, observation, senses
from swarmjax.task import stage as task_stage
from swarmjax.task.factors import Factors
from swarmjax.task.senses import Electronics, Memory, Sight

SOLVER_ITERATIONS = 100  # MuJoCo's own default: until its tolerance of 1e-8 is met
# Rays pass through contact spheres, wheels, skids and floor.
_RAY_GROUPS = np.array([i not in (HULL_GROUP, FLOOR_GROUP) for i in range(6)], np.uint8)


@dataclass(frozen=True, kw_only=True, eq=False)
class Judge:
    """What all arenas of an evaluation share.

    Attributes:
        config: Of the evaluation.
        policy: Who drives.
        stage: Of the levels, fields [].
        spacing: Sizes that levels are drawn with.
        drive: The robot's drive, with the range of commands that the policy was trained for.
        electronics: What lies between policy and world; it observes as the policy was trained to.
        model: One arena, compiled.
        ids: Rows of its moving bodies.
        geom_robot: Of each of its geoms the robot whose contact geom it is, else -1.
        geom_kind: Of each of its geoms the index in `gaps.KINDS` of what it belongs to.
        substeps: Physics steps of a control step.
    """

    config: EvaluateConfig
    policy: Policy
    stage: task_stage.Stage
    spacing: level.Spacing
    drive: sim_drive.Drive
    electronics: Electronics
    model: mujoco.MjModel
    ids: sim_model.Ids
    geom_robot: np.ndarray
    geom_kind: np.ndarray
    substeps: int


class Outcome(NamedTuple):
    """What episodes came to, or have come to so far.

    Attributes:
        clock: [A] control steps since the start.
        arrived: [A, R] whether the robot has arrived.
        arrival: [A, R] control steps until it arrived, 0 if it has not.
        contacts: [A, R, 3] contacts of each kind of `gaps.KINDS`.
        sensed: [A, R] control steps before arrival with an infrared ray shorter than its range.
        moving: [A, R] control steps before arrival.
    """

    clock: np.ndarray
    arrived: np.ndarray
    arrival: np.ndarray
    contacts: np.ndarray
    sensed: np.ndarray
    moving: np.ndarray


class Arenas(NamedTuple):
    """Arenas between two control steps. Of these, MuJoCo edits `data` in place.

    Attributes:
        model: [A] of `MjModel`, all the same one unless robots differ from the nominal one.
        data: [A] of `MjData`, positions up to date.
        factors: [A] of the episodes.
        memory: [A] of the robots' electronics.
        target: [A, R, 2] x (m), y (m).
        obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m).
        observation: [A, R, O].
        apart: [A, R, 3] for how long there was no contact of each kind, s.
        outcome: Since the start.
    """

    model: np.ndarray
    data: np.ndarray
    factors: Factors
    memory: Memory
    target: np.ndarray
    obstacle: np.ndarray
    observation: np.ndarray
    apart: np.ndarray
    outcome: Outcome


def load(config: EvaluateConfig, trained: Policy) -> Judge:
    """Compiles the arena of a stage, with no more robots and obstacles than it has.

    Args:
        config: Of the evaluation.
        trained: The policy to judge.

    Returns:
        The judge.

    Raises:
        PolicyError: If the policy observes something else, or has too few learners.
    """
    _check_policy(config, trained)
    stage = task_stage.select(task_stage.stack([config.stage]), np.intp(0))
    robots, obstacles = config.stage.robots, config.stage.obstacles
    size = sim_model.ArenaSize(robots, obstacles, task_stage.largest_half([config.stage]))
    spacing = level.Spacing(robots, obstacles, config.robot.hull_radius, config.task.target_radius)
    compiled = _compile(config, size, draw_level(stage, spacing, config.seed, 0))
    ids = sim_model.ids(compiled, size)
    geom_robot, geom_kind = _geoms(compiled, ids)
    return Judge(
        config=config,
        policy=trained,
        stage=stage,
        spacing=spacing,
        drive=sim_drive.from_config(config.robot)._replace(
            max_speed=trained.max_speed, max_turn_rate=trained.max_turn_rate
        ),
        electronics=senses.load(config.task, config.realism, trained.encoding),
        model=compiled,
        ids=ids,
        geom_robot=geom_robot,
        geom_kind=geom_kind,
        substeps=_substeps(config),
    )


def _substeps(config: EvaluateConfig) -> int:
    """Physics steps of a control step: half as long as in training, where nothing else is given.

    A wheel that slips while its robot is blocked hops, since MuJoCo's contacts, like all convex
    ones, separate surfaces that slide: by 1.3 mm in steps of 16 ms, by 0.8 mm from 8 ms down.
    """
    finer = 2 if config.robot.body == "wheeled" and config.substeps is None else 1
    return finer * substeps(config.robot, config.substeps)


def _compile(
    config: EvaluateConfig, size: sim_model.ArenaSize, example: level.Level
) -> mujoco.MjModel:
    """Compiles the arena for obstacles of the sizes that they have in any level of the stage."""
    timestep = config.task.control_step / _substeps(config)
    robot = task_factors.largest(config.robot, config.realism)
    spec = sim_model.build(robot, size, timestep, ray_geoms=True)
    spec.option.iterations = SOLVER_ITERATIONS
    # Rather numbers that are not finite than a robot put back to where its world began.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # Compiled in rather than set later, so that MuJoCo derives its bounds from them.
    for i, half in enumerate(example.obstacle[:, 3:]):
        spec.geom(f"obstacle{i}_box").size[:2] = half
    return spec.compile()


def _geoms(compiled: mujoco.MjModel, ids: sim_model.Ids) -> tuple[np.ndarray, np.ndarray]:
    """Tells of each geom whose contact geom it is, and of what kind."""
    robot = np.full(compiled.ngeom, -1)
    kind = np.full(compiled.ngeom, gaps.KINDS.index("wall"))
    kind[ids.obstacle_geom] = gaps.KINDS.index("obstacle")
    for i in range(len(ids.hull_body)):
        hull = compiled.geom(f"robot{i}_hull").id
        robot[hull], kind[hull] = i, gaps.KINDS.index("robot")
    return robot, kind


def _check_policy(config: EvaluateConfig, trained: Policy) -> None:
    found = tuple(trained.meta["observation"]["names"])
    if found != observation.NAMES:
        raise PolicyError(
            f"{config.policy} observes {', '.join(found)}: expected {', '.join(observation.NAMES)}."
        )
    learners = len(trained.log_std)
    if not trained.is_shared and config.stage.robots > learners:
        raise PolicyError(
            f"{config.policy} holds a network for each of {learners} robots, but stage.robots is "
            f"{config.stage.robots}: give 1 to {learners}."
        )


def draw_level(
    stage: task_stage.Stage, spacing: level.Spacing, seed: int, episode: int
) -> level.Level:
    """Draws the level that an episode starts from.

    Args:
        stage: Fields [].
        spacing: Sizes.
        seed: Of the evaluation.
        episode: Its number.

    Returns:
        The level, as NumPy arrays.
    """
    count = level.uniform_count(spacing)
    uniforms = np.random.default_rng([seed, episode]).random(count, dtype=np.float32)
    return level.sample(uniforms, stage, spacing, np)


def simulate(judge: Judge, episodes: Sequence[int]) -> Outcome:
    """Runs episodes side by side, each until all its robots have arrived or the time is out.

    Args:
        judge: What the arenas share.
        episodes: Their numbers.

    Returns:
        What they came to, in their order.

    Raises:
        ConfigError: If the physics of an episode breaks down.
    """
    rows, seed = np.arange(len(episodes)), judge.config.seed
    levels = [draw_level(judge.stage, judge.spacing, seed, episode) for episode in episodes]
    arenas = start(judge, levels)
    total = Outcome(*(np.zeros_like(field) for field in arenas.outcome))
    for _ in range(judge.config.steps):
        arenas = step(judge, arenas)
        for whole, part in zip(total, arenas.outcome, strict=True):
            whole[rows] = part
        running = ~arenas.outcome.arrived.all(axis=-1)
        if not running.all():
            rows, arenas = rows[running], _select(arenas, running)
        if not len(rows):
            break
    return total


def _select(tree: Any, rows: Any) -> Any:
    """Keeps some of the arenas, in tuples of arrays however deep."""
    if tree is None:
        return None
    if isinstance(tree, np.ndarray):
        return tree[rows]
    return type(tree)(*(_select(part, rows) for part in tree))


def start(judge: Judge, levels: Sequence[level.Level]) -> Arenas:
    """Starts episodes.

    Args:
        judge: What the arenas share.
        levels: [A], with no more robots and obstacles than the judge's stage has.

    Returns:
        The arenas at rest, observed.
    """
    pose, target, obstacle, seed, side = (
        np.stack([getattr(each, name) for each in levels])
        for name in ("start", "target", "obstacle", "seed", "side")
    )
    pose, target, obstacle = (x.astype(np.float64) for x in (pose, target, obstacle))
    factors = task_factors.draw(
        seed, judge.config.realism, judge.config.robot, *judge.spacing[:2], np
    )
    model = _models(judge, factors, len(levels))
    data = np.empty(len(levels), object)
    data[:] = [place(judge, *each) for each in zip(model, pose, obstacle, side, strict=True)]
    outcome = _no_outcome(len(levels), judge.spacing.robots)
    sight = look(judge, data, factors, pose, target, obstacle)
    memory, seen = senses.begin(judge.electronics, factors, sight, outcome.clock, np)
    return Arenas(
        model=model,
        data=data,
        factors=factors,
        memory=memory,
        target=target,
        obstacle=obstacle,
        observation=seen,
        apart=np.full(outcome.contacts.shape, gaps.CONTACT_PAUSE),
        outcome=outcome,
    )


def _no_outcome(count: int, robots: int) -> Outcome:
    """Returns what episodes have come to that have just begun."""
    none = np.zeros((count, robots), np.int64)
    return Outcome(
        clock=none[:, 0],
        arrived=none.astype(bool),
        arrival=none,
        contacts=np.zeros((count, robots, len(gaps.KINDS)), np.int64),
        sensed=none,
        moving=none,
    )


def _models(judge: Judge, factors: Factors, count: int) -> np.ndarray:
    """Returns the models [A] of arenas, each with the robots that its episode has."""
    models = np.full(count, judge.model, object)
    chassis = senses.chassis(factors)
    if all(part is None for part in chassis):
        return models
    body = sim_model.BODIES[judge.config.robot.body]
    for i in range(count):
        models[i] = copy.copy(judge.model)
        mine = _select(chassis, i)
        changes = body.changes(mine, judge.ids.robots, judge.config.robot, judge.model)
        for name, (rows, values) in changes.items():
            getattr(models[i], name)[rows] = values
        # What MuJoCo derives from them: it reads the inertia of a planar robot from there.
        mujoco.mj_setConst(models[i], mujoco.MjData(models[i]))
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
        judge: What the arenas share.
        model: Of the arena.
        pose: [R, 3] x (m), y (m), yaw (rad).
        obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m; those the model was compiled for).
        side: Of the arena, m; the stage's if there is none.

    Returns:
        The arena, its positions up to date.
    """
    data = mujoco.MjData(model)
    length = np.float64(judge.stage.side if side is None else side)
    where, turn = sim_model.fixture_poses(length, obstacle, np)
    data.mocap_pos[judge.ids.fixture_mocap] = where
    data.mocap_quat[judge.ids.fixture_mocap] = turn
    data.qpos = sim_model.BODIES[judge.config.robot.body].qpos(pose, np)
    mujoco.mj_step1(model, data)
    return data


def step(judge: Judge, arenas: Arenas) -> Arenas:
    """Moves arenas on by one control step; what happens in it is what `task.env.step` says.

    Args:
        judge: What the arenas share.
        arenas: Their state before.

    Returns:
        Their state after.

    Raises:
        ConfigError: If a position is not finite.
    """
    task, before = judge.config.task, arenas.outcome
    active = ~before.arrived
    memory, pose = _drive(judge, arenas, active)
    sight = look(judge, arenas.data, arenas.factors, pose, arenas.target, arenas.obstacle)
    arrives = active & (sight.distance <= task.target_radius)
    gap = np.where(touching(judge, arenas.data), 0.0, np.inf)
    begins, apart = gaps.count_contacts(gap, arenas.apart, task.control_step, np)
    clock = before.clock + 1
    memory, seen = senses.sense(judge.electronics, memory, arenas.factors, sight, clock, np)
    outcome = Outcome(
        clock=clock,
        arrived=before.arrived | arrives,
        arrival=np.where(arrives, clock[:, None], before.arrival),
        contacts=before.contacts + begins,
        sensed=before.sensed + (active & (sight.ray < task.sensor_range).any(axis=-1)),
        moving=before.moving + active,
    )
    return arenas._replace(memory=memory, observation=seen, apart=apart, outcome=outcome)


def _drive(judge: Judge, arenas: Arenas, active: np.ndarray) -> tuple[Memory, np.ndarray]:
    """Lets the robots that are on their way drive; returns memory and new poses [A, R, 3]."""
    action = policy.mean_action(judge.policy, arenas.observation)
    wanted = sim_drive.command(action, judge.drive, np)
    memory, wheels = senses.drive(
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
    ctrl = body.ctrl(wheels, senses.chassis(arenas.factors), robot, np)
    qpos = np.stack(
        [_advance(judge, *each) for each in zip(arenas.model, arenas.data, ctrl, strict=True)]
    )
    if not np.isfinite(qpos).all():
        raise ConfigError(
            "the physics broke down, with positions that are not finite: give substeps of more "
            f"than {judge.substeps}, or a robot nearer to the real one."
        )
    return memory, body.pose(qpos, np)


def _advance(
    judge: Judge, model: mujoco.MjModel, data: mujoco.MjData, ctrl: np.ndarray
) -> np.ndarray:
    """Moves one arena on by a control step; returns a copy of its new positions."""
    data.ctrl = ctrl
    # The halves of mj_step, the other way round: the positions that the rays of this control
    # step need are those that the next one starts from.
    for _ in range(judge.substeps):
        mujoco.mj_step2(model, data)
        mujoco.mj_step1(model, data)
    return data.qpos.copy()


def touching(judge: Judge, data: np.ndarray) -> np.ndarray:
    """Tells which robots touch anything, by the contacts that MuJoCo found.

    Args:
        judge: What the arenas share.
        data: [A] of `MjData`, positions up to date.

    Returns:
        [A, R, 3] bool, in the order of `gaps.KINDS`.
    """
    pairs = [each.contact.geom for each in data]
    arena = np.repeat(np.arange(len(data)), [len(pair) for pair in pairs])
    first, second = np.concatenate(pairs).T
    found = np.zeros((len(data), judge.spacing.robots, len(gaps.KINDS)), bool)
    for mine, other in ((first, second), (second, first)):
        hull = judge.geom_robot[mine] >= 0
        found[arena[hull], judge.geom_robot[mine[hull]], judge.geom_kind[other[hull]]] = True
    return found


def look(
    judge: Judge,
    data: np.ndarray,
    factors: Factors,
    pose: np.ndarray,
    target: np.ndarray,
    obstacle: np.ndarray,
) -> Sight:
    """Finds out what there is to be sensed.

    Args:
        judge: What the arenas share.
        data: [A] of `MjData`, positions up to date.
        factors: [A] of the episodes.
        pose: [A, R, 3] x (m), y (m), yaw (rad).
        target: [A, R, 2] x (m), y (m).
        obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
        What the sensors have before them.
    """
    ray, geom = cast_rays(judge, data, pose, obstacle, senses.mount(factors))
    shades = senses.reflectance(factors)
    bright = None if shades is None else _brightness(judge, shades, geom)
    return Sight(ray, bright, *observation.to_target(pose, target, np))


def cast_rays(
    judge: Judge,
    data: np.ndarray,
    pose: np.ndarray,
    obstacle: np.ndarray,
    mount: infrared.Mount | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Casts the infrared sensors' rays by MuJoCo.

    A ray that starts inside something reads 0. MuJoCo reports where such a ray leaves, on a face
    whose normal points along it; so of each sensor two rays are cast, ahead and back, and the
    sensor is inside something if either of them leaves. Things overlap a little where robots
    push, so that a single ray may enter a second thing before it leaves the first.

    Args:
        judge: What the arenas share.
        data: [A] of `MjData`, positions up to date.
        pose: [A, R, 3] x (m), y (m), yaw (rad).
        obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m).
        mount: How far off the sensors sit.

    Returns:
        [A, R, K] distance from the sensor's origin to the nearest surface, m, 0 to the reach of
        the electronics; and the geom that is there, -1 where nothing is.
    """
    limit = judge.electronics.reach
    origin, direction = infrared.rays(pose, np, mount)
    near = _near(judge, origin + 0.5 * limit * direction, pose[..., :2], obstacle)
    arena, robot, _ = np.nonzero(near)
    origin, direction = origin[near], direction[near]
    flat = np.zeros((len(origin), 1))
    origin = np.concatenate([origin, flat + epuck.SENSOR_HEIGHT], axis=-1)
    toward = np.concatenate([direction, flat, -direction, flat], axis=-1)
    distance, normal = np.zeros((len(origin), 2)), np.zeros_like(toward)
    met = np.full((len(origin), 2), -1, np.int32)
    cast_one, far = partial(mujoco.mj_multiRay, judge.model), mujoco.mjMAXVAL
    body = judge.ids.hull_body[robot].tolist()
    rays = zip(data[arena], body, origin, toward, met, distance, normal, strict=True)
    for where, me, start, ways, geom, reach, face in rays:
        cast_one(where, start, ways, _RAY_GROUPS, True, me, geom, reach, face, 2, far)
    leaves = (normal * toward).reshape(-1, 2, 3).sum(axis=-1) > 0.0
    ahead = np.where(distance[:, 0] < 0.0, limit, distance[:, 0])  # -1: nothing there
    seen, geoms = np.full(near.shape, limit), np.full(near.shape, -1)
    seen[near] = np.where(leaves.any(axis=-1), 0.0, np.minimum(ahead, limit))
    geoms[near] = met[:, 0]
    return seen, geoms


def _brightness(judge: Judge, shades: infrared.Reflectance, geom: np.ndarray) -> np.ndarray:
    """Reflectance [A, R, K] of the geoms that rays meet; 1 of nothing."""
    model, table = judge.model, np.ones((len(geom), judge.model.ngeom + 1))  # the last: nothing
    obstacles = judge.ids.obstacle_geom
    fixtures = np.flatnonzero(model.body_mocapid[model.geom_bodyid] >= 0)
    if shades.wall is not None:
        table[:, np.setdiff1d(fixtures, obstacles)] = shades.wall[:, None]
    if shades.obstacle is not None:
        table[:, obstacles] = shades.obstacle
    if shades.robot is not None:
        hulls = [model.geom(f"robot{i}_body").id for i in range(judge.spacing.robots)]
        table[:, hulls] = shades.robot
    return np.take_along_axis(table, geom.reshape(len(geom), -1), axis=1).reshape(geom.shape)


def _near(judge: Judge, middle: np.ndarray, place: np.ndarray, obstacle: np.ndarray) -> np.ndarray:
    """Tells [A, R, K] whether a ray may meet anything, by circles about it and all things.

    Casting a ray costs more than all else, and most have nothing to meet. The walls are taken to
    stand where those of the stage's smallest arena do.

    Args:
        judge: What the arenas share.
        middle: [A, R, K, 2] of the rays, m.
        place: [A, R, 2] of the robots, m.
        obstacle: [A, M, 5] x (m), y (m), yaw (rad), half edges (m).

    Returns:
        [A, R, K].
    """
    myself = np.eye(place.shape[-2], dtype=bool)[:, None]
    robots = _apart(middle, place) - judge.spacing.hull_radius
    boxes = _apart(middle, obstacle[..., :2])
    boxes -= np.linalg.norm(obstacle[:, None, None, :, 3:], axis=-1)
    wall = 0.5 * judge.stage.side - np.abs(middle).max(axis=-1)
    things = [np.where(myself, np.inf, robots), boxes, wall[..., None]]
    radius = 0.5 * judge.electronics.reach
    return np.concatenate(things, axis=-1).min(axis=-1) <= radius


def _apart(ray: np.ndarray, thing: np.ndarray) -> np.ndarray:
    """Distances [A, R, K, N] from points [A, R, K, 2] to points [A, N, 2], m."""
    offset = ray[..., None, :] - thing[:, None, None]
    return np.sqrt(np.einsum("...i,...i", offset, offset))
