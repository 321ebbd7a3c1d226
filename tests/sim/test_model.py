"""Tests the compiled model: its ids, its contact pairs and the places of walls and obstacles."""

from typing import Literal

import mujoco
import numpy as np
import pytest

from swarmjax import epuck
from swarmjax.sim import model
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.model import ArenaSize

SIZE = ArenaSize(robots=3, obstacles=2, largest_half=0.15)
STEP = 0.032  # s


@pytest.fixture(scope="module")
def compiled() -> mujoco.MjModel:
    return model.build(RobotConfig(), SIZE, STEP).compile()


def test_ids_point_at_the_named_bodies(compiled: mujoco.MjModel) -> None:
    ids = model.ids(compiled, SIZE)
    fixtures = [
        next(b for b in range(compiled.nbody) if compiled.body_mocapid[b] == row)
        for row in ids.fixture_mocap
    ]
    names = [compiled.body(b).name for b in fixtures]
    assert names == ["obstacle0", "obstacle1", "wall0", "wall1", "wall2", "wall3"]
    assert [compiled.geom(g).name for g in ids.obstacle_geom] == ["obstacle0_box", "obstacle1_box"]
    assert [compiled.body(b).name for b in ids.hull_body] == ["robot0", "robot1", "robot2"]


@pytest.mark.parametrize("body", ["planar", "wheeled"])
@pytest.mark.parametrize("fixtures", ["mocap", "world"])
def test_bodies_and_geoms_of_either_description(
    fixtures: model.Fixtures, body: Literal["planar", "wheeled"]
) -> None:
    built = model.build(RobotConfig(body=body), SIZE, STEP, fixtures=fixtures).compile()
    ids = model.ids(built, SIZE)
    # The world is one body. A planar robot has one body, and a wheeled robot three. Obstacles and
    # walls are six mocap bodies.
    robots = 3 if body == "planar" else 9
    assert built.nbody == 1 + robots + (6 if fixtures == "mocap" else 0)
    assert built.nmocap == (6 if fixtures == "mocap" else 0)
    # A planar robot has three servos, except in the description for MJX, which gets their forces
    # instead. A wheeled robot has two motors in both descriptions.
    assert (built.nu, built.nsite) == {
        ("planar", "mocap"): (9, 3), ("planar", "world"): (0, 0),
        ("wheeled", "mocap"): (6, 0), ("wheeled", "world"): (6, 0),
    }[body, fixtures]  # fmt: skip
    assert ids.robots.actuators.shape == (3, built.nu // 3)
    names = ["obstacle0", "obstacle1", "wall0", "wall1", "wall2", "wall3"]
    assert [built.geom(int(g)).name for g in ids.fixture_geom] == [f"{n}_box" for n in names]
    np.testing.assert_array_equal(np.diff(ids.fixture_geom), 1)  # MJX replaces these as a slice
    np.testing.assert_array_equal(ids.obstacle_geom, ids.fixture_geom[:2])
    expected = np.arange(6) if fixtures == "mocap" else np.full(6, -1)
    np.testing.assert_array_equal(ids.fixture_mocap, expected)


@pytest.mark.parametrize("body", ["planar", "wheeled"])
def test_only_what_acts_on_nothing_is_switched_off(body: Literal["planar", "wheeled"]) -> None:
    built = model.build(RobotConfig(body=body), SIZE, STEP).compile()
    off, flags = mujoco.mjtDisableBit, built.opt.disableflags
    acting = (off.mjDSBL_EULERDAMP, off.mjDSBL_DAMPER, off.mjDSBL_SPRING, off.mjDSBL_FRICTIONLOSS)
    expected = sum(map(int, acting))
    assert flags & ~int(off.mjDSBL_GRAVITY) == expected
    for field in ("jnt_stiffness", "dof_damping", "dof_frictionloss", "body_gravcomp"):
        assert not getattr(built, field).any(), field
    # MuJoCo leaves out the drag of a fluid as well if springs and dampers are switched off.
    assert built.opt.density == built.opt.viscosity == 0.0
    # Gravity must be on only where it acts on the joints of robots at rest.
    built.opt.disableflags &= ~int(off.mjDSBL_GRAVITY)
    data = mujoco.MjData(built)
    pose = np.array([[0.0, 0.1, 0.3], [0.4, 0.0, -2.0], [-0.3, 0.2, 1.0]])
    data.qpos = model.BODIES[body].qpos(pose, np)
    mujoco.mj_forward(built, data)
    weighed = bool(data.qfrc_bias.any())  # exact, since at rest there is no other bias
    assert weighed == (body == "wheeled")
    assert weighed != bool(flags & int(off.mjDSBL_GRAVITY))


@pytest.mark.parametrize("size", [ArenaSize(1, 0, 0.05), ArenaSize(5, 4, 0.05)])
def test_sizes(size: ArenaSize) -> None:
    built = model.build(RobotConfig(), size, STEP).compile()
    ids = model.ids(built, size)
    assert (built.nq, built.nv, built.nu) == (3 * size.robots,) * 3
    assert len(ids.obstacle_geom) == size.obstacles
    assert len(ids.fixture_mocap) == size.obstacles + 4
    assert built.opt.timestep == STEP


def test_only_hulls_touch(compiled: mujoco.MjModel) -> None:
    # No geoms collide by type. The explicit pairs are all hull-hull pairs (3), hull-obstacle pairs
    # and hull-wall pairs.
    assert not compiled.geom_contype.any()
    assert not compiled.geom_conaffinity.any()
    pairs = {
        frozenset(compiled.geom(int(g)).name for g in pair)
        for pair in zip(compiled.pair_geom1, compiled.pair_geom2, strict=True)
    }
    hulls = [f"robot{i}_hull" for i in range(3)]
    fixed = ["obstacle0_box", "obstacle1_box", "wall0_box", "wall1_box", "wall2_box", "wall3_box"]
    expected = {frozenset((a, b)) for a in hulls for b in fixed}
    expected |= {frozenset((a, b)) for a in hulls for b in hulls if a != b}
    assert pairs == expected
    assert compiled.npair == 3 + 3 * 6
    assert (compiled.pair_dim == 1).all()


def test_hulls_rub_on_all_that_they_touch() -> None:
    compiled = model.build(RobotConfig(body="wheeled", hull_friction=0.5), SIZE, 0.016).compile()
    floor, pairs = compiled.geom("floor").id, (compiled.pair_geom1, compiled.pair_geom2)
    hulls = np.flatnonzero((pairs[0] != floor) & (pairs[1] != floor))
    assert len(hulls) == 3 + 3 * 6
    assert (compiled.pair_dim[hulls] == 3).all()
    np.testing.assert_array_equal(compiled.pair_friction[hulls, :2], 0.5)
    others = np.delete(compiled.pair_friction[:, 0], hulls)
    np.testing.assert_array_equal(others, 1.0)  # wheels and skids on the floor


def test_robot_has_the_numbers_of_the_config() -> None:
    robot = RobotConfig(
        mass=0.2, yaw_inertia=3e-4, hull_radius=0.04, effective_track=0.06, friction=0.5
    )
    built = model.build(robot, SIZE, STEP).compile()
    body = built.body("robot1")
    assert body.mass[0] == 0.2
    assert body.inertia[2] == 3e-4
    assert built.geom("robot1_hull").size[0] == 0.04
    # Coulomb friction limits the force to 0.5 * 0.2 kg * 9.81 = 0.981 N along either axis, and the
    # torque to this force times 0.03 m.
    limits = built.actuator_forcerange[3:6, 1]
    np.testing.assert_allclose(limits, [0.981, 0.981, 0.981 * 0.03], rtol=1e-12)
    np.testing.assert_array_equal(built.actuator_forcerange[:, 0], -built.actuator_forcerange[:, 1])
    # A deadbeat servo has the gain inertia / step.
    gains = built.actuator_gainprm[3:6, 0]
    np.testing.assert_allclose(gains, [0.2 / STEP, 0.2 / STEP, 3e-4 / STEP], rtol=1e-12)


def test_servos_lag_along_what_the_motors_drive() -> None:
    built = model.build(RobotConfig(motor_lag=0.1), SIZE, STEP).compile()
    # A step is 0.32 time constants, so a lagging servo closes 1 - exp(-0.32) = 0.273851 of the
    # difference. Sideways there is no motor, so nothing lags.
    robot, share = RobotConfig(), np.array([0.273851, 1.0, 0.273851])
    inertia = np.array([robot.mass, robot.mass, robot.yaw_inertia])
    gains = built.actuator_gainprm[3:6, 0]
    np.testing.assert_allclose(gains, share * inertia / STEP, rtol=1e-6)  # the share's digits


def test_a_ray_sees_the_hull_as_the_webots_cylinder() -> None:
    assert "robot0_body" not in _geom_names(ray_geoms=False)
    built = model.build(RobotConfig(), SIZE, STEP, ray_geoms=True).compile()
    geom = built.geom("robot0_body")
    assert geom.type[0] == mujoco.mjtGeom.mjGEOM_CYLINDER
    radius, half = geom.size[0], geom.size[1]
    assert radius == 0.037
    # The cylinder's z goes from 0.0025 to 0.0475 m. 1e-12 m is the rounding of float64.
    assert geom.pos[2] - half == pytest.approx(0.0025, abs=1e-12)
    assert geom.pos[2] + half == pytest.approx(0.0475, abs=1e-12)
    assert geom.pos[2] - half < epuck.SENSOR_HEIGHT < geom.pos[2] + half


def _geom_names(*, ray_geoms: bool) -> list[str]:
    built = model.build(RobotConfig(), SIZE, STEP, ray_geoms=ray_geoms).compile()
    return [built.geom(i).name for i in range(built.ngeom)]


def test_fixtures_stand_where_the_level_says(compiled: mujoco.MjModel) -> None:
    side = 0.9
    obstacle = np.array([[0.1, -0.2, 0.4, 0.05, 0.02], [-0.3, 0.1, 2.0, 0.15, 0.05]])
    ids, data = model.ids(compiled, SIZE), mujoco.MjData(compiled)
    place, turn = model.fixture_poses(side, obstacle, np)
    data.mocap_pos[ids.fixture_mocap], data.mocap_quat[ids.fixture_mocap] = place, turn
    mujoco.mj_forward(compiled, data)
    for i, (x, y, yaw) in enumerate(obstacle[:, :3]):
        box = data.geom(f"obstacle{i}_box")
        np.testing.assert_allclose(box.xpos[:2], [x, y], atol=1e-12)  # rounding of float64
        expected = [np.cos(yaw), np.sin(yaw)]
        np.testing.assert_allclose(box.xmat.reshape(3, 3)[:2, 0], expected, atol=1e-12)  # as above
    for i, outward in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)]):
        box, half = data.geom(f"wall{i}_box"), compiled.geom(f"wall{i}_box").size
        extent = np.abs(box.xmat.reshape(3, 3)[:2]) @ half
        # The inner face is half a side from the centre. 8e-6 m is the rounding of a float32 bearing
        # at 20.5 m.
        assert np.dot(box.xpos[:2] - extent * outward, outward) == pytest.approx(0.45, abs=8e-6)
        # The wall is at least as long as the largest arena's side, 40 m.
        assert (extent * (1 - np.abs(outward))).sum() >= 20.0


def test_resized_obstacles_are_those_that_would_be_compiled(compiled: mujoco.MjModel) -> None:
    half = np.array([[0.3, 0.01], [0.02, 0.2]])
    found = model.resize_obstacles(compiled, model.ids(compiled, SIZE), half)
    spec = model.build(RobotConfig(), SIZE, STEP)
    for i, edges in enumerate(half):
        spec.geom(f"obstacle{i}_box").size[:2] = edges
    expected = spec.compile()
    for name in dir(expected):
        if isinstance(theirs := getattr(expected, name), np.ndarray):
            np.testing.assert_array_equal(getattr(found, name), theirs, err_msg=name)


def test_resizing_leaves_the_compiled_model_as_it_was(compiled: mujoco.MjModel) -> None:
    before = compiled.geom_size.copy()
    model.resize_obstacles(compiled, model.ids(compiled, SIZE), np.full((2, 2), 0.3))
    np.testing.assert_array_equal(compiled.geom_size, before)
