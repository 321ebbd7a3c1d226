"""Tests infrared rays against numbers computed by hand and against MuJoCo's own rays."""

import functools
import math
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from swarmjax import epuck
from swarmjax.evaluate import engine_c
from swarmjax.evaluate import rays as evaluate_rays
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.judge import Judge
from swarmjax.policy import Policy
from swarmjax.sim import infrared
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.infrared import Mount
from swarmjax.sim.sensors import Pose
from swarmjax.task import observation
from swarmjax.task.stage_config import StageConfig

RANGE = 0.04  # m
Poses = tuple[Pose, ...]
RADIUS = 0.037  # m
HALF_ROOT = math.sqrt(0.5)
# One text computes both. JAX compiles each shape anew, so only the comparisons below take it.
MODULES = pytest.mark.parametrize(
    "xp", [np, pytest.param(jnp, marks=pytest.mark.slow)], ids=["numpy", "jax"]
)
ROUNDING = 1e-6  # m; several roundings of float32 (6e-8) of lengths up to 1 m


def _f32(*values: Any) -> np.ndarray:
    return np.array(values, np.float32)


def _ray(xp: ModuleType, origin: tuple, direction: tuple) -> infrared.Ray:
    return infrared.Ray(*xp.array(_f32(*origin, *direction)))


@MODULES
@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((0.1, 0.0), (1.0, 0.0), 0.4),
        ((0.1, 0.0), (-1.0, 0.0), 0.6),
        ((0.1, -0.2), (0.0, -1.0), 0.3),
        ((0.4, 0.0), (HALF_ROOT, HALF_ROOT), 0.1 * math.sqrt(2.0)),  # meets the east wall first
        ((0.3, 0.4), (HALF_ROOT, HALF_ROOT), 0.1 * math.sqrt(2.0)),  # meets the north wall first
        ((0.0, 0.49), (1.0, 0.0), 0.5),  # along the north wall
        ((0.5, 0.1), (-1.0, 0.0), 0.0),  # on the wall
        ((0.51, 0.1), (-1.0, 0.0), 0.0),  # inside the wall, looking out
        ((0.1, -0.6), (0.0, -1.0), 0.0),
    ],
)
def test_ray_walls(xp: ModuleType, origin: tuple, direction: tuple, expected: float) -> None:
    found = infrared.ray_walls(_ray(xp, origin, direction), _f32(0.5)[0], xp)
    assert float(found) == pytest.approx(expected, abs=ROUNDING)


@MODULES
@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        ((0.0, 0.0), 0.75),
        ((0.0, 0.15), 0.8),  # half chord sqrt(0.25^2 - 0.15^2) = 0.2
        ((0.0, -0.15), 0.8),
        ((0.0, 0.25), 1.0),  # grazes; these numbers are exact in float32
        ((0.0, 0.2501), math.inf),
        ((2.0, 0.0), math.inf),  # behind
        ((1.1, 0.1), 0.0),  # inside
        ((1.25, 0.0), 0.0),  # on the far side, looking out
    ],
)
def test_ray_disc(xp: ModuleType, origin: tuple, expected: float) -> None:
    """Casts rays along +x at a disc of radius 0.25 centred at (1, 0)."""
    x, y = xp.array(_f32(1.0, 0.0))
    found = infrared.ray_disc(_ray(xp, origin, (1.0, 0.0)), x, y, 0.25, xp)
    assert float(found) == pytest.approx(expected, abs=ROUNDING)


