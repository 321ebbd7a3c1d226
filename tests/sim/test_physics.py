"""MJX, by both implementations, against MuJoCo's C engine and against the unicycle."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from swarmjax import config
from swarmjax.config import SimConfig, StageConfig, TrainConfig
from swarmjax.sim import gaps, model, physics
from swarmjax.task import env

ARENAS, ROBOTS, OBSTACLES = 8, 3, 2
STEP, RADIUS = 0.032, 0.037  # s, m
BIGGEST_HALF = 0.15  # m, the bound that the model is compiled for
SIDE = 0.6  # m
FULL = 0.1256  # m/s
AWAY = np.array([[-5.0, -5.0, 0.0, 0.05, 0.05], [-5.5, -5.0, 0.0, 0.05, 0.05]], np.float32)


class Path(NamedTuple):
    """What came of driving, [T, A, R, 3] each: x, y, yaw and their rates."""

    pose: np.ndarray
    rate: np.ndarray


class Engine(NamedTuple):
    """The physics of one implementation, and its compiled step of all arenas."""

    loaded: physics.Physics
    step: Callable[..., Any]


def _config(impl: Literal["jax", "warp"]) -> TrainConfig:
    stage = StageConfig(
        name="boxes", robots=ROBOTS, side=1.3, obstacles=OBSTACLES, obstacle_size=2 * BIGGEST_HALF
    )
    sim = SimConfig(impl=impl, max_robots=ROBOTS, max_obstacles=OBSTACLES)
    return TrainConfig(stage=(stage,), sim=sim, arenas=ARENAS, budget=10_000)


@pytest.fixture(scope="module", params=["jax", "warp"])
def engine(request: pytest.FixtureRequest) -> Iterator[Engine]:
    # A program of Warp calls back into the process that compiled it: it is not for the disk.
    seconds = jax.config.jax_persistent_cache_min_compile_time_secs
    if request.param == "warp":
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1e9)
    loaded = env.load(_config(request.param)).physics
    move = jax.vmap(functools.partial(physics.step, loaded), in_axes=(0, None, None, 0))
    yield Engine(loaded, jax.jit(move))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", seconds)


def _start(engine: Engine, pose: np.ndarray) -> physics.mjx.Data:
    """Arenas [A] at rest at poses [A, R, 3]."""
    rest = jax.vmap(physics.rest)(jnp.asarray(pose, jnp.float32).reshape(ARENAS, -1))
    return jax.vmap(functools.partial(physics.unpack, engine.loaded))(rest)


def _drive(
    engine: Engine, start: np.ndarray, velocity: np.ndarray, obstacle: np.ndarray = AWAY
) -> Path:
    """Holds velocity [T, A, R, 2] or [T, 2], from start [A, R, 3] or [R, 3] at rest."""
    data = _start(engine, np.broadcast_to(start, (ARENAS, ROBOTS, 3)))
    pose, rate = [], []
    for now in velocity:
        now = jnp.asarray(np.broadcast_to(now, (ARENAS, ROBOTS, 2)), jnp.float32)
        data = engine.step(data, jnp.float32(SIDE), jnp.asarray(obstacle), now)
        pose.append(data.qpos)
        rate.append(data.qvel)
    shape = (len(velocity), ARENAS, ROBOTS, 3)
    return Path(np.array(pose).reshape(shape), np.array(rate).reshape(shape))


def _drive_in_c(start: np.ndarray, velocity: np.ndarray, obstacle: np.ndarray) -> np.ndarray:
    """The same of one arena by MuJoCo's C engine in float64, its solver converged."""
    size = model.ArenaSize(ROBOTS, OBSTACLES, BIGGEST_HALF)
    spec = model.build(_config("jax").robot, size, STEP)
    spec.option.iterations, spec.option.tolerance = 100, 1e-12
    built = spec.compile()
    ids, data = model.ids(built, size), mujoco.MjData(built)
    built.geom_size[ids.obstacle_geom, :2] = obstacle[:, 3:]
    place, turn = model.fixture_poses(SIDE, obstacle, np)
    data.mocap_pos[ids.fixture_mocap], data.mocap_quat[ids.fixture_mocap] = place, turn
    data.qpos[:] = start.reshape(-1)
    path = []
    for forward, turn_rate in np.moveaxis(velocity, -1, 1):
        data.ctrl[:] = np.stack([forward, 0.0 * forward, turn_rate], axis=-1).reshape(-1)
        mujoco.mj_step(built, data)
        path.append(data.qpos.reshape(ROBOTS, 3).copy())
    return np.array(path)


