"""Tests the swarm solvers against MuJoCo C, in arenas so crowded that robots push each other."""

import itertools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from engines import BodyName

from swarmjax.run.settings import TrainConfig
from swarmjax.sim import dispatch, drive, model, physics
from swarmjax.sim.body import AS_BUILT
from swarmjax.sim.config import RobotConfig, SimConfig, physics_substeps
from swarmjax.sim.fast import contacts_warp, discs, planar_jax
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import program as programs

Impl = Literal["jax", "warp"]
Solver = Literal["mjx", "swarm"]
ROBOTS, ARENAS, STEP = 5, 24, 0.032
BOX = np.array([[0.05, 0.02, 0.4, 0.05, 0.05]], np.float32)


def _load(
    impl: Impl,
    body: BodyName,
    solver: Solver,
    obstacles: int = 1,
    stage: StageConfig | None = None,
    friction: float = 0.0,
) -> physics.Physics:
    if stage is None:
        box = {"obstacles": obstacles, "obstacle_size": 0.1}
        stage = StageConfig(name="box", robots=ROBOTS, side=1.3, **box)
    sim = SimConfig(impl=impl, solver=solver, max_robots=stage.robots, max_obstacles=obstacles)
    robot = RobotConfig(body=body, hull_friction=friction)
    settings = TrainConfig(stage=(stage,), robot=robot, sim=sim, arenas=ARENAS, budget=10_000)
    return programs.load_world(settings).physics


def _crowds(
    side: float, arenas: int = ARENAS, robots: int = ROBOTS
) -> tuple[np.ndarray, np.ndarray]:
    """Returns random poses [A, R, 3] of robots that overlap each other, and their wheel speeds.

    At a side of 0.5 m a third of the robots also overlap a wall or the box, and at 0.16 m most do.
    """
    random = np.random.default_rng(3)
    pose = random.uniform(-0.5, 0.5, (arenas, robots, 3)) * [side, side, 6.0]
    action = random.uniform(-1.0, 1.0, (arenas, robots, 2))
    robot = drive.from_config(RobotConfig())
    wheels = drive.wheel_speeds(drive.command(action, robot, np), robot, np)
    return pose.astype(np.float32), wheels.astype(np.float32)


def _on_device(
    loaded: physics.Physics,
    side: float,
    pose: np.ndarray,
    wheels: np.ndarray,
    box: np.ndarray = BOX,
) -> Any:
    """Returns the joint velocities [A, V] after one control step from rest."""

    def move(pose: Any, wheels: Any) -> Any:
        data = physics.unpack(loaded, physics.rest(loaded, pose))
        return physics.step(loaded, data, jnp.float32(side), jnp.asarray(box), wheels).qvel

    return np.asarray(jax.jit(jax.vmap(move))(pose, wheels))


def _in_c(
    robot: RobotConfig,
    side: float,
    pose: np.ndarray,
    wheels: np.ndarray,
    box: np.ndarray = BOX,
) -> tuple[np.ndarray, int]:
    """Returns joint velocities by MuJoCo C, and how many pairs of robots touch at the start.

    MuJoCo C computes in float64, and its solver iterates until it converges.
    """
    count = physics_substeps(robot, None)
    size = model.ArenaSize(len(pose), len(box), 0.05)
    spec = model.build(robot, size, STEP / count)
    spec.option.iterations, spec.option.tolerance = 100, 1e-14
    spec.option.ls_iterations, spec.option.ls_tolerance = 100, 1e-6
    built = spec.compile()
    ids, body = model.ids(built, size), model.BODIES[robot.body]
    built = model.resize_obstacles(built, ids, box[:, 3:])
    data = mujoco.MjData(built)
    place, turn = model.fixture_poses(side, box, np)
    data.mocap_pos[ids.fixture_mocap], data.mocap_quat[ids.fixture_mocap] = place, turn
    data.qpos[:] = body.qpos(pose.astype(np.float64), np)
    data.ctrl[:] = body.ctrl(wheels.astype(np.float64), AS_BUILT, robot, np)
    mujoco.mj_forward(built, data)
    moving = built.body_rootid[built.geom_bodyid[data.contact.geom]]
    pairs = int(np.sum(np.isin(moving, ids.hull_body).all(axis=1)))
    mujoco.mj_step(built, data, count)
    return data.qvel.copy(), pairs