@MODULES
@pytest.mark.parametrize(
    ("origin", "direction", "box", "expected"),
    [
        ((0.0, 0.0), (1.0, 0.0), (1.0, 0.0, 0.0, 0.25, 0.5), 0.75),
        ((0.0, 0.49), (1.0, 0.0), (1.0, 0.0, 0.0, 0.25, 0.5), 0.75),
        ((0.0, 0.51), (1.0, 0.0), (1.0, 0.0, 0.0, 0.25, 0.5), math.inf),  # parallel, beside it
        ((0.0, -0.51), (1.0, 0.0), (1.0, 0.0, 0.0, 0.25, 0.5), math.inf),
        ((2.0, 0.0), (1.0, 0.0), (1.0, 0.0, 0.0, 0.25, 0.5), math.inf),  # behind
        ((1.0, 0.3), (1.0, 0.0), (1.0, 0.0, 0.0, 0.25, 0.5), 0.0),  # inside
        ((1.2, 0.4), (0.0, -1.0), (1.0, 0.0, 0.0, 0.25, 0.5), 0.0),
        # The box is turned by a quarter turn, so its long side lies along x.
        ((0.0, 0.0), (1.0, 0.0), (1.0, 0.0, math.pi / 2, 0.25, 0.5), 0.5),
        ((0.0, 0.3), (1.0, 0.0), (1.0, 0.0, math.pi / 2, 0.25, 0.5), math.inf),
        # The box is turned by an eighth of a turn, so a corner lies half a diagonal,
        # 0.25 * sqrt(2), before the centre. A ray 0.1 beside the corner meets the box 0.1 later.
        ((0.0, 0.0), (1.0, 0.0), (1.0, 0.0, math.pi / 4, 0.25, 0.25), 1 - 0.25 * math.sqrt(2)),
        ((0.0, 0.1), (1.0, 0.0), (1.0, 0.0, math.pi / 4, 0.25, 0.25), 1.1 - 0.25 * math.sqrt(2)),
        ((0.0, 0.36), (1.0, 0.0), (1.0, 0.0, math.pi / 4, 0.25, 0.25), math.inf),
        ((0.0, -1.0), (HALF_ROOT, HALF_ROOT), (1.0, 0.0, math.pi / 4, 0.25, 0.5), 2**0.5 - 0.25),
    ],
)
def test_ray_box(
    xp: ModuleType, origin: tuple, direction: tuple, box: tuple, expected: float
) -> None:
    there = infrared.turned(xp.array(_f32(*box)), xp)
    found = infrared.ray_box(_ray(xp, origin, direction), there, xp)
    assert float(found) == pytest.approx(expected, abs=ROUNDING)


@MODULES
@pytest.mark.parametrize("quarter", range(4))
def test_the_eight_sensors_of_a_robot_that_faces_a_wall(xp: ModuleType, quarter: int) -> None:
    yaw = quarter * math.pi / 2
    # The robot's centre is 0.048 m from the wall, which leaves 11 mm between hull and wall.
    pose = _f32([0.452 * math.cos(yaw), 0.452 * math.sin(yaw), yaw])
    expected = np.full(8, RANGE)
    # Each row holds the number, x and yaw of a sensor that looks forward. The other four sensors
    # see nothing.
    for sensor, x, bearing in (
        (0, 0.030, -0.30081),
        (1, 0.022, -0.80081),
        (6, 0.022, 0.79920),
        (7, 0.030, 0.29920),
    ):
        expected[sensor] = (0.048 - x) / math.cos(bearing)
    assert expected[[0, 1, 6, 7]].max() < RANGE
    found = infrared.distances(xp.array(pose), _f32(1.0)[0], _no_box(xp), RADIUS, RANGE, xp)
    np.testing.assert_allclose(found, expected[None], atol=ROUNDING)


@MODULES
def test_a_sensor_behind_the_surface_of_a_wall_reads_zero(xp: ModuleType) -> None:
    # The hull is 9 mm inside the wall. Sensors 0 and 7, 0.030 m ahead of the centre, are 2 mm
    # inside the wall.
    pose = xp.array(_f32([0.472, 0.0, 0.0]))
    found = infrared.distances(pose, _f32(1.0)[0], _no_box(xp), RADIUS, RANGE, xp)[0]
    expected = [0.0, 0.006 / math.cos(0.80081), RANGE, RANGE]
    expected += [RANGE, RANGE, 0.006 / math.cos(0.79920), 0.0]
    np.testing.assert_allclose(found, expected, atol=ROUNDING)


