"""Tests obstacles and walls that move: as world geoms in MJX, as mocap bodies in MuJoCo C."""

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from engines import (
    ARENAS,
    AWAY,
    BIGGEST_HALF,
    CHUNK,
    ENGINES,
    FULL,
    OBSTACLES,
    RADIUS,
    ROBOTS,
    STEP,
    BodyName,
    compile_in_c,
    push,
    settings,
    turned,
    wheels_of,
)

from swarmjax.sim import model, physics
from swarmjax.sim.body import AS_BUILT
from swarmjax.sim.config import RobotConfig, physics_substeps
from swarmjax.training import program as programs

SIZE = model.ArenaSize(ROBOTS, OBSTACLES, BIGGEST_HALF)
AHEAD = wheels_of(np.array([FULL, 0.0]))
CLEAR = 0.01  # m; the gap to a robot's hull when an obstacle or wall is put in its way
WAY = FULL * STEP * CHUNK  # m; 0.0804, the distance that a free robot drives in a scene


class Scenes(NamedTuple):
    """Three scenes of `CHUNK` control steps: side [3, A] and obstacles [3, A, M, 5]."""

    side: np.ndarray
    obstacle: np.ndarray


# Robots 0, 1 and 2 drive along +x, +y and -x. `STOPPED` lists which of them each scene stops.
START = np.array([[0.0, 0.0, 0.0], [-0.1, 0.15, np.pi / 2], [0.1, -0.15, np.pi]])
STOPPED = np.array([[True, True, False], [False, False, True], [True, True, False]])


def _scenes() -> tuple[np.ndarray, Scenes]:
    """Returns starting poses [A, R, 3] and scenes, turned by a quarter turn from arena to arena.

    In the first scene a box stops robot 0 and the north wall stops robot 1. In the second scene the
    wall is gone, and a smaller box stops robot 2. In the third scene a narrow box, turned by a
    right angle, stops robot 0, and another box stops robot 1.
    """
    near = RADIUS + CLEAR
    first = [near + 0.05, 0.0, 0.0, 0.05, 0.05]
    second = [0.1 - WAY - near - 0.03, -0.15, 0.0, 0.03, 0.04]
    third = [CLEAR + WAY + near + 0.02, 0.0, np.pi / 2, 0.06, 0.02]
    other = [-0.1, 0.15 + CLEAR + WAY + near + 0.03, 0.0, 0.03, 0.03]
    boxes = np.array([[first, AWAY[1]], [second, AWAY[1]], [third, other]])
    quarter = 0.5 * np.pi * np.arange(ARENAS)
    pose = np.stack([_turn(START, angle) for angle in quarter])
    obstacle = np.stack([_turn(boxes, angle) for angle in quarter], axis=1)
    # The walls are 0.1 mm farther out in each arena than in the one before, so that no two arenas
    # are alike.
    closest = 2.0 * (0.15 + near + 1e-4 * np.arange(ARENAS))
    return pose, Scenes(np.stack([closest, closest + 0.6, closest + 0.8]), obstacle)