# At a side of 0.16 m the sweeps of the planar solver converge slowly, and the few Newton steps of
# MJX by JAX do not converge. Float32 rounds at 1e-7, and a wheel's grip is 1e3 times as stiff as
# its robot. Each row holds the largest errors measured, as shares of the fastest joint's and of
# the fastest robot's velocity. The tests allow twice these errors.
CROWDS = {
    ("warp", "planar", "swarm", 0.16): (4.0e-6, 2.1e-5),
    ("jax", "planar", "swarm", 0.16): (2.4e-6, 1.2e-5),
    ("warp", "wheeled", "swarm", 0.16): (1.4e-5, 2.9e-6),
    ("warp", "planar", "mjx", 0.16): (2.4e-5, 5.4e-7),
    ("jax", "planar", "mjx", 0.16): (0.25, 0.56),
    ("warp", "wheeled", "mjx", 0.16): (5.1e-5, 1.7e-5),
    ("warp", "planar", "swarm", 0.5): (4.6e-7, 3.5e-6),
    ("jax", "planar", "swarm", 0.5): (4.0e-7, 2.7e-6),
    ("warp", "wheeled", "swarm", 0.5): (6.7e-6, 8.0e-7),
    ("warp", "planar", "mjx", 0.5): (1.7e-6, 2.1e-6),
    ("warp", "wheeled", "mjx", 0.5): (2.1e-5, 1.7e-5),
    ("jax", "planar", "mjx", 0.5): (4.2e-6, 1.6e-6),
}
# A wall across the arena, with a doorway of 0.13 m.
DOOR = np.array([[0.0, 0.315, 0.0, 0.01, 0.25], [0.0, -0.315, 0.0, 0.01, 0.25]], np.float32)
# The largest errors measured, as shares of the fastest joint's velocity. The test allows twice as
# much.
JAMS = {
    ("warp", "planar", "swarm"): 1.3e-5,
    ("jax", "planar", "swarm"): 8.5e-6,
    ("warp", "wheeled", "swarm"): 4.3e-6,
    ("warp", "planar", "mjx"): 1.8e-5,
    ("warp", "wheeled", "mjx"): 1.1e-5,
}


@pytest.mark.parametrize(
    ("impl", "body", "solver"),
    [
        pytest.param(*case, marks=[pytest.mark.slow] * (case[2] == "mjx" or case[0] == "jax"))
        for case in JAMS
    ],
)
def test_robots_jam_in_a_doorway_as_in_c(impl: Impl, body: BodyName, solver: Solver) -> None:
    pose, wheels = _jams()
    # Warp looks for contacts only within the size of the largest box in the stages, so this stage
    # has a door.
    stage = StageConfig(
        name="door", level="door", robots=ROBOTS, side=1.3, obstacles=2, gap=0.13, apart=0.25
    )
    loaded = _load(impl, body, solver, 2, stage)
    found = _on_device(loaded, 1.13, pose, wheels, DOOR)
    robot = RobotConfig(body=body)
    each = [_in_c(robot, 1.13, p, w, DOOR) for p, w in zip(pose, wheels, strict=True)]
    expected, pairs = np.array([one[0] for one in each]), [one[1] for one in each]
    assert min(pairs) >= 2
    assert _off(found, expected) <= 2.0 * JAMS[impl, body, solver]


def _jams() -> tuple[np.ndarray, np.ndarray]:
    """Returns poses and wheel speeds: three robots push into a doorway, and two are far from it."""
    random = np.random.default_rng(4)
    # The first three robots overlap each other, and the first two touch the jambs. Each place is
    # shifted at random by up to 2 mm along x and y.
    places = np.array([(-0.01, 0.030), (-0.01, -0.030), (-0.070, 0.0), (-0.3, 0.3), (0.3, -0.3)])
    pose = np.zeros((ARENAS, ROBOTS, 3), np.float32)
    pose[..., :2] = places + random.uniform(-0.002, 0.002, (ARENAS, ROBOTS, 2))
    pose[..., 2] = random.uniform(-0.5, 0.5, (ARENAS, ROBOTS))
    robot = drive.from_config(RobotConfig())
    action = np.stack([np.ones((ARENAS, ROBOTS)), np.zeros((ARENAS, ROBOTS))], axis=-1)
    wheels = drive.wheel_speeds(drive.command(action, robot, np), robot, np)
    return pose, wheels.astype(np.float32)


PAIRS = {0.16: 9, 0.5: 2}  # the fullest arena has this many touching pairs or more, by side in m