@MODULES
def test_two_robots_side_by_side_see_each_other_and_not_themselves(xp: ModuleType) -> None:
    pose = xp.array(_f32([0.0, 0.0, 0.0], [0.0, 0.10, 0.0]))
    found = infrared.distances(pose, _f32(2.0)[0], _no_box(xp), RADIUS, RANGE, xp)
    expected = np.full((2, 8), RANGE)
    # The side sensors sit 0.031 m from the centre and look along the line between both centres.
    expected[0, 5] = expected[1, 2] = 0.10 - 0.031 - RADIUS
    np.testing.assert_allclose(found, expected, atol=ROUNDING)


@MODULES
def test_a_crooked_sensor_looks_where_it_is_turned(xp: ModuleType) -> None:
    """Checks the rays of two robots that face +y; the second robot's right sensor is crooked."""
    pose = xp.array(_f32([0.1, 0.2, math.pi / 2], [-0.3, 0.0, math.pi / 2]))
    yaw = np.zeros((2, 8), np.float32)
    yaw[1, 2] = math.pi / 6
    origin, direction = infrared.rays(pose, xp, Mount(turn=xp.array(yaw)))
    straight = infrared.rays(pose, xp)
    for found, nominal in zip((origin, direction), straight, strict=True):
        keep = np.ones((2, 8), bool)
        keep[1, 2] = False
        np.testing.assert_allclose(
            np.asarray(found)[keep], np.asarray(nominal)[keep], atol=ROUNDING
        )
    # Forward is +y and left is -x. In its robot's frame the sensor is at (0, -0.031).
    np.testing.assert_allclose(origin[1, 2], [-0.3 + 0.031, 0.0], atol=ROUNDING)
    # A straight sensor would look along +x, the robot's right. This sensor is turned by 30 degrees
    # to the left, towards +y.
    np.testing.assert_allclose(
        direction[1, 2], [math.cos(math.pi / 6), math.sin(math.pi / 6)], atol=ROUNDING
    )


@MODULES
def test_a_crooked_sensor_measures_along_its_own_ray(xp: ModuleType) -> None:
    pose = xp.array(_f32([0.45, 0.0, 0.0]))
    yaw = np.zeros((1, 8), np.float32)
    yaw[0, 7] = -0.29920  # straight ahead
    mount = Mount(turn=xp.array(yaw))
    found = infrared.distances(pose, _f32(1.0)[0], _no_box(xp), RADIUS, RANGE, xp, mount)[0]
    # The wall is 0.05 m ahead of the centre. The two front sensors sit 0.030 m ahead of the centre.
    np.testing.assert_allclose(
        found[np.array([0, 7])], [0.020 / math.cos(0.30081), 0.020], atol=ROUNDING
    )


SHADES = {"fixture": (0.9, 0.6, 0.7), "robot": (0.3, 0.4, 0.5)}


def _reflectance(xp: ModuleType, **shades: Any) -> infrared.Reflectance:
    return infrared.Reflectance(
        **{name: xp.array(_f32(shade)[0]) for name, shade in shades.items()}
    )


@MODULES
def test_sights_tell_how_bright_the_nearest_thing_is(xp: ModuleType) -> None:
    """Checks a robot with another robot on its left, a box on its right and the wall behind it.

    The second box and robot 2 are out of range.
    """
    pose = xp.array(_f32([-0.45, 0.0, 0.0], [-0.45, 0.09, 0.0], [0.2, 0.3, 0.0]))
    box = xp.array(_f32([-0.45, -0.06, 0.0, 0.01, 0.01], [0.2, 0.0, 0.0, 0.02, 0.02]))
    distance, bright = infrared.sights(
        pose, _f32(1.0)[0], box, RADIUS, RANGE, _reflectance(xp, **SHADES), Mount()
    )
    expected = np.ones((3, 8))  # 1 where a sensor sees nothing
    expected[0, 5] = 0.4
    expected[1, 2] = 0.3
    expected[0, 2] = 0.6
    expected[:2, [3, 4]] = 0.9  # the wall, 0.02 m behind the sensors
    np.testing.assert_allclose(bright, expected, atol=ROUNDING)
    np.testing.assert_array_equal(
        distance, infrared.distances(pose, _f32(1.0)[0], box, RADIUS, RANGE, xp)
    )
    # The sensors sit 0.031 m from the centre. The box's face is 0.05 m from the centre, and the
    # other robot's hull 0.09 - 0.037 m.
    np.testing.assert_allclose(distance[0, [2, 5]], [0.019, 0.022], atol=ROUNDING)