def _apart(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """One robot at a pose [R, 3], the others far from it and from everything else."""
    return np.array([[x, y, yaw], [5.0, 5.0, 0.0], [5.5, 5.0, 0.0]])


def test_both_implementations_move_as_the_c_engine_does(engine: Engine) -> None:
    random = np.random.default_rng(2)
    obstacle = np.array([[0.1, 0.02, 0.5, 0.06, 0.04], [-0.15, -0.12, 1.1, 0.05, 0.05]], np.float32)
    start = np.empty((ARENAS, ROBOTS, 3), np.float32)
    start[..., :2] = [(-0.03, -0.05), (0.05, 0.13), (0.0, -0.2)]
    start[..., 2] = random.uniform(-np.pi, np.pi, (ARENAS, ROBOTS))
    shape = (10, ARENAS, ROBOTS)  # a command for ten steps each
    commands = [random.uniform(0.0, FULL, shape), random.uniform(-1.5, 1.5, shape)]
    velocity = np.repeat(np.stack(commands, axis=-1), 10, axis=0).astype(np.float32)
    expected = np.stack(
        [_drive_in_c(start[a], velocity[:, a], obstacle) for a in range(ARENAS)], axis=1
    )
    found = _drive(engine, start, velocity, obstacle).pose
    touching = np.zeros(3, int)
    for pose in expected.reshape(-1, ROBOTS, 3):
        touching += np.sum(gaps.gaps(pose, np.float64(SIDE), obstacle, RADIUS, np) < 0.0, axis=0)
    assert (touching >= 50).all(), f"robot steps in contact with {gaps.KINDS}: {touching}"
    # 1e-5 m: 8e-7 m was seen with either implementation's own solver steps, float32's rounding
    # over 100 steps; other seeds gave up to 6e-6 m, where a glancing contact multiplies it.
    np.testing.assert_allclose(found[..., :2], expected[..., :2], atol=1e-5)
    # 2e-5 rad: the same rounding, where 6e-6 rad was seen; contacts turn no hull.
    np.testing.assert_allclose(found[..., 2], expected[..., 2], atol=2e-5)


@pytest.mark.parametrize(
    "command", [(FULL, 0.0), (0.0, 3.14), (0.0, -3.14), (0.05, 1.0), (0.0, 0.0)]
)
def test_one_step_from_rest_reaches_the_command(
    engine: Engine, command: tuple[float, float]
) -> None:
    # The servo is deadbeat, and all limits of force are wide: 0.1256 m/s in 32 ms takes 0.63 N
    # of 1.57, 3.14 rad/s takes 0.0104 N m of 0.0408.
    yaw = 0.7
    rate = _drive(engine, _apart(yaw=yaw), np.array([command])).rate[0, 0, 0]
    forward = rate[0] * np.cos(yaw) + rate[1] * np.sin(yaw)
    sideways = rate[1] * np.cos(yaw) - rate[0] * np.sin(yaw)
    # 1e-6: float32 at 3.14.
    np.testing.assert_allclose(
        [forward, sideways, rate[2]], [command[0], 0.0, command[1]], atol=1e-6
    )


def test_a_robot_rolls_as_the_unicycle(engine: Engine) -> None:
    # Four quarters of the arena, far from all walls: straight, on the spot, two arcs.
    commands = np.array([(0.06, 0.0), (0.0, 2.0), (0.04, 0.8), (0.04, -0.8)])
    starts = np.stack([_apart(-0.1, -0.05, 0.4)] * ARENAS)
    velocity = np.zeros((60, ARENAS, ROBOTS, 2))
    velocity[:, :4, 0] = commands
    path = _drive(engine, starts, velocity)
    time = STEP * np.arange(1, 61)
    for arena, (v, w) in enumerate(commands):
        yaw = 0.4 + w * time
        # 1e-5 rad and m: float32, 60 steps.
        np.testing.assert_allclose(path.pose[:, arena, 0, 2], yaw, atol=1e-5)
        # Euler moves along the heading at the start of each step: exactly this sum.
        before = yaw - w * STEP
        moved = np.cumsum(v * STEP * np.stack([np.cos(before), np.sin(before)], -1), axis=0)
        place = path.pose[:, arena, 0, :2] - (-0.1, -0.05)
        np.testing.assert_allclose(place, moved, atol=1e-5)  # likewise
        # The smooth arc turns half a step's angle further: that much of the way, at most.
        between = 0.4 + 0.5 * w * time
        chord = v * time * np.sinc(0.5 * w * time / np.pi)
        arc = chord[:, None] * np.stack([np.cos(between), np.sin(between)], axis=-1)
        error = np.linalg.norm(place - arc, axis=-1)
        assert np.all(error <= 1.01 * v * time * 0.5 * abs(w) * STEP + 1e-5)


@pytest.mark.parametrize("yaw", [0.0, 0.6, np.pi / 4])
def test_a_robot_driven_into_a_wall_stays_inside(engine: Engine, yaw: float) -> None:
    # Half a millimetre apart, so that one of them just misses the wall at the end of a step.
    start = np.stack([_apart(0.2 + 0.0005 * arena, 0.2, yaw) for arena in range(ARENAS)])
    path = _drive(engine, start, np.full((60, 2), (FULL, 0.0)))
    gap = 0.5 * SIDE - RADIUS - np.max(np.abs(path.pose[:, :, 0, :2]), axis=-1)
    # What a step brings is felt in the next one: it sinks by a step at full speed at most, 4 mm,
    # and never by more. 1e-5 m: float32, 60 steps.
    assert gap.min() >= -FULL * STEP - 1e-5
    assert gap.min() < -0.5 * FULL * STEP * np.cos(yaw), "the worst case was met"
    # In the end it pushes and the soft wall (MuJoCo's default contact) balances it: 0.7 mm.
    assert np.all(np.abs(gap[-1] + 0.0006) < 0.0002)


def test_parked_robots_stay_where_they_are(engine: Engine) -> None:
    start = np.array([[0.2, 0.0, 0.0], [5.0, 5.0, 0.0], [5.5, 5.0, 0.0]])
    velocity = np.zeros((40, ARENAS, ROBOTS, 2))
    velocity[:, :, 0, 0] = FULL  # into the east wall
    path = _drive(engine, start, velocity)
    np.testing.assert_array_equal(
        path.pose[:, :, 1:], np.broadcast_to(start[1:], (40, ARENAS, 2, 3))
    )
    assert not path.rate[:, :, 1:].any()


@pytest.mark.parametrize("half", [0.03, BIGGEST_HALF])
def test_an_obstacle_is_felt_where_its_face_is(engine: Engine, half: float) -> None:
    # A robot at 0.26 m drives at a box centred on the origin, whose half edge the step is told.
    obstacle = np.array([[0.0, 0.0, 0.0, half, half], AWAY[1]], np.float32)
    path = _drive(engine, _apart(0.26, 0.0, np.pi), np.full((80, 2), (FULL, 0.0)), obstacle)
    gap = path.pose[:, :, 0, 0] - half - RADIUS
    reached = int(np.argmax(gap[:, 0] <= 0.0))
    # It is free until it meets the face: 4.02 mm a step from 0.26 m.
    assert reached == int(np.ceil((0.26 - half - RADIUS) / (FULL * STEP))) - 1
    assert np.all(gap >= -FULL * STEP - 1e-5)  # as with walls
    assert np.all(np.abs(gap[-1] + 0.0006) < 0.0002)  # likewise


def test_a_step_reads_nothing_but_what_is_packed(engine: Engine) -> None:
    random = np.random.default_rng(3)
    obstacle = np.array([[0.0, 0.0, 0.3, 0.05, 0.05], AWAY[1]], np.float32)
    start = np.array([[-0.1, 0.0, 0.0], [-0.2, 0.0, 0.0], [0.22, 0.22, 0.8]])
    velocity = jnp.asarray(random.uniform(0.0, FULL, (8, ARENAS, ROBOTS, 2)), jnp.float32)
    carried = again = _start(engine, np.broadcast_to(start, (ARENAS, ROBOTS, 3)))
    repack = jax.vmap(lambda data: physics.unpack(engine.loaded, physics.pack(data)))
    for now in velocity:
        carried = engine.step(carried, jnp.float32(SIDE), jnp.asarray(obstacle), now)
        again = engine.step(repack(again), jnp.float32(SIDE), jnp.asarray(obstacle), now)
        for expected, found in zip(physics.pack(carried), physics.pack(again), strict=True):
            np.testing.assert_array_equal(found, expected)


def test_warp_is_asked_for_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(physics.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(config.ConfigError, match=r"sim\.impl is warp"):
        physics.resolve_impl("warp")
    assert physics.resolve_impl("auto") == "jax"


def test_auto_is_jax_without_an_nvidia_gpu() -> None:
    assert physics.resolve_impl("auto") == "jax"
    assert physics.resolve_impl("jax") == "jax"
    assert physics.resolve_impl("warp") == "warp"


def test_substeps_make_up_one_control_step() -> None:
    half = dataclasses.replace(_config("jax"), sim=SimConfig(impl="jax", substeps=2, max_robots=3))
    loaded = env.load(half).physics
    assert loaded.substeps == 2
    # 1e-9 s: the model keeps its step in float32.
    assert float(loaded.model.opt.timestep) == pytest.approx(0.016, abs=1e-9)