# MJX is the reference, and compiles longest.
@pytest.mark.parametrize(
    ("impl", "body", "solver", "side"),
    [pytest.param(*case, marks=[pytest.mark.slow] * (case[2] == "mjx")) for case in CROWDS],
)
def test_crowds_push_each_other_apart_as_in_c(
    impl: Impl,
    body: BodyName,
    solver: Solver,
    side: float,
) -> None:
    pose, wheels = _crowds(side)
    seen = CROWDS[impl, body, solver, side]
    found = _on_device(_load(impl, body, solver), side, pose, wheels)
    each = [_in_c(RobotConfig(body=body), side, p, w) for p, w in zip(pose, wheels, strict=True)]
    expected, pairs = np.array([one[0] for one in each]), [one[1] for one in each]
    assert max(pairs) >= PAIRS[side]
    assert np.abs(expected).max(axis=1).min() > 1.0  # the robots fly apart
    assert _off(found, expected) <= 2.0 * seen[0]
    assert _off(_places(found), _places(expected)) <= 2.0 * seen[1]


# The largest errors measured with friction between hulls, in the columns of `CROWDS`. At 0.16 m the
# sweeps converge more slowly than without friction, and MJX's Newton method by Warp is closer to
# MuJoCo C. To be as close the sweeps would need a tolerance of 1e-7, which float32 seldom reaches.
RUBBING = {
    ("jax", "swarm", 0.16): (1.1e-4, 5.4e-5),
    ("warp", "swarm", 0.16): (1.2e-4, 2.8e-5),
    ("jax", "swarm", 0.5): (4.3e-6, 2.5e-6),
    ("warp", "swarm", 0.5): (6.9e-6, 3.0e-6),
    ("jax", "mjx", 0.5): (2.4e-5, 1.7e-6),
    ("warp", "mjx", 0.16): (6.6e-6, 8.1e-7),
}


@pytest.mark.parametrize(("impl", "solver", "side"), RUBBING)
@pytest.mark.slow
def test_crowds_that_rub_push_each_other_apart_as_in_c(
    impl: Impl, solver: Solver, side: float
) -> None:
    (pose, wheels), seen = _crowds(side), RUBBING[impl, solver, side]
    pose = _beside_the_box(pose)
    found = _on_device(_load(impl, "planar", solver, friction=0.5), side, pose, wheels)
    robot = RobotConfig(hull_friction=0.5)
    expected = np.array([_in_c(robot, side, p, w)[0] for p, w in zip(pose, wheels, strict=True)])
    assert _off(found, expected) <= 2.0 * seen[0]
    assert _off(_places(found), _places(expected)) <= 2.0 * seen[1]


def _beside_the_box(pose: np.ndarray) -> np.ndarray:
    """Moves robots whose centre is deep inside the box to 8 mm behind one of its faces.

    Deep inside the box MuJoCo pushes a robot down, where it has no joint, and the friction of that
    push brakes the robot. The solver of discs applies no such force.
    """
    x, y, yaw, half = BOX[0, :4]
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    mine = (pose[..., :2] - [x, y]) @ turn
    deep = np.abs(mine).max(axis=-1) < half - 0.013
    out = np.stack([np.sign(mine[..., 0]) * (half - 0.008), 0.5 * mine[..., 1]], axis=-1)
    moved = pose.copy()
    moved[..., :2] = np.where(deep[..., None], [x, y] + out @ turn.T, pose[..., :2])
    return moved


def test_two_hundred_robots_push_each_other_apart_as_in_c() -> None:
    shape = {"level": "plots", "side": 8.0, "obstacles": 1, "obstacle_size": 0.1}
    stage = StageConfig(name="many", robots=200, **shape)
    assert stage.robots > contacts_warp.MANY  # their contacts are found by cells
    (pose, wheels), side = _crowds(1.0, 2, stage.robots), 1.0
    found = _on_device(_load("warp", "planar", "swarm", stage=stage), side, pose, wheels)
    each = [_in_c(RobotConfig(), side, p, w) for p, w in zip(pose, wheels, strict=True)]
    assert min(pairs for _, pairs in each) >= 320
    # The largest error was 1.4e-6.
    assert _off(found, np.array([rate for rate, _ in each])) <= 2.8e-6


def test_twenty_wheeled_robots_push_each_other_apart_as_in_c() -> None:
    stage, side = (
        StageConfig(name="many", robots=20, side=2.4, obstacles=1, obstacle_size=0.1),
        0.25,
    )
    pose, wheels = _crowds(side, 12, stage.robots)
    found = _on_device(_load("warp", "wheeled", "swarm", stage=stage), side, pose, wheels)
    each = [
        _in_c(RobotConfig(body="wheeled"), side, p, w) for p, w in zip(pose, wheels, strict=True)
    ]
    assert min(pairs for _, pairs in each) >= 30
    # The largest error was 1.3e-5; that of MJX-Warp's own step is 2.1e-5.
    assert _off(found, np.array([rate for rate, _ in each])) <= 2.6e-5