@MODULES
def test_what_has_no_reflectance_of_its_own_is_as_bright_as_can_be(xp: ModuleType) -> None:
    pose = xp.array(_f32([-0.45, 0.0, 0.0], [-0.45, 0.09, 0.0]))
    only_robots = _reflectance(xp, robot=(0.38, 0.38))
    _, bright = infrared.sights(
        pose, _f32(1.0)[0], _no_box(xp), RADIUS, RANGE, only_robots, Mount()
    )
    expected = np.ones((2, 8))
    expected[0, 5] = expected[1, 2] = 0.38
    np.testing.assert_allclose(bright, expected, atol=ROUNDING)


@MODULES
def test_of_several_things_that_hold_a_sensor_the_brightest_counts(xp: ModuleType) -> None:
    # In the first pose sensors 0 and 7 are inside both boxes. In the second pose both sensors are
    # inside the second box and 2 mm inside the wall.
    box = xp.array(_f32([0.47, 0.0, 0.0, 0.03, 0.03], [0.48, 0.0, 0.0, 0.03, 0.03]))
    for x, wall, brightest in ((0.45, 0.9, 0.7), (0.472, 0.9, 0.9), (0.472, 0.65, 0.7)):
        pose = xp.array(_f32([x, 0.0, 0.0], [5.0, 0.0, 0.0], [5.5, 0.0, 0.0]))
        shades = _reflectance(xp, fixture=(wall, 0.6, 0.7), robot=SHADES["robot"])
        distance, bright = infrared.sights(pose, _f32(1.0)[0], box, RADIUS, RANGE, shades, Mount())
        np.testing.assert_array_equal(np.asarray(distance)[0, [0, 7]], 0.0)
        np.testing.assert_allclose(np.asarray(bright)[0, [0, 7]], brightest, atol=ROUNDING)


def _no_box(xp: ModuleType) -> Any:
    return xp.zeros((0, 5), xp.float32)


def _judge(stage: StageConfig, poses: Poses = epuck.SENSOR_POSES) -> Judge:
    """Returns a judge whose policy is never run."""
    seen = observation.describe("metric", sensors=len(poses))
    layer = (np.zeros((1, len(seen["names"]), 2)), np.zeros((1, 2)))
    size = layer[0][..., 0]
    policy = Policy(
        layers=[layer],
        log_std=layer[1],
        mean=size,
        std=size + 1.0,
        is_shared=True,
        encoding="metric",
        max_speed=0.1256,
        max_turn_rate=3.14,
        meta={"observation": seen, "sensors": {"poses": poses}},
        digest="",
    )
    robot = RobotConfig(sensor_poses=tuple(poses))
    return engine_c.load(EvaluateConfig(policy="", stage=stage, robot=robot), policy)


ROBOTS, BOXES, ARENAS = 5, 2, 200
SIDE = 0.8
SUNK = 0.010  # m; robots sink in by at most 4 mm, and sensors sit 6 mm inside the hull


def _scenes() -> tuple[np.ndarray, np.ndarray]:
    """Draws poses [A, R, 3] and boxes [A, M, 5].

    Each hull is at most 0.03 m from a wall, a box or another hull, and overlaps nothing by more
    than `SUNK`.
    """
    draw = np.random.default_rng(0)
    poses, boxes = [], []
    while len(poses) < ARENAS:
        box = np.concatenate(
            [draw.uniform(-0.3, 0.3, (BOXES, 2)), draw.uniform(-4, 4, (BOXES, 1))], axis=-1
        )
        box = np.concatenate([box, np.full((BOXES, 2), 0.05)], axis=-1).astype(np.float32)
        pose: list[np.ndarray] = []
        while len(pose) < ROBOTS:
            each = draw.uniform([-0.38, -0.38, -9.0], [0.38, 0.38, 9.0]).astype(np.float32)
            others = [math.dist(each[:2], other[:2]) - 2 * RADIUS for other in pose]
            inside = [_box_gap(each[:2], one) - RADIUS for one in box]
            gap = min([*others, *inside, 0.5 * SIDE - max(abs(each[:2])) - RADIUS])
            if -SUNK < gap < 0.03:  # near enough to something to see it
                pose.append(each)
        poses.append(pose)
        boxes.append(box)
    return np.array(poses), np.array(boxes)