def _turn(things: np.ndarray, angle: float) -> np.ndarray:
    """Turns things [..., 3+] with x, y and yaw about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, yaw = things[..., 0], things[..., 1], things[..., 2] + angle
    return np.concatenate([np.stack([c * x - s * y, s * x + c * y, yaw], -1), things[..., 3:]], -1)


@pytest.fixture(
    scope="module",
    params=[
        # MJX by `jax` compiles for 20 s per test, so it is slow. Other tests, in test_physics.py
        # and test_engine_c.py, compare it with MuJoCo C where robots meet an obstacle.
        pytest.param(each, marks=pytest.mark.slow if each[0] == "jax" else ())
        for each in ENGINES
    ],
    ids="-".join,
)
def loaded(request: pytest.FixtureRequest) -> Iterator[physics.Physics]:
    # A program that uses Warp calls back into the process that compiled it, so it must not be
    # cached on disk.
    seconds = jax.config.jax_persistent_cache_min_compile_time_secs
    if request.param[0] == "warp":
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1e9)
    yield programs.load_world(settings(*request.param)).physics
    jax.config.update("jax_persistent_cache_min_compile_time_secs", seconds)


def _drive(loaded: physics.Physics, pose: np.ndarray, scenes: Scenes) -> np.ndarray:
    """Drives robots ahead through the scenes in MJX and returns their poses [T, A, R, 3]."""
    wheels = jnp.broadcast_to(jnp.asarray(AHEAD, jnp.float32), (ROBOTS, 2))
    step = jax.vmap(lambda data, side, obstacle: physics.step(loaded, data, side, obstacle, wheels))

    @jax.jit
    def run(data: Any, side: Any, obstacle: Any) -> tuple[Any, Any]:
        def once(data: Any, _: None) -> tuple[Any, Any]:
            data = step(data, side, obstacle)
            return data, physics.poses(loaded, data)

        return jax.lax.scan(once, data, length=CHUNK)

    data = jax.vmap(lambda p: physics.unpack(loaded, physics.rest(loaded, p)))(
        jnp.asarray(pose, jnp.float32)
    )
    found = []
    for side, obstacle in zip(*scenes, strict=True):
        data, path = run(data, jnp.asarray(side, jnp.float32), jnp.asarray(obstacle, jnp.float32))
        found.append(np.asarray(path))
    return np.concatenate(found)


def _drive_in_c(
    robot: RobotConfig, pose: np.ndarray, scenes: Scenes, fixtures: model.Fixtures = "mocap"
) -> np.ndarray:
    """Drives the robots of one arena in MuJoCo C and returns their poses [T, R, 3].

    The arena has starting poses [R, 3], sides [3] and obstacles [3, M, 5].
    """
    count, body = physics_substeps(robot, None), model.BODIES[robot.body]
    built = compile_in_c(robot, scenes.obstacle[0], count, fixtures)
    data, ids = mujoco.MjData(built), model.ids(built, SIZE)
    data.qpos = body.qpos(pose, np)
    ctrl = body.ctrl(np.broadcast_to(AHEAD, (ROBOTS, 2)), AS_BUILT, robot, np)
    if built.nu:
        data.ctrl = ctrl
    step = mujoco.mj_step if built.nu else functools.partial(push, robot=robot, ctrl=ctrl)
    found = []
    for side, obstacle in zip(*scenes, strict=True):
        _place_in_c(built, data, ids, side, obstacle)
        for _ in range(CHUNK):
            for _ in range(count):
                step(built, data)
            found.append(np.array(body.pose(data.qpos, np)))
    return np.array(found)


def _place_in_c(
    built: mujoco.MjModel,
    data: mujoco.MjData,
    ids: model.Ids,
    side: float,
    obstacle: np.ndarray,
) -> None:
    """Moves obstacles and walls, which are mocap bodies or geoms of the world."""
    built.geom_size[ids.obstacle_geom, :2] = obstacle[:, 3:]
    place, turn = model.fixture_poses(side, obstacle, np)
    if (ids.fixture_mocap >= 0).all():
        data.mocap_pos[ids.fixture_mocap], data.mocap_quat[ids.fixture_mocap] = place, turn
        return
    built.geom_pos[ids.fixture_geom] = place + np.array([0.0, 0.0, model.HALF_HEIGHT])
    built.geom_quat[ids.fixture_geom] = turn
    # The geoms were compiled with the world's orientation, and MuJoCo C assumes that they keep it.
    built.geom_sameframe[ids.fixture_geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


def _arena(scenes: Scenes, arena: int) -> Scenes:
    return Scenes(*(each[:, arena] for each in scenes))


@pytest.mark.slow
def test_what_moves_stops_a_robot_where_it_is_and_no_longer_where_it_was(
    loaded: physics.Physics,
) -> None:
    pose, scenes = _scenes()
    path = _drive(loaded, pose, scenes)
    ends = np.concatenate([pose[None], path[CHUNK - 1 :: CHUNK]])[..., :2]
    gone = np.linalg.norm(np.diff(ends, axis=0), axis=-1)  # [3, A, R]
    stopped = np.broadcast_to(STOPPED[:, None], gone.shape)
    # A free robot drives 80 mm, less up to 4 mm if its wheels still slip when its way is cleared. A
    # stopped robot drives 10 mm and sinks in by at most the 4 mm of a control step. Another 3 mm
    # either way allow for the robot's position after the previous scene.
    assert np.all(gone[~stopped] > WAY - 0.005)
    assert np.all(gone[stopped] < CLEAR + 0.007)
    assert np.all(gone[stopped] > CLEAR - 0.003)


@pytest.mark.slow
def test_what_moves_is_met_as_in_c(loaded: physics.Physics) -> None:
    pose, scenes = _scenes()
    found = _drive(loaded, pose, scenes)
    arenas = [_drive_in_c(loaded.robot, pose[a], _arena(scenes, a)) for a in range(ARENAS)]
    apart = np.abs(found - np.stack(arenas, axis=1))
    apart[..., 2] = np.abs(turned(apart[..., 2]))
    # The bounds are those of test_physics.py for float32 in contact.
    planar = loaded.robot.body == "planar"
    assert apart[..., :2].max() <= (1.3e-5 if planar else 3e-5)  # m
    assert apart[..., 2].max() <= (2e-5 if planar else 5e-4)  # rad


@pytest.mark.parametrize("body", ["planar", "wheeled"])
def test_both_descriptions_are_one_world(body: BodyName) -> None:
    """Compares fixtures as bodies and as geoms, and planar servos as actuators and as forces."""
    pose, scenes = _scenes()
    drive = functools.partial(_drive_in_c, RobotConfig(body=body))
    for arena in range(4):
        mocap, world = (
            drive(pose[arena], _arena(scenes, arena), each) for each in ("mocap", "world")
        )
        apart = np.abs(world - mocap)
        apart[..., 2] = np.abs(turned(apart[..., 2]))
        assert apart.max() <= 1e-9  # m and rad; float64 gives 7e-13 with wheels that slip