@pytest.mark.parametrize("side", PAIRS)
@pytest.mark.parametrize(
    ("impl", "body"), [("jax", "planar"), ("warp", "planar"), ("warp", "wheeled")]
)
def test_auto_takes_a_faster_step_only_where_it_is_held_as_closely_as_mjx(
    impl: Impl, body: BodyName, side: float
) -> None:
    assert dispatch.resolve_solver("auto", impl, body, ROBOTS) == "swarm"
    # Compares the errors over all joints. Along x and y alone the solver of discs is off by up to
    # 8e-6 m/s at 0.16 m, by rounding.
    assert CROWDS[impl, body, "swarm", side][0] <= CROWDS[impl, body, "mjx", side][0]


@pytest.mark.parametrize("impl", ["jax", "warp"])
def test_what_lies_in_one_place_is_pushed_apart_as_in_c(impl: Impl) -> None:
    # Two hulls share one place. One hull is in the middle of the box (half edges 0.05), where the
    # box's bottom is the nearest face. One hull is just inside a side face of the box, and one hull
    # is in a corner of the arena.
    box = BOX[0]
    turn = np.array([[np.cos(box[2]), -np.sin(box[2])], [np.sin(box[2]), np.cos(box[2])]])
    within = box[:2] + turn @ [0.04, 0.0]
    places = [(-0.4, 0.3), (-0.4, 0.3), box[:2], within, (0.63, 0.63)]
    pose = np.zeros((1, ROBOTS, 3), np.float32)
    pose[0, :, :2] = places
    wheels = np.zeros((1, ROBOTS, 2), np.float32)
    found = _on_device(_load(impl, "planar", "swarm"), 1.3, pose, wheels)[0].reshape(ROBOTS, 3)
    expected = _in_c(RobotConfig(), 1.3, pose[0], wheels[0])[0].reshape(ROBOTS, 3)
    assert np.abs(expected[[0, 1, 3, 4], :2]).max(axis=1).min() > 0.1
    # Float32 rounds numbers of about 1 by 1e-7, and a contact multiplies that by its stiffness of
    # about 10.
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("obstacles", [0, 1])
def test_arenas_of_several_seeds_are_arenas_of_one_kernel(obstacles: int) -> None:
    pose, wheels = _crowds(0.16)
    loaded, boxes = _load("warp", "planar", "swarm", obstacles), jnp.asarray(BOX[:obstacles])

    def move(side: Any, pose: Any, wheels: Any) -> Any:
        data = physics.unpack(loaded, physics.rest(loaded, pose))
        return physics.step(loaded, data, side, boxes, wheels).qvel

    once = jax.jit(jax.vmap(move))
    # The arenas of one seed have the same side, and all arenas share one box.
    sides, half = jnp.array([0.16, 0.5], jnp.float32), ARENAS // 2
    expected = once(np.repeat(sides, half), pose, wheels)
    split = (x.reshape(2, half, *x.shape[1:]) for x in (pose, wheels))
    found = jax.jit(jax.vmap(jax.vmap(move, (None, 0, 0))))(sides, *split)
    np.testing.assert_array_equal(np.asarray(found).reshape(ARENAS, -1), expected)


@pytest.mark.parametrize("robots", [1, 2, 3, 4, 5, 6, 9, 10])
def test_every_pair_of_robots_meets_once(robots: int) -> None:
    size = model.ArenaSize(robots, 1, 0.05)
    built = model.build(RobotConfig(), size, STEP).compile()
    rounds = discs.load(built, model.ids(built, size), 0.037, planar_jax.push_apart).opponent
    met = [(a, b) for row in rounds for a, b in enumerate(row) if a < b]
    assert sorted(met) == list(itertools.combinations(range(robots), 2))
    for row in rounds:
        np.testing.assert_array_equal(row[row], range(robots))  # meetings are mutual


def _places(rate: np.ndarray) -> np.ndarray:
    """Returns those joint velocities [A, V] that are along x and y."""
    return rate.reshape(ARENAS, ROBOTS, -1)[..., :2].reshape(ARENAS, -1)


def _off(found: np.ndarray, expected: np.ndarray) -> float:
    """Returns the largest error over arenas [A, ...], as a share of each arena's largest number."""
    return float((np.abs(found - expected).max(axis=1) / np.abs(expected).max(axis=1)).max())
