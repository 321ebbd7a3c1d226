"""Infrared rays against hand-worked numbers, and against MuJoCo's own rays."""

import functools
import math
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax import evaluate
from swarmjax.config import EvaluateConfig, StageConfig
from swarmjax.evaluate import Judge
from swarmjax.policy import Layer, Policy
from swarmjax.sim import infrared
from swarmjax.task import observation

RANGE = 0.04  # m
RADIUS = 0.037  # m
HALF_ROOT = math.sqrt(0.5)
MODULES = pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
ROUNDING = 1e-6  # some roundings of float32 (6e-8) of lengths up to 1 m


def _f32(*values: Any) -> np.ndarray:
    return np.array(values, np.float32)


@MODULES
@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((0.1, 0.0), (1.0, 0.0), 0.4),
        ((0.1, 0.0), (-1.0, 0.0), 0.6),
        ((0.1, -0.2), (0.0, -1.0), 0.3),
        ((0.4, 0.0), (HALF_ROOT, HALF_ROOT), 0.1 * math.sqrt(2.0)),  # meets the east wall first
        ((0.3, 0.4), (HALF_ROOT, HALF_ROOT), 0.1 * math.sqrt(2.0)),  # the north wall first
        ((0.0, 0.49), (1.0, 0.0), 0.5),  # along the north wall
        ((0.5, 0.1), (-1.0, 0.0), 0.0),  # on the wall
        ((0.51, 0.1), (-1.0, 0.0), 0.0),  # inside the wall, looking out
        ((0.1, -0.6), (0.0, -1.0), 0.0),
    ],
)
def test_ray_walls(xp: ModuleType, origin: tuple, direction: tuple, expected: float) -> None:
    found = infrared.ray_walls(
        xp.array(_f32(*origin)), xp.array(_f32(*direction)), _f32(0.5)[0], xp
    )
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
    """A disc of radius 0.25 at (1, 0), from the left along +x."""
    start, toward = xp.array(_f32(*origin)), xp.array(_f32(1.0, 0.0))
    found = infrared.ray_disc(start, toward, xp.array(_f32(1.0, 0.0)), 0.25, xp)
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
        # Turned by a quarter, the long side lies along x.
        ((0.0, 0.0), (1.0, 0.0), (1.0, 0.0, math.pi / 2, 0.25, 0.5), 0.5),
        ((0.0, 0.3), (1.0, 0.0), (1.0, 0.0, math.pi / 2, 0.25, 0.5), math.inf),
        # On its corner: half a diagonal of 0.25 * sqrt(2) before the centre; 0.1 off, 0.1 later.
        ((0.0, 0.0), (1.0, 0.0), (1.0, 0.0, math.pi / 4, 0.25, 0.25), 1 - 0.25 * math.sqrt(2)),
        ((0.0, 0.1), (1.0, 0.0), (1.0, 0.0, math.pi / 4, 0.25, 0.25), 1.1 - 0.25 * math.sqrt(2)),
        ((0.0, 0.36), (1.0, 0.0), (1.0, 0.0, math.pi / 4, 0.25, 0.25), math.inf),
        ((0.0, -1.0), (HALF_ROOT, HALF_ROOT), (1.0, 0.0, math.pi / 4, 0.25, 0.5), 2**0.5 - 0.25),
    ],
)
def test_ray_box(
    xp: ModuleType, origin: tuple, direction: tuple, box: tuple, expected: float
) -> None:
    start, toward = xp.array(_f32(*origin)), xp.array(_f32(*direction))
    found = infrared.ray_box(start, toward, xp.array(_f32(*box)), xp)
    assert float(found) == pytest.approx(expected, abs=ROUNDING)


@MODULES
@pytest.mark.parametrize("quarter", range(4))
def test_the_eight_sensors_of_a_robot_that_faces_a_wall(xp: ModuleType, quarter: int) -> None:
    yaw = quarter * math.pi / 2
    # Its centre 0.048 m before the wall: 11 mm between hull and wall.
    pose = _f32([0.452 * math.cos(yaw), 0.452 * math.sin(yaw), yaw])
    expected = np.full(8, RANGE)
    # x forward of the centre and yaw of the sensors that look forward; the other four see nothing.
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
    # 9 mm of the hull are inside the wall: sensors 0 and 7, 0.030 m forward, by 2 mm.
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
    # The side sensors sit 0.031 m off the centre and look along the line of the centres.
    expected[0, 5] = expected[1, 2] = 0.10 - 0.031 - RADIUS
    np.testing.assert_allclose(found, expected, atol=ROUNDING)


def _no_box(xp: ModuleType) -> Any:
    return xp.zeros((0, 5), xp.float32)


def _judge(stage: StageConfig) -> Judge:
    """Returns a judge whose policy is never asked."""
    layer = Layer(np.zeros((1, observation.SIZE, 2)), np.zeros((1, 2)))
    size = np.zeros((1, observation.SIZE))
    meta = {
        "policy": "shared",
        "observation": {"names": observation.NAMES},
        "action": {"high": [0.1256, 3.14]},
    }
    policy = Policy(
        hidden=(),
        mean=layer,
        log_std=layer.bias,
        observation_mean=size,
        observation_std=size + 1.0,
        meta=meta,
    )
    return evaluate.load(EvaluateConfig(policy="", stage=stage), policy)


ROBOTS, BOXES, ARENAS = 5, 2, 200
SIDE = 0.8
SUNK = 0.010  # m; deeper than robots sink into anything, 4 mm, and than the sensors sit, 6 mm


def _scenes() -> tuple[np.ndarray, np.ndarray]:
    """Draws poses [A, R, 3] near things and boxes [A, M, 5]; hulls overlap by `SUNK` at most."""
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


@MODULES
def test_distances_are_those_of_mujoco_at_1000_random_poses(xp: ModuleType) -> None:
    judge = _judge(StageConfig(name="test", robots=ROBOTS, side=SIDE, obstacles=BOXES))
    pose, box = _scenes()
    data = np.empty(ARENAS, object)
    data[:] = [evaluate.place(judge, *scene) for scene in zip(pose, box, strict=True)]
    seen_by_mujoco = evaluate.read_infrared(judge, data, pose.astype(float), box.astype(float))
    found = np.array(_distances(pose, box, xp))
    # Rays that meet something, and rays that start inside something.
    assert (seen_by_mujoco < RANGE).sum() > 1000
    assert (seen_by_mujoco == 0.0).sum() > 100
    # Float32 rounds positions of up to 0.4 m to 3e-8 m, in JAX and in the walls' quaternions that
    # MuJoCo gets; a slanted face stretches that some times. A ray that grazes an edge would tell
    # the two apart by more, up to its whole length: none of these 8,000 comes so close to one.
    np.testing.assert_allclose(found, seen_by_mujoco, rtol=0, atol=5e-7)


def _distances(pose: np.ndarray, box: np.ndarray, xp: ModuleType) -> Any:
    """Reads the analytic sensors of many arenas: JAX in float32, NumPy in double."""
    if xp is jnp:
        one = functools.partial(
            infrared.distances, side=_f32(SIDE)[0], hull_radius=RADIUS, limit=RANGE, xp=jnp
        )
        return jax.vmap(lambda p, b: one(pose=p, obstacle=b))(pose, box)
    return [
        infrared.distances(p, _f32(SIDE)[0], b, RADIUS, RANGE, np)
        for p, b in zip(pose.astype(float), box.astype(float), strict=True)
    ]
