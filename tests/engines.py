"""Runs three engines through one interface: MJX by `jax`, MJX by `warp`, and MuJoCo C."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from swarmjax.run.settings import TrainConfig
from swarmjax.sim import drive, model, physics
from swarmjax.sim.body import AS_BUILT, Chassis
from swarmjax.sim.config import RobotConfig, SimConfig, physics_substeps
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import program as programs

ARENAS, ROBOTS, OBSTACLES = 8, 3, 2
STEP, RADIUS = 0.032, 0.037  # s, m
BIGGEST_HALF = 0.15  # m, the bound that the model is compiled for
FULL = 0.1256  # m/s
AWAY = np.array([[-5.0, -5.0, 0.0, 0.05, 0.05], [-5.5, -5.0, 0.0, 0.05, 0.05]], np.float32)
BodyName = Literal["planar", "wheeled"]
ENGINES = [(impl, body) for body in ("planar", "wheeled") for impl in ("jax", "warp")]


class Path(NamedTuple):
    """The result of driving, [T, A, R, ...]: poses (x, y, yaw) and joint velocities."""

    pose: np.ndarray
    rate: np.ndarray


CHUNK = 20  # control steps of one call of `Engine.run`


class Engine(NamedTuple):
    """The physics of one implementation, and its compiled control steps of all arenas.

    `run` takes the model, data, side, obstacle, wheels [T, A, R, 2] and chassis. It returns the
    final data, and qpos and qvel of every control step.
    """

    config: TrainConfig
    loaded: physics.Physics
    run: Callable[..., Any]


def settings(impl: Literal["jax", "warp"], body: BodyName) -> TrainConfig:
    """Returns settings with three robots and two obstacles."""
    stage = StageConfig(
        name="boxes", robots=ROBOTS, side=1.3, obstacles=OBSTACLES, obstacle_size=2 * BIGGEST_HALF
    )
    sim = SimConfig(impl=impl, max_robots=ROBOTS, max_obstacles=OBSTACLES)
    robot = RobotConfig(body=body)
    return TrainConfig(stage=(stage,), robot=robot, sim=sim, arenas=ARENAS, budget=10_000)


def load(impl: Literal["jax", "warp"], body: BodyName) -> Engine:
    """Loads an engine with three robots and two obstacles."""
    return load_as(settings(impl, body))


def load_as(config: TrainConfig) -> Engine:
    """Loads an engine whose `run` takes the model as an argument, so that tests may change it."""
    loaded = programs.load_world(config).physics

    def run(model: Any, data: Any, side: Any, obstacle: Any, wheels: Any, chassis: Any) -> Any:
        engine = dataclasses.replace(loaded.engine, model=model)
        mine = dataclasses.replace(loaded, engine=engine)

        def step(data: Any, now: Any) -> tuple[Any, Any]:
            move = jax.vmap(lambda d, w: physics.step(mine, d, side, obstacle, w, chassis))
            data = move(data, now)
            return data, (data.qpos, data.qvel)

        return jax.lax.scan(step, data, wheels)

    return Engine(config, loaded, jax.jit(run))


def start(engine: Engine, pose: np.ndarray) -> Any:
    """Returns the data of arenas [A] at rest, with robots at poses [A, R, 3] or [R, 3]."""
    pose = np.broadcast_to(pose, (ARENAS, ROBOTS, 3)).astype(np.float32)
    state = jax.vmap(lambda p: physics.rest(engine.loaded, p))(jnp.asarray(pose))
    return jax.vmap(lambda s: physics.unpack(engine.loaded, s))(state)


def wheels_of(velocity: np.ndarray) -> np.ndarray:
    """Returns unclamped wheel speeds [..., 2] for forward speed and turn rate [..., 2]."""
    free = drive.from_config(RobotConfig())._replace(max_wheel_speed=np.inf)
    return drive.wheel_speeds(np.asarray(velocity, np.float64), free, np)


def drive_all(
    engine: Engine,
    pose: np.ndarray,
    wheels: np.ndarray,
    obstacle: np.ndarray = AWAY,
    *,
    side: float = 0.6,
    chassis: Chassis = AS_BUILT,
    model: Any = None,
) -> Path:
    """Drives all arenas from rest at these poses, with wheel speeds [T, A, R, 2] or [T, 2]."""
    data, found, count = start(engine, pose), [], len(wheels)
    if wheels.ndim == 2:
        wheels = wheels[:, None, None]
    wheels = np.broadcast_to(wheels, (count, ARENAS, ROBOTS, 2)).astype(np.float32)
    # The steps are padded to whole chunks, so that one program serves all tests. The results of the
    # padding are dropped.
    wheels = np.concatenate([wheels, np.repeat(wheels[-1:], -count % CHUNK, axis=0)])
    model = engine.loaded.engine.model if model is None else model
    for now in wheels.reshape(-1, CHUNK, ARENAS, ROBOTS, 2):
        arena = (jnp.float32(side), jnp.asarray(obstacle), jnp.asarray(now), chassis)
        data, path = engine.run(model, data, *arena)
        found.append(path)
    qpos, rate = (np.concatenate(parts)[:count] for parts in zip(*found, strict=True))
    pose = np.asarray(engine.loaded.body.pose(jnp.asarray(qpos), jnp))
    return Path(pose, rate.reshape(*pose.shape[:3], -1))


def compile_in_c(
    robot: RobotConfig, obstacle: np.ndarray, steps: int, fixtures: model.Fixtures = "mocap"
) -> Any:
    """Compiles the same model for MuJoCo C in float64, with a solver that runs to convergence."""
    size = model.ArenaSize(ROBOTS, OBSTACLES, BIGGEST_HALF)
    spec = model.build(robot, size, STEP / steps, fixtures=fixtures)
    spec.option.iterations, spec.option.tolerance = 100, 1e-14
    spec.option.ls_iterations, spec.option.ls_tolerance = 100, 1e-6
    built = spec.compile()
    built.geom_size[model.ids(built, size).obstacle_geom, :2] = obstacle[:, 3:]
    return built


def drive_in_c(
    robot: RobotConfig,
    pose: np.ndarray,
    wheels: np.ndarray,
    obstacle: np.ndarray = AWAY,
    *,
    side: float = 0.6,
    built: mujoco.MjModel | None = None,
) -> Path:
    """Drives one arena [R, 3] in MuJoCo C, with wheels [T, R, 2]; the path is [T, 1, R, ...]."""
    given: Any = built or compile_in_c(robot, obstacle, physics_substeps(robot, None))
    count = round(STEP / given.opt.timestep)
    data, body = mujoco.MjData(given), model.BODIES[robot.body]
    ids = model.ids(given, model.ArenaSize(ROBOTS, OBSTACLES, BIGGEST_HALF))
    place, turn = model.fixture_poses(side, obstacle, np)
    data.mocap_pos[ids.fixture_mocap], data.mocap_quat[ids.fixture_mocap] = place, turn
    data.qpos[:] = body.qpos(np.asarray(pose, np.float64), np)
    found, rate = [], []
    for now in np.broadcast_to(wheels, (len(wheels), ROBOTS, 2)).astype(np.float64):
        data.ctrl[:] = body.ctrl(now, AS_BUILT, robot, np)
        mujoco.mj_step(given, data, count)
        found.append(np.array(body.pose(data.qpos, np)))
        rate.append(data.qvel.reshape(ROBOTS, -1).copy())
    return Path(np.array(found)[:, None], np.array(rate)[:, None])


def push(built: mujoco.MjModel, data: mujoco.MjData, robot: RobotConfig, ctrl: np.ndarray) -> None:
    """Advances MuJoCo C by one physics step, with the servos' present forces applied."""
    servos, now = model.BODIES[robot.body].servos, (data.qpos, data.qvel, ctrl)
    assert servos is not None
    data.qfrc_applied = servos.force(*now, AS_BUILT, robot, built.opt.timestep, np)
    mujoco.mj_step(built, data)


def turned(yaw: np.ndarray) -> np.ndarray:
    """Wraps angles [...] to -pi..pi."""
    return (np.asarray(yaw) + np.pi) % (2.0 * np.pi) - np.pi


def alone(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """Returns poses [R, 3]: robot 0 at this pose, the other robots far from everything."""
    return np.array([[x, y, yaw], [5.0, 5.0, 0.0], [5.5, 5.0, 0.0]])
