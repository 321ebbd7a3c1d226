"""Tests the judge against numbers worked out by hand, and against the training environment."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import policies
import pytest
import steering
from entries import BEARING, DISTANCE, INFRARED, KNOWN, TARGET
from steering import AHEAD, SPEED, SPIN, STAY, STEER, STEP, STRIDE

from swarmjax import policy
from swarmjax.config import ConfigError
from swarmjax.evaluate import contacts, engine_c
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.engine_c import Arenas
from swarmjax.evaluate.judge import Judge
from swarmjax.policy import PolicyError
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import gaps, infrared, model, noise, physics
from swarmjax.sim.config import RobotConfig, SimConfig
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task import electronics, env, observation
from swarmjax.task.config import TaskConfig
from swarmjax.task.env import EnvState, TimeStep
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig
from swarmjax.task.stage_files import load_levels
from swarmjax.task.world import World
from swarmjax.training import program as programs


def _stage(
    robots: int = 1,
    side: float | tuple[float, float] = 1.0,
    obstacles: int = 0,
    **rest: Any,
) -> StageConfig:
    return StageConfig(name="test", robots=robots, side=side, obstacles=obstacles, **rest)


def _judge(tmp_path: Path, stage: StageConfig, drive: tuple = STEER, **rest: Any) -> Judge:
    path = steering.write(tmp_path / "policy.npz", drive)
    robot = rest.pop("robot", RobotConfig())  # the planar body's motion is worked out by hand
    config = EvaluateConfig(policy=str(path), stage=stage, robot=robot, **rest)
    return engine_c.load(config, policy.load(path))


def _start(
    judge: Judge, pose: list, target: list | None = None, obstacle: list | None = None
) -> Arenas:
    """Starts one arena at given poses; a target that is not given lies far ahead, out of reach."""
    return engine_c.start(judge, [_level(judge, pose, target, obstacle)])


def _level(
    judge: Judge,
    pose: list,
    target: list | None = None,
    obstacle: list | None = None,
    seed: int = 0,
) -> Level:
    start = np.array(pose, np.float32)
    ahead = np.stack([np.cos(start[:, 2]), np.sin(start[:, 2])], axis=-1)
    robots, obstacles = len(start), len(obstacle or [])
    return Level(
        side=judge.stage.side,
        present=np.ones(robots, bool),
        start=start,
        target=start[:, :2] + 100 * ahead if target is None else np.array(target),
        obstacle_present=np.ones(obstacles, bool),
        obstacle=np.array(obstacle or np.zeros((0, 5)), np.float32),
        seed=np.uint32(seed),
    )


def _run(judge: Judge, arenas: Arenas, steps: int) -> Arenas:
    for _ in range(steps):
        arenas = engine_c.step(judge, arenas)
    return arenas


def _draw_some(judge: Judge, episodes: Sequence[int]) -> list[Level]:
    return [engine_c.draw_level(judge.stage, judge.spacing, 1, number) for number in episodes]


def _pose(arenas: Arenas) -> np.ndarray:
    return np.stack([data.qpos.reshape(-1, 3) for data in arenas.data])


def test_a_step_needs_the_action_of_a_policy_that_remembers(tmp_path: Path) -> None:
    given, said = policies.recalling(policies.arrays(), 3)
    trained = policies.saved(tmp_path / "recalls.npz", given, **said)
    judge = dataclasses.replace(_judge(tmp_path, _stage()), policy=trained)
    arenas = _start(judge, [[-0.1, 0.2, 0.0]])
    with pytest.raises(PolicyError, match=r"^the policy has a memory: pass the action that `act` "):
        engine_c.step(judge, arenas)


def test_a_robot_drives_straight_to_its_target_and_stays(tmp_path: Path) -> None:
    judge = _judge(tmp_path, _stage())
    arenas = _start(judge, [[-0.1, 0.2, 0.0]], [[0.2, 0.2]])
    # (0.3 - 0.05) / 0.0040192 = 62.2, so the robot is within 0.05 m after 63 control steps.
    steps = math.ceil((0.3 - 0.05) / STRIDE)
    assert steps == 63
    arenas = _run(judge, arenas, steps - 1)
    assert not arenas.outcome.arrived.any()
    # Float32 rounds the action and the start, by about 1e-7 of 0.25 m.
    np.testing.assert_allclose(_pose(arenas)[0, 0], [-0.1 + 62 * STRIDE, 0.2, 0.0], atol=1e-6)
    arenas = _run(judge, arenas, 20)
    assert arenas.outcome.arrival.tolist() == [[63]]
    assert arenas.outcome.moving.tolist() == [[63]]
    # From the step after the arrival on the command is zero. The servo stops the robot within that
    # step.
    np.testing.assert_allclose(_pose(arenas)[0, 0], [-0.1 + 63 * STRIDE, 0.2, 0.0], atol=1e-6)


def test_a_robot_turns_by_its_turn_rate(tmp_path: Path) -> None:
    judge = _judge(tmp_path, _stage(), SPIN)
    arenas = _start(judge, [[0.1, 0.2, 0.5]], [[0.1, 0.4]])
    # The first step takes a torque of 1.06e-4 * 3.14 / 0.032 = 0.0104 N m, less than the limit of
    # 0.0408 N m.
    turned = 10 * 3.14 * STEP
    arenas = _run(judge, arenas, 10)
    np.testing.assert_allclose(_pose(arenas)[0, 0], [0.1, 0.2, 0.5 + turned], atol=1e-6)
    seen = dict(zip(observation.NAMES, arenas.observation[0, 0], strict=True))
    assert seen["target_distance"] == pytest.approx(0.2, abs=1e-6)
    assert seen["target_bearing"] == pytest.approx(math.pi / 2 - 0.5 - turned, abs=1e-6)


def test_a_robot_that_starts_at_its_target_arrives_with_the_first_step(tmp_path: Path) -> None:
    judge = _judge(tmp_path, _stage(), STAY)
    arenas = _start(judge, [[0.0, 0.0, 0.0]], [[0.05, 0.0]])
    assert not arenas.outcome.arrived.any()
    assert _run(judge, arenas, 1).outcome.arrival.tolist() == [[1]]


@pytest.mark.parametrize(
    ("kind", "pose", "obstacle", "gap", "pace"),
    [
        # Two robots, whose centres are 0.2 m apart, drive towards each other.
        ("robot", [[-0.1, 0.0, 0.0], [0.1, 0.0, math.pi]], [], 0.2 - 2 * 0.037, 2 * STRIDE),
        # The wall is at x = 0.5 m; robot 1 meets nothing on its way.
        ("wall", [[0.35, 0.3, 0.0], [-0.4, -0.3, 0.0]], [], 0.5 - 0.35 - 0.037, STRIDE),
        # A box with an edge of 0.1 m stands at (0.2, 0), parallel to the walls.
        (
            "obstacle",
            [[0.0, 0.0, 0.0], [-0.4, -0.3, 0.0]],
            [[0.2, 0.0, 0.0, 0.05, 0.05]],
            0.2 - 0.05 - 0.037,
            STRIDE,
        ),
    ],
)
def test_a_push_is_one_contact_of_its_kind(
    tmp_path: Path, kind: str, pose: list, obstacle: list, gap: float, pace: float
) -> None:
    judge = _judge(tmp_path, _stage(robots=2, obstacles=len(obstacle)), AHEAD)
    arenas = _start(judge, pose, obstacle=obstacle)
    first = math.ceil(gap / pace)  # the control step in which the gap closes
    arenas = _run(judge, arenas, first - 1)
    assert not arenas.outcome.contacts.any()
    arenas = _run(judge, arenas, 1)
    expected = np.zeros((1, 2, 3), int)
    expected[0, : 2 if kind == "robot" else 1, gaps.KINDS.index(kind)] = 1
    np.testing.assert_array_equal(arenas.outcome.contacts, expected)
    # The robot goes on pushing, which counts as no further contact.
    np.testing.assert_array_equal(_run(judge, arenas, 40).outcome.contacts, expected)


def test_a_contact_in_the_first_step_counts(tmp_path: Path) -> None:
    judge = _judge(tmp_path, _stage(), AHEAD)
    arenas = _start(judge, [[0.5 - 0.037 - 0.001, 0.0, 0.0]])
    assert _run(judge, arenas, 1).outcome.contacts.tolist() == [[[0, 0, 1]]]


def test_an_arrived_robot_is_pushed_and_its_arrival_stands(tmp_path: Path) -> None:
    judge = _judge(tmp_path, _stage(robots=2), AHEAD)
    arenas = _start(judge, [[-0.1, 0.0, 0.0], [-0.3, 0.0, 0.0]], [[-0.1, 0.0], [9.0, 0.0]])
    arenas = _run(judge, arenas, 60)
    before = _pose(arenas)[0, 0, 0]
    arenas = _run(judge, arenas, 50)
    # One servo demands SPEED and the other demands 0, both with gain m / dt, so both robots move at
    # SPEED / 2. Contact is soft, so the speed is still settling, which a tenth covers.
    assert _pose(arenas)[0, 0, 0] - before == pytest.approx(50 * STRIDE / 2, rel=0.1)
    assert arenas.outcome.arrival.tolist() == [[1, 0]]
    assert arenas.outcome.moving.tolist() == [[1, 110]]
    assert arenas.observation[0, 0, DISTANCE] > 0.05
    assert arenas.outcome.contacts[0, :, 0].tolist() == [1, 1]


def test_steps_with_infrared_are_those_of_robots_on_their_way(tmp_path: Path) -> None:
    judge = _judge(tmp_path, _stage(robots=3), STAY)
    pose = [[0.45, 0.0, 0.0], [0.45, 0.3, 0.0], [0.0, 0.0, 0.0]]
    # The front sensors at x = 0.48 m see the wall at 0.02 / cos(17 degrees) m. Robot 1 has arrived.
    arenas = _run(judge, _start(judge, pose, [[-0.4, 0.0], [0.45, 0.3], [-0.4, 0.0]]), 7)
    assert arenas.outcome.sensed.tolist() == [[7, 1, 0]]
    assert arenas.outcome.moving.tolist() == [[7, 1, 7]]


def test_a_control_step_is_that_many_steps_of_mujoco(tmp_path: Path) -> None:
    stage = _stage(robots=2, side=0.6, obstacles=1)
    judge = _judge(tmp_path, stage, AHEAD, substeps=3)
    pose = [[-0.1, 0.02, 0.1], [0.1, 0.0, 2.5]]
    box = [[0.0, 0.15, 0.3, 0.05, 0.05]]
    arenas = _run(judge, _start(judge, pose, obstacle=box), 50)
    data = engine_c.place(judge, judge.model, np.array(pose, np.float32), np.array(box, np.float32))
    data.ctrl = [SPEED, 0.0, 0.0] * 2
    # Float32 rounds the policy's action, and contacts do not magnify this error here.
    mujoco.mj_step(judge.model, data, 150)
    np.testing.assert_allclose(_pose(arenas)[0], data.qpos.reshape(-1, 3), atol=1e-6)
    assert judge.model.opt.timestep == STEP / 3


def test_touching_is_a_gap_below_zero(tmp_path: Path) -> None:
    judge = _judge(tmp_path, _stage(robots=4, side=0.7, obstacles=2))
    draw = np.random.default_rng(0)
    count = 250
    pose = draw.uniform(-0.34, 0.34, (count, 4, 3)).astype(np.float32)
    box = draw.uniform(-0.25, 0.25, (count, 2, 5)).astype(np.float32)
    box[..., 2] *= 8.0
    box[..., 3:] = 0.05
    data = np.empty(count, object)
    data[:] = [engine_c.place(judge, judge.model, *each) for each in zip(pose, box, strict=True)]
    gap = np.stack(
        [
            gaps.gaps(p.astype(float), judge.stage.side, b.astype(float), 0.037, np)
            for p, b in zip(pose, box, strict=True)
        ]
    )
    assert np.abs(gap).min() > 1e-7  # float32 quaternions move the walls by 1e-8 m
    touching = contacts.touching(judge, data)
    assert touching.mean(axis=(0, 1)).min() > 0.1  # every kind occurs
    np.testing.assert_array_equal(touching, gap <= 0.0)


def test_the_walls_stand_where_the_level_says(tmp_path: Path) -> None:
    """In arenas of random size, a robot 5 mm from a wall sees it, one 1 mm inside touches it."""
    judge = _judge(tmp_path, _stage(robots=1, side=(0.6, 1.4)))
    drawn = [engine_c.draw_level(judge.stage, judge.spacing, 1, i) for i in range(20)]
    sides = [level.side for level in drawn]
    assert max(sides) - min(sides) > 0.4
    for gap in (0.005, -0.001):
        wall = [np.array([[0.5 * side - 0.037 - gap, 0.0, 0.0]], np.float32) for side in sides]
        levels = [level._replace(start=x) for level, x in zip(drawn, wall, strict=True)]
        arenas = engine_c.start(judge, levels)
        touched = contacts.touching(judge, arenas.data)
        assert (touched.any(axis=(1, 2)) == (gap < 0)).all()
        if gap > 0:
            nearest = arenas.observation[:, 0, INFRARED].min(axis=-1)
            assert ((nearest > 0.005) & (nearest < 0.04)).all()  # all within range
            np.testing.assert_allclose(nearest, nearest[0], atol=1e-6)  # float32


def test_the_judge_counts_what_the_training_environment_counts(tmp_path: Path) -> None:
    stage = _stage(robots=3, side=0.7, obstacles=1)
    judge = _judge(tmp_path, stage)
    # In episode 65 robots touch one another and the obstacle, and all of them arrive.
    drawn = engine_c.draw_level(judge.stage, judge.spacing, 1, 65)
    arenas = engine_c.start(judge, [drawn])
    sim = SimConfig(impl="jax", max_robots=3, max_obstacles=1)
    world = programs.load_world(TrainConfig(stage=(stage,), sim=sim))
    state = env.reset(world, jax.tree.map(jnp.asarray, drawn))
    seen = np.asarray(state.observation)
    state = dataclasses.replace(state, sim=physics.unpack(world.physics, state.sim))
    step = jax.jit(lambda state, action: env.step(world, state, action))
    # Training computes in float32 and the judge in double precision. The paths hardly magnify this
    # difference, even with contacts.
    np.testing.assert_allclose(seen, arenas.observation[0], atol=1e-5)
    for _ in range(168):
        state, came = step(state, policy.act(judge.policy, np.asarray(seen)))
        seen = np.asarray(came.observation)
        arenas = engine_c.step(judge, arenas)
        np.testing.assert_allclose(seen, arenas.observation[0], atol=1e-3)
        np.testing.assert_array_equal(state.arrived, arenas.outcome.arrived[0])
    assert arenas.outcome.arrived.all()
    np.testing.assert_array_equal(state.episode.contacts, arenas.outcome.contacts[0])
    np.testing.assert_array_equal(state.episode.sensed, arenas.outcome.sensed[0])
    np.testing.assert_array_equal(state.episode.moving, arenas.outcome.moving[0])
    assert arenas.outcome.contacts.sum(axis=(0, 1))[:2].min() >= 2  # both kinds occurred


# --- the same level in training


class Engines(NamedTuple):
    """The judge, and one compiled arena of the training environment with the same settings."""

    judge: Judge
    world: World
    reset: Callable[[Level], EnvState]
    step: Callable[[EnvState, jax.Array], tuple[EnvState, TimeStep]]


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(("wheeled", "ideal"), marks=pytest.mark.slow),
        ("planar", "real"),
        pytest.param(("wheeled", "real"), marks=pytest.mark.slow),
    ],
    ids="-".join,
)
def engines(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Engines:
    """Returns both engines with the settings of the YAML files and equally long physics steps."""
    body, realism = request.param
    path = steering.write(tmp_path_factory.mktemp("engines") / "policy.npz")
    arena = ["stage=s6", "stage.robots=3", "stage.side=0.7", "stage.obstacles=1"]
    words = [*arena, f"robot={body}", f"realism={realism}"]
    sim = ["sim.impl=jax", "sim.max_robots=3", "sim.max_obstacles=1"]
    world = programs.load_world(load_train([*words, *sim]))
    steps = f"substeps={world.physics.substeps}"
    judged = load_levels(EvaluateConfig, [f"policy={path}", steps, *words])
    assert judged.realism.name == realism

    def reset(drawn: Level) -> EnvState:
        state = env.reset(world, drawn)
        return dataclasses.replace(state, sim=physics.unpack(world.physics, state.sim))

    step = jax.jit(lambda state, action: env.step(world, state, action))
    return Engines(engine_c.load(judged, policy.load(path)), world, jax.jit(reset), step)


def _draw(engines: Engines) -> Level:
    """Draws the level of an episode in which robots touch one another and the obstacle."""
    return engine_c.draw_level(engines.judge.stage, engines.judge.spacing, 1, 65)


def _train(engines: Engines, drawn: Level, steps: int) -> tuple[list[EnvState], list[np.ndarray]]:
    """Steps the training environment by the policy; returns all states and observations [R, O]."""
    states = [engines.reset(drawn)]
    seen = [np.asarray(states[0].observation)]
    for _ in range(steps):
        action = policy.act(engines.judge.policy, seen[-1])
        state, came = engines.step(states[-1], jnp.asarray(action))
        states.append(state)
        seen.append(np.asarray(came.observation))
    return states, seen


def test_judge_and_training_see_the_same_and_count_the_same(engines: Engines) -> None:
    drawn, steps = _draw(engines), 64
    states, seen = _train(engines, drawn, steps)
    arenas = engine_c.start(engines.judge, [drawn])
    for theirs, mine in zip(states[0].factors, arenas.factors, strict=True):
        assert (theirs is None) == (mine is None)
        if theirs is not None and mine is not None:
            # The tolerance is for the rounding of low + u * (high - low), log and cos.
            np.testing.assert_allclose(theirs, mine[0], rtol=2e-6, atol=1e-6)
    touched = False
    for state, found in zip(states, seen, strict=True):
        off = np.abs(found - arenas.observation[0])
        off[:, BEARING] = np.minimum(off[:, BEARING], 2 * math.pi - off[:, BEARING])
        if touched:
            # The two solvers' pushes agree to about a millimetre; a robot that pushes slips and
            # turns.
            assert off[:, DISTANCE].max() < 1e-3
        else:
            # Float32 differs from double precision by 1e-7 m and, near a target, by 1e-5 rad. If
            # speeds are quantised, this may change a wheel's speed by 2 % for a step, but does not
            # in this episode.
            assert off.max() < 5e-5
            np.testing.assert_array_equal(state.episode.sensed, arenas.outcome.sensed[0])
        np.testing.assert_array_equal(state.episode.contacts, arenas.outcome.contacts[0])
        np.testing.assert_array_equal(state.arrived, arenas.outcome.arrived[0])
        touched = bool(arenas.outcome.contacts.any())
        arenas = engine_c.step(engines.judge, arenas)
    assert touched
    assert (seen[-1][:, INFRARED] < 0.04).any()


def test_a_level_replays_exactly(engines: Engines) -> None:
    drawn, steps = _draw(engines), 50
    states, seen = _train(engines, drawn, steps)
    again, seen_again = _train(engines, drawn, steps)
    np.testing.assert_array_equal(seen, seen_again)
    np.testing.assert_array_equal(states[-1].sim.qpos, again[-1].sim.qpos)
    first, second = (
        _run(engines.judge, engine_c.start(engines.judge, [drawn, drawn]), steps) for _ in range(2)
    )
    np.testing.assert_array_equal(first.observation, second.observation)
    np.testing.assert_array_equal(first.observation[0], first.observation[1])
    for one, other in zip(first.data, second.data, strict=True):
        np.testing.assert_array_equal(one.qpos, other.qpos)
    # The level's seed determines all that is random, and nothing else: with `ideal` another seed
    # changes nothing.
    other = drawn._replace(seed=drawn.seed ^ np.uint32(1))
    _, elsewhere = _train(engines, other, steps)
    judged = _run(engines.judge, engine_c.start(engines.judge, [other]), steps)
    is_random = engines.world.realism.name == "real"
    assert (np.array(elsewhere) != np.array(seen)).any() == is_random
    assert (judged.observation[0] != first.observation[0]).any() == is_random


# --- one factor at a time

# Two robots push each other, one stands beside the east wall, and one stands before an obstacle.
# All robots ignore their observations and drive in a gentle curve to the left.
CROWD = [[-0.038, 0.0, 0.0], [0.038, 0.0, 3.0], [0.45, 0.0, 1.0], [0.0, -0.3, 0.0]]
BOX = [[0.11, -0.3, 0.0, 0.05, 0.05]]
CURVE = ((0.4, 0.2), (0.0, 0.0), (0.0, 0.0))
PUSHING, ALL = [0, 1], [0, 1, 2, 3]
BODIES = pytest.mark.parametrize("body", ["planar", "wheeled"])
BodyName = Literal["planar", "wheeled"]


def _tour(tmp_path: Path, body: BodyName, **realism: Any) -> tuple[np.ndarray, np.ndarray]:
    """Drives the crowd; returns poses [T, R, 3] and observations [T + 1, R, O]."""
    stage, real = _stage(robots=4, obstacles=1), RealismConfig(infrared="real", **realism)
    judge = _judge(tmp_path, stage, CURVE, robot=RobotConfig(body=body), realism=real)
    arenas = _start(judge, CROWD, obstacle=BOX)
    path, seen = [], [arenas.observation[0]]
    for _ in range(12):
        arenas = engine_c.step(judge, arenas)
        path.append(model.BODIES[body].pose(arenas.data[0].qpos.copy(), np))
        seen.append(arenas.observation[0])
    return np.array(path), np.array(seen)


def _robots_apart(one: np.ndarray, other: np.ndarray, least: float = 0.0) -> list[int]:
    """Returns the robots with any entry of [T, R, ...] that differs by more than `least`."""
    return np.flatnonzero((np.abs(one - other) > least).any(axis=(0, 2))).tolist()


@BODIES
@pytest.mark.parametrize(
    ("factor", "value"),
    [
        ("mass", (0.13, 0.20)),
        ("friction", (0.1, 0.1)),
        ("wheel_radius", (0.0198, 0.0198)),
        ("track", (0.057, 0.057)),
        ("max_wheel_speed", (2.0, 2.0)),
        ("speed_noise", 0.05),
        ("speed_quantisation", "epuck1"),
        ("action_latency", (1, 2)),
    ],
)
def test_a_factor_of_the_drive_moves_the_robots_alone(
    tmp_path: Path, body: BodyName, factor: str, value: Any
) -> None:
    path, seen = _tour(tmp_path, body)
    moved, felt = _tour(tmp_path, body, **{factor: value})
    np.testing.assert_array_equal(seen[0], felt[0])  # Before anything moves.
    # Robots of any mass drive alike until they push, since their grip grows with their mass.
    assert _robots_apart(path, moved, 1e-5) == (PUSHING if factor == "mass" else ALL)  # m, rad
    if factor == "mass" and body == "planar":
        # The servos are scaled by a ratio of masses, which is rounded: 1e-16 of 1e-1 m, twelve
        # times.
        assert _robots_apart(path, moved, 1e-12) == PUSHING


@pytest.mark.parametrize(
    ("factor", "value", "robots"),
    [
        ("infrared_noise", (1.0, 1.0), ALL),
        ("infrared_gain", (0.7, 0.7), ALL),
        ("infrared_yaw", 0.0349, ALL),
        ("infrared_period", (0.05, 0.05), ALL),
        ("dead_sensor", 1.0, ALL),
        ("reflectance", (0.5, 0.5), [2, 3]),
        ("reflectance_robot", (0.5, 0.5), PUSHING),
    ],
)
def test_a_factor_of_the_sensors_changes_what_they_see_alone(
    tmp_path: Path, factor: str, value: Any, robots: list[int]
) -> None:
    path, seen = _tour(tmp_path, "planar")
    moved, felt = _tour(tmp_path, "planar", **{factor: value})
    np.testing.assert_array_equal(path, moved)
    np.testing.assert_array_equal(seen[..., TARGET], felt[..., TARGET])
    assert _robots_apart(seen[..., INFRARED], felt[..., INFRARED]) == robots
    if factor == "dead_sensor":
        np.testing.assert_array_equal(felt[..., INFRARED], np.float32(0.04))
    if factor.startswith("reflectance"):
        # Darker surfaces seem further away.
        assert (felt[..., INFRARED] >= seen[..., INFRARED]).all()


@pytest.mark.parametrize(
    ("factor", "value", "entry"),
    [("target_distance_noise", 0.005, DISTANCE), ("target_bearing_noise", 0.05, BEARING)],
)
def test_noise_of_the_target_is_of_its_entry_alone(
    tmp_path: Path, factor: str, value: float, entry: int
) -> None:
    path, seen = _tour(tmp_path, "planar")
    moved, felt = _tour(tmp_path, "planar", **{factor: value})
    np.testing.assert_array_equal(path, moved)
    others = KNOWN[entry != KNOWN]
    np.testing.assert_array_equal(seen[..., others], felt[..., others])
    assert (seen[..., entry] != felt[..., entry]).all()


def test_a_late_observation_is_that_of_the_step_before(tmp_path: Path) -> None:
    path, seen = _tour(tmp_path, "planar")
    moved, felt = _tour(tmp_path, "planar", observation_latency=(1, 1))
    np.testing.assert_array_equal(path, moved)
    np.testing.assert_array_equal(felt[1:], seen[:-1])
    np.testing.assert_array_equal(felt[0], seen[0])


def test_the_judge_sees_how_bright_each_thing_is(tmp_path: Path) -> None:
    shade: Any = (0.3, 1.0)
    real = RealismConfig(
        infrared="real",
        reflectance=shade,
        reflectance_robot=shade,
    )
    judge = _judge(tmp_path, _stage(robots=3, side=0.7, obstacles=2), realism=real)
    levels = [engine_c.draw_level(judge.stage, judge.spacing, 1, n) for n in range(200)]
    # The robots stand closer together than any level places them.
    levels = [drawn._replace(start=drawn.start * np.float32([1.0, 0.7, 1.0])) for drawn in levels]
    arenas = engine_c.start(judge, levels)
    pose, side, box = (
        np.array([getattr(drawn, name) for drawn in levels], np.float64)
        for name in ("start", "side", "obstacle")
    )
    args = (arenas.data, arenas.factors, pose, arenas.target, arenas.obstacle)
    sight, shades = engine_c.look(judge, *args), electronics.reflectance(arenas.factors)
    assert shades is not None
    assert sight.reflectance is not None
    ray, bright = infrared.sights(pose, side, box, 0.037, 0.1, shades, infrared.EPUCK)
    # If several things overlap a ray's origin, MuJoCo does not tell which one the ray hits. Such
    # rays are left out.
    apart = (ray > 0.0) & (sight.ray > 0.0) & (ray < 0.1)
    # The tolerance of 1e-6 m is for float32 in the walls' quaternions. Shades come from a table, so
    # they are exactly equal.
    np.testing.assert_allclose(sight.ray[apart], ray[apart], atol=1e-6)
    np.testing.assert_array_equal(sight.reflectance[apart], bright[apart])
    for each in shades:
        assert np.isin(bright[apart], each).mean() > 0.05  # every kind is seen


@BODIES
def test_each_arena_has_robots_of_its_own(tmp_path: Path, body: BodyName) -> None:
    """The heavier robot has the better grip, and pushes the lighter one back."""
    real = RealismConfig(mass=(0.05, 0.5))
    judge = _judge(tmp_path, _stage(robots=2), AHEAD, robot=RobotConfig(body=body), realism=real)
    levels = [
        _level(judge, [[-0.04, 0.0, 0.0], [0.04, 0.0, math.pi]], seed=seed) for seed in range(6)
    ]
    arenas = engine_c.start(judge, levels)
    mass = arenas.factors.mass
    assert mass is not None
    for one, found in zip(arenas.model, mass, strict=True):
        rows = judge.ids.robots.bodies
        np.testing.assert_allclose(one.body_mass[rows].sum(axis=1), found, rtol=1e-6)  # float32
    np.testing.assert_allclose(judge.model.body_mass[judge.ids.robots.bodies].sum(axis=1), 0.16)
    arenas = _run(judge, arenas, 30)
    pose = np.stack([model.BODIES[body].pose(data.qpos, np) for data in arenas.data])
    heavier = np.where(mass[:, 0] > mass[:, 1], 1.0, -1.0)
    assert len(set(heavier)) == 2
    assert (pose[..., 0].mean(axis=1) * heavier > 1e-3).all()


def test_an_episode_does_not_depend_on_those_beside_it(tmp_path: Path) -> None:
    judge = _judge(tmp_path, _stage(robots=3, side=0.7, obstacles=1), steps=150)
    together = engine_c.simulate(judge, _draw_some(judge, range(8)))
    assert len(set(together.clock.tolist())) > 2  # arenas end at different times
    for episode in (0, 5, 7):
        alone = engine_c.simulate(judge, _draw_some(judge, [episode]))
        for one, all_ in zip(alone, together, strict=True):
            np.testing.assert_array_equal(one[0], all_[episode])


def test_seed_and_number_alone_decide_the_level(tmp_path: Path) -> None:
    judge = _judge(tmp_path, _stage(robots=2, obstacles=2))
    again, other, next_ = (
        engine_c.draw_level(judge.stage, judge.spacing, seed, episode)
        for seed, episode in ((1, 4), (2, 4), (1, 5))
    )
    first = engine_c.draw_level(judge.stage, judge.spacing, 1, 4)
    np.testing.assert_array_equal(first.start, again.start)
    assert (first.start != other.start).any()
    assert (first.start != next_.start).any()
    assert first.start.dtype == np.float32  # as training draws it


@pytest.mark.parametrize("layout", ["boxes", "fence"])
def test_obstacles_of_a_fixed_level_have_their_own_sizes(tmp_path: Path, layout: Any) -> None:
    stage = _stage(robots=1, side=1.4, obstacles=1, level="fixed", layout=layout)
    judge = _judge(tmp_path, stage)
    # A box has an edge of 0.10 m. A fence has 0.50 by 0.06 m in an arena of 0.7 m, and its length
    # scales with the side.
    half = [0.05, 0.05] if layout == "boxes" else [0.50, 0.03]
    found = judge.model.geom("obstacle0_box")
    np.testing.assert_allclose(found.size[:2], half, rtol=1e-6)  # Float32.
    # With a bound that is too small, MuJoCo would miss contacts at the ends.
    assert found.rbound[0] == pytest.approx(math.hypot(*half, 0.05), rel=1e-6)


def test_the_policy_says_how_fast_it_may_ask_for(tmp_path: Path) -> None:
    limits = {"low": [0.0, -1.0], "high": [0.05, 1.0]}
    names = {"names": ["speed", "turn_rate"], "units": ["m/s", "rad/s"]}
    path = steering.write(tmp_path / "policy.npz", AHEAD, action=names | limits)
    config = EvaluateConfig(policy=str(path), stage=_stage(), robot=RobotConfig())
    judge = engine_c.load(config, policy.load(path))
    arenas = _run(judge, _start(judge, [[0.0, 0.0, 0.0]]), 10)
    assert _pose(arenas)[0, 0, 0] == pytest.approx(10 * 0.05 * STEP, abs=1e-7)  # float32 action


def test_physics_that_breaks_down_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log here
    judge = _judge(tmp_path, _stage(robots=2))
    arenas = _start(judge, [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])
    arenas.data[0].qvel[3] = np.nan
    with pytest.raises(ConfigError, match=r"^the physics broke down.* substeps .*\.$"):
        engine_c.step(judge, arenas)


def test_a_policy_of_three_judges_three(tmp_path: Path) -> None:
    path = steering.write(tmp_path / "policy.npz", learners=3, policy="independent")
    config = EvaluateConfig(policy=str(path), stage=_stage(robots=4))
    with pytest.raises(PolicyError, match=r"each of 3 robots, but stage test has 4"):
        engine_c.load(config, policy.load(path))
    config = EvaluateConfig(policy=str(path), stage=_stage(robots=3), task=TaskConfig(), steps=2)
    judge = engine_c.load(config, policy.load(path))
    assert engine_c.simulate(judge, _draw_some(judge, [0])).clock.tolist() == [2]


def test_robots_draw_their_actions(tmp_path: Path) -> None:
    """An action is the mean plus the deviation times noise that level and clock determine."""
    judge = _judge(tmp_path, _stage(robots=2))
    learned = judge.policy._replace(log_std=np.log(np.array([[0.2, 0.1]], np.float32)))
    poses = [[-0.2, 0.0, 0.3], [0.2, 0.0, -1.0]]
    levels = [_level(judge, poses, seed=seed) for seed in (4, 5)]
    arenas = _run(dataclasses.replace(judge, policy=learned), engine_c.start(judge, levels), 1)
    before = arenas.observation
    arenas = engine_c.step(dataclasses.replace(judge, policy=learned), arenas)
    normal = noise.normal(np.uint32([4, 5]), np.array([1, 1]), noise.Stream.ACTION, (2, 2), np)
    action = policy.act(judge.policy, before) + np.array([0.2, 0.1]) * normal
    speed, turn = np.clip(action, -1, 1).transpose(2, 0, 1)
    wanted = [(speed + 1) / 2 * 0.1256, 3.14 * turn]  # m/s, rad/s
    told = np.stack([data.ctrl.reshape(2, 3) for data in arenas.data])[..., [0, 2]]
    # Each wheel is clipped at 6.28 rad/s. Robots without a clipped wheel keep the wanted command,
    # up to float32.
    free = np.abs(wanted[0]) + np.abs(wanted[1]) * 0.026 < 6.28 * 0.02
    assert 1 < free.sum() < 4
    for found, expected in zip(told[free].T, (x[free] for x in wanted), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert np.unique(normal).size == normal.size


def test_what_is_drawn_does_not_depend_on_who_is_judged_beside(tmp_path: Path) -> None:
    path = steering.write(tmp_path / "policy.npz", log_std=math.log(0.3))
    given = EvaluateConfig(policy=str(path), stage=_stage(robots=2), robot=RobotConfig(), steps=60)
    judge = engine_c.load(given, policy.load(path))
    levels = _draw_some(judge, [0, 1, 2])
    together = engine_c.simulate(judge, levels)
    for i, one in enumerate(levels):
        alone = engine_c.simulate(judge, [one])
        for whole, mine in zip(together, alone, strict=True):
            np.testing.assert_array_equal(whole[i], mine[0])
    mean = engine_c.load(dataclasses.replace(given, action="mean"), policy.load(path))
    assert (engine_c.simulate(mean, levels).path != together.path).all()


# --- outcomes of episodes


def test_contacts_last(tmp_path: Path) -> None:
    """One planar robot pushes a wall and two push each other."""
    judge = _judge(tmp_path, _stage(robots=3), AHEAD)
    pose = [[0.5 - 0.038, 0.3, 0.0], [-0.038, 0.0, 0.0], [0.038, 0.0, math.pi]]
    arenas = _run(judge, _start(judge, pose), 60)
    before = arenas.outcome
    arenas = _run(judge, arenas, 20)
    expected = np.zeros((1, 3, 3))
    expected[0, 0, gaps.KINDS.index("wall")] = expected[0, 1:, gaps.KINDS.index("robot")] = 20
    np.testing.assert_array_equal(arenas.outcome.touched - before.touched, expected)


def test_the_way_driven_ends_with_the_arrival(tmp_path: Path) -> None:
    judge = _judge(tmp_path, _stage(robots=2), AHEAD)
    arenas = _start(judge, [[-0.3, 0.2, 0.0], [-0.3, -0.2, 0.0]], [[-0.1, 0.2], [9.0, 0.0]])
    arenas = _run(judge, arenas, 60)
    steps = math.ceil(0.15 / STRIDE)
    # The tolerance is for the start from rest in the first step, and for float32 commands.
    np.testing.assert_allclose(arenas.outcome.path[0], [steps * STRIDE, 60 * STRIDE], rtol=1e-3)


def test_stillness_begins_anew_with_every_two_centimetres(tmp_path: Path) -> None:
    judge = _judge(tmp_path, _stage(robots=2), AHEAD)
    # Robot 1 pushes the wall from the start.
    arenas = _start(judge, [[-0.3, 0.0, 0.0], [0.5 - 0.037, -0.3, 0.0]])
    stride = math.ceil(0.02 / STRIDE)  # the robot is 2 cm away after 5 steps
    assert 5 * STRIDE > 0.02 > 4 * STRIDE
    seen = []
    for _ in range(2 * stride + 1):
        arenas = engine_c.step(judge, arenas)
        seen.append(arenas.outcome.still[0].tolist())
    assert [a for a, _ in seen] == [1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1]
    assert [b for _, b in seen] == list(range(1, 12))