def _box_gap(point: np.ndarray, box: np.ndarray) -> float:
    """Signed distance from a point to a turned box, m."""
    turn = complex(math.cos(box[2]), -math.sin(box[2]))
    local = complex(*(point - box[:2])) * turn
    x, y = abs(local.real) - box[3], abs(local.imag) - box[4]
    return math.hypot(max(x, 0.0), max(y, 0.0)) + min(max(x, y), 0.0)


# Six sensors of a robot of one's own, 2 mm behind the hull's surface.
SIX = tuple(
    (0.035 * math.cos(a), 0.035 * math.sin(a), a + 0.2) for a in (0.0, 0.5, 1.2, 3.0, 4.5, 6.0)
)


@pytest.mark.parametrize("poses", [epuck.SENSOR_POSES, SIX], ids=["epuck", "six"])
@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_distances_are_those_of_mujoco_at_1000_random_poses(xp: ModuleType, poses: Poses) -> None:
    judge = _judge(StageConfig(name="test", robots=ROBOTS, side=SIDE, obstacles=BOXES), poses)
    pose, box = _scenes()
    data = np.empty(ARENAS, object)
    data[:] = [engine_c.place(judge, judge.model, *scene) for scene in zip(pose, box, strict=True)]
    seen_by_mujoco, _ = evaluate_rays.cast_rays(
        judge.scene, data, pose.astype(float), box.astype(float)
    )
    found = np.array(_distances(pose, box, xp, Mount(poses)))
    assert found.shape == (ARENAS, ROBOTS, len(poses))
    # Enough rays meet something, and enough rays start inside something.
    assert (seen_by_mujoco < RANGE).sum() > 1000
    assert (seen_by_mujoco == 0.0).sum() > 90
    # Float32 rounds positions of up to 0.4 m to 3e-8 m, in JAX and in the walls' quaternions that
    # MuJoCo gets. A slanted face multiplies this error several times. The two distances of a ray
    # that grazes an edge could differ by its whole length, but none of these 8,000 rays is so close
    # to an edge.
    np.testing.assert_allclose(found, seen_by_mujoco, rtol=0, atol=5e-7)


def test_mujoco_sees_the_nearest_of_many_robots() -> None:
    """The judge lists robots near a ray by cells; the other side compares all pairs."""
    judge = _judge(
        StageConfig(name="test", level="plots", robots=121, side=3.0), epuck.SENSOR_POSES
    )
    draw = np.random.default_rng(1)
    # Robots lie 85 mm apart, give or take 10 mm: gaps of up to 21 mm.
    middle = (np.stack(np.divmod(np.arange(121), 11), axis=-1) - 5.0) * 0.085
    place = middle + draw.uniform(-0.005, 0.005, (121, 2))
    pose = np.concatenate([place, draw.uniform(-3, 3, (121, 1))], axis=-1).astype(np.float32)[None]
    box = np.zeros((1, 0, 5), np.float32)
    data = np.empty(1, object)
    data[0] = engine_c.place(judge, judge.model, pose[0], box[0])
    seen, _ = evaluate_rays.cast_rays(judge.scene, data, pose.astype(float), box.astype(float))
    found = infrared.distances(pose, np.array([3.0]), box, RADIUS, RANGE, np)
    assert (seen < RANGE).sum() > 400
    np.testing.assert_allclose(found, seen, rtol=0, atol=5e-7)


def _distances(pose: np.ndarray, box: np.ndarray, xp: ModuleType, mount: Mount) -> Any:
    """Returns the analytic distances of many arenas, by JAX in float32 or by NumPy in float64."""
    if xp is jnp:
        one = functools.partial(
            infrared.distances,
            side=_f32(SIDE)[0],
            hull_radius=RADIUS,
            limit=RANGE,
            xp=jnp,
            mount=mount,
        )
        return jax.vmap(lambda p, b: one(pose=p, obstacle=b))(pose, box)
    return [
        infrared.distances(p, _f32(SIDE)[0], b, RADIUS, RANGE, np, mount)
        for p, b in zip(pose.astype(float), box.astype(float), strict=True)
    ]


ARENA = 0.5  # m
MANY = 2000  # arenas of `ROBOTS` robots each, which makes 10,000 poses and 80,000 rays
HALVES = ((13 / 256, 5 / 256), (1 / 32, 5 / 64))  # m; exact in float32


class _World:
    """A square arena in MuJoCo, with cylinders and boxes that `put` moves."""

    def __init__(self, cylinders: list[float], boxes: tuple[tuple[float, float], ...]) -> None:
        spec = mujoco.MjSpec()
        for radius in cylinders:
            self._add(spec, mujoco.mjtGeom.mjGEOM_CYLINDER, [radius, 0.05, 0.0])
        for half in boxes:
            self._add(spec, mujoco.mjtGeom.mjGEOM_BOX, [*half, 0.05])
        for _ in range(4):
            self._add(spec, mujoco.mjtGeom.mjGEOM_BOX, [0.5, 2.0, 0.05])
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    @staticmethod
    def _add(spec: mujoco.MjSpec, kind: Any, size: list[float]) -> None:
        spec.worldbody.add_body(mocap=True).add_geom(type=kind, size=size)

    def put(self, pose: np.ndarray, side: float) -> None:
        """Moves the cylinders and boxes to poses [N, 3], and the walls to the sides of an arena."""
        quarter = np.arange(4) * math.pi / 2
        away = 0.5 * side + 0.5
        walls = np.stack([away * np.cos(quarter), away * np.sin(quarter), quarter], axis=-1)
        pose = np.concatenate([pose, walls])
        self.data.mocap_pos[:, :2] = pose[:, :2]
        self.data.mocap_quat[:, 0] = np.cos(0.5 * pose[:, 2])
        self.data.mocap_quat[:, 3] = np.sin(0.5 * pose[:, 2])
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def cast(
        self, origin: np.ndarray, direction: np.ndarray, me: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Casts rays [N, 2] that ignore geom `me` [N]; returns distances and geoms (-1: none).

        The distance is 0 if the ray starts inside a geom, which is checked in the geom's own frame.
        """
        flat = np.zeros((len(origin), 1))
        origin = np.concatenate([origin, flat], axis=-1)
        direction = np.concatenate([direction, flat], axis=-1)
        reach, geom = np.zeros(len(origin)), np.full(len(origin), -1, np.int32)
        normal = np.zeros(3)
        for i in range(len(origin)):
            mujoco.mj_multiRay(
                self.model, self.data, origin[i], direction[i], None, True, int(me[i]) + 1,
                geom[i : i + 1], reach[i : i + 1], normal, 1, mujoco.mjMAXVAL,
            )  # fmt: skip
        reach = np.where((reach < 0.0) | (reach > RANGE), RANGE, reach)
        inside = self._inside(origin) & (np.arange(self.model.ngeom) != me[:, None])
        return np.where(inside.any(axis=-1), 0.0, reach), geom

    def _inside(self, point: np.ndarray) -> np.ndarray:
        """Returns whether each point [N, 3] is inside each geom, [N, G]."""
        offset = point[:, None] - self.data.geom_xpos
        local = np.einsum("gij,ngi->ngj", self.data.geom_xmat.reshape(-1, 3, 3), offset)
        size = self.model.geom_size
        disc = np.hypot(local[..., 0], local[..., 1]) < size[:, 0]
        box = (np.abs(local[..., :2]) < size[:, :2]).all(axis=-1)
        return np.where(self.model.geom_type == mujoco.mjtGeom.mjGEOM_CYLINDER, disc, box)


@functools.cache
def _many_scenes() -> tuple[np.ndarray, ...]:
    """Draws poses and boxes; returns them with MuJoCo's distances and the geoms hit, [A, R, K].

    Robots and boxes lie anywhere in the arena, so that they overlap and many sensors are inside a
    geom.
    """
    draw = np.random.default_rng(1)
    pose = draw.uniform([-0.27, -0.27, -9.0], [0.27, 0.27, 9.0], (MANY, ROBOTS, 3))
    box = draw.uniform([-0.25, -0.25, -4.0], [0.25, 0.25, 4.0], (MANY, len(HALVES), 3))
    pose, box = pose.astype(np.float32), box.astype(np.float32)
    world = _World([RADIUS] * ROBOTS, HALVES)
    me = np.repeat(np.arange(ROBOTS), 8)
    reach, geom = np.empty((MANY, ROBOTS * 8)), np.empty((MANY, ROBOTS * 8), int)
    for i, robots in enumerate(pose.astype(float)):
        world.put(np.concatenate([robots, box[i].astype(float)]), ARENA)
        origin, direction = infrared.rays(robots, np)
        reach[i], geom[i] = world.cast(origin.reshape(-1, 2), direction.reshape(-1, 2), me)
    half = np.broadcast_to(_f32(HALVES)[0], (MANY, len(HALVES), 2))
    shape = (MANY, ROBOTS, 8)
    return pose, np.concatenate([box, half], axis=-1), reach.reshape(shape), geom.reshape(shape)


@MODULES
@pytest.mark.slow
def test_sights_are_those_of_mujoco_at_10000_random_poses(xp: ModuleType) -> None:
    pose, box, truth, geom = _many_scenes()
    hits = (truth > 0.0) & (truth < RANGE)
    assert (truth == 0.0).sum() > 10_000  # these rays start inside a geom
    assert hits.sum() > 10_000
    kind = xp.float32 if xp is jnp else float
    # One reflectance for each geom, in MuJoCo's order: the robots, the boxes and the four walls.
    shade = np.array([0.30, 0.31, 0.32, 0.33, 0.34, 0.60, 0.61, *[0.9] * 4])
    reflectance = infrared.Reflectance(
        fixture=xp.array(np.tile([0.9, *shade[ROBOTS:-4]], (MANY, 1)), kind),
        robot=xp.array(np.tile(shade[:ROBOTS], (MANY, 1)), kind),
    )
    side = xp.full(MANY, ARENA, kind)
    pose, box = xp.array(pose, kind), xp.array(box, kind)
    distance, bright = infrared.sights(pose, side, box, RADIUS, RANGE, reflectance, Mount())
    # Float32 rounds positions of up to 0.5 m to 3e-8 m. A slanted face or a chord of a hull
    # multiplies this error several times, here to 3.0e-7 m at most. In float64 an error of 1.3e-8 m
    # remains: the sensors' poses are float32 constants, so directions are longer or shorter than 1
    # by 6e-8. MuJoCo corrects for the length of a direction, and a chord multiplies the error.
    tolerance = 5e-7 if xp is jnp else 3e-8
    np.testing.assert_allclose(distance, truth, rtol=0, atol=tolerance)
    np.testing.assert_allclose(np.asarray(bright)[hits], shade[geom[hits]], atol=ROUNDING)


GRAZES = 5000  # Rays of each of the two kinds in `_edge_rays`.
# Ten times the rounding of float32, in m, for positions of up to 0.5 m. A distance counts as right
# if it lies between the distances of sensors moved by this much. Rounding of the last bit decides
# whether a grazing ray meets an edge, and whether a sensor on a surface is inside.
NUDGE = 3e-7
NUDGES = ((0, 0), (0, 1), (0, -1), (1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1))
DISC, BOX = (0.05, -0.03, 0.06), (0.05, -0.03, 0.4, *HALVES[0])


def _edge_rays(shape: str) -> tuple[np.ndarray, np.ndarray]:
    """Draws origins and directions [N, 2] in float64 of rays at the edge of a shape.

    Each ray has a point on the shape: a tangent point of a disc, a corner of a box or a point of a
    wall. The first half of the rays pass this point at a distance of 1e-9 to 1e-2 m, and start
    before or behind it. The other rays start at a distance of 1e-9 to 1e-2 m from the point, inside
    or outside the shape, and look in any direction.
    """
    draw = np.random.default_rng(2)
    count = 2 * GRAZES
    if shape == "wall":
        tilt = draw.choice([-1.0, 1.0], count) * 10.0 ** draw.uniform(-6, -2, count)
        outward = tilt - 0.5 * math.pi
        x = draw.uniform(-0.2, 0.2, count)
        point = np.stack([x, np.full(count, 0.5 * ARENA)], axis=-1)
    elif shape == "disc":
        outward = draw.uniform(-math.pi, math.pi, count)
        point = np.array(DISC[:2]) + DISC[2] * _toward(outward)
    else:
        # A ray perpendicular to one of these directions passes the corner at an angle of 0.3 rad or
        # more to either face.
        outward = BOX[2] + draw.uniform(0.3, 0.5 * math.pi - 0.3, count)
        point = (
            np.array(BOX[:2]) + _toward(BOX[2]) * BOX[3] + _toward(BOX[2] + math.pi / 2) * BOX[4]
        )
    by = draw.choice([-1.0, 1.0], count) * 10.0 ** draw.uniform(-9, -2, count)
    yaw = outward + draw.choice([-0.5, 0.5], count) * math.pi
    yaw[GRAZES:] = draw.uniform(-math.pi, math.pi, GRAZES)
    back = draw.uniform(-0.01, 0.035, count)
    back[GRAZES:] = 0.0
    return point + by[:, None] * _toward(outward) - back[:, None] * _toward(yaw), _toward(yaw)


def _toward(yaw: Any) -> np.ndarray:
    return np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)


@functools.cache
def _seen_of_edges(shape: str) -> np.ndarray:
    """Returns MuJoCo's distances [9, N] along the rays of `_edge_rays` and their nudged copies."""
    world = _World([DISC[2]] if shape == "disc" else [], HALVES[:1] if shape == "box" else ())
    thing = {"wall": np.zeros((0, 3)), "disc": [(*DISC[:2], 0.0)], "box": [BOX[:3]]}[shape]
    world.put(np.array(thing), ARENA)
    origin, direction = _edge_rays(shape)
    across = np.stack([-direction[:, 1], direction[:, 0]], axis=-1)
    starts = [origin + NUDGE * (ahead * direction + aside * across) for ahead, aside in NUDGES]
    nobody = np.full(len(origin), -1)
    return np.array([world.cast(start, direction, nobody)[0] for start in starts])


@MODULES
@pytest.mark.parametrize("shape", ["wall", "disc", "box"])
def test_rays_that_graze_and_rays_that_start_at_a_surface(xp: ModuleType, shape: str) -> None:
    truth = _seen_of_edges(shape)
    grazing = truth[:, :GRAZES]
    kind = xp.float32 if xp is jnp else float
    ray = infrared.Ray(*(xp.array(part, kind) for each in _edge_rays(shape) for part in each.T))
    if shape == "wall":
        half = xp.full(2 * GRAZES, 0.5 * ARENA, kind)
        found = infrared.ray_walls(ray, half, xp)
    elif shape == "disc":
        x, y = xp.array(DISC[:2], kind)
        found = infrared.ray_disc(ray, x, y, DISC[2], xp)
    else:
        found = infrared.ray_box(ray, infrared.turned(xp.array(BOX, kind), xp), xp)
    assert (truth[0, GRAZES:] == 0.0).sum() > 1000
    if shape != "wall":  # a wall has no end that a ray could pass
        assert (grazing[0] == RANGE).sum() > 1000
        assert ((grazing[0] > 0.0) & (grazing[0] < RANGE)).sum() > 1000
    found = np.clip(np.asarray(found), 0.0, RANGE)
    if xp is np:
        # A tilt of 1e-6 rad against the wall multiplies the rounding of 0.25 m, 3e-17 m, to
        # 5.1e-11 m at most.
        np.testing.assert_allclose(found, truth[0], rtol=0, atol=1e-10)
    # The distance of a ray between two nudged rays lies between the distances of these two. 1e-7 m
    # is the rounding of the distance itself.
    assert (found >= truth.min(axis=0) - 1e-7).all()
    assert (found <= truth.max(axis=0) + 1e-7).all()
