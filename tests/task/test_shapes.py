"""Tests the shapes of obstacles with geometry of the tests' own."""

import math

import numpy as np
import pytest

from swarmjax.evaluate.judge import draw_level
from swarmjax.task import shapes
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level, Spacing
from swarmjax.task.shapes import Shape
from swarmjax.task.stage_config import StageConfig

HALF = 0.05  # m, half the edge of the boxes in training
OUTER = HALF * math.sqrt(2)
THIN = 0.005  # m, half the thickness of a plate
KINDS: tuple[Shape, ...] = ("bar", "cross", "ell", "pillar")


def _drawn() -> Level:
    stage = task_stage.stack([StageConfig(name="s6", robots=5, side=1.2, obstacles=3)])
    return draw_level(task_stage.select(stage, np.intp(0)), Spacing(5, 3, 0.037, 0.05), 1, 0)


def _covers(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns whether any of the boxes [P, 5] covers each of the points [N, 2]."""
    offset = points[:, None] - boxes[:, :2]
    cos, sin = np.cos(boxes[:, 2]), np.sin(boxes[:, 2])
    along = np.abs(cos * offset[..., 0] + sin * offset[..., 1])
    across = np.abs(cos * offset[..., 1] - sin * offset[..., 0])
    return ((along <= boxes[:, 3]) & (across <= boxes[:, 4])).any(axis=1)


def _inside(shape: Shape, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns whether points in the obstacle's own frame lie in the shape."""
    length = math.sqrt(OUTER**2 - THIN**2)
    if shape == "bar":
        return (np.abs(x) <= length) & (np.abs(y) <= THIN)
    if shape == "cross":
        return _inside("bar", x, y) | _inside("bar", y, x)
    if shape == "ell":  # the lower and the left edge of the box
        box = (np.abs(x) <= HALF) & (np.abs(y) <= HALF)
        return box & ((y <= -HALF + 2 * THIN) | (x <= -HALF + 2 * THIN))
    # A pillar is a regular octagon with corners 22.5 degrees off the axes. A point inside lies in
    # all of eight half planes.
    angle = np.arange(8) * math.pi / 4
    reach = x[..., None] * np.cos(angle) + y[..., None] * np.sin(angle)
    return (reach <= OUTER * math.cos(math.pi / 8)).all(axis=-1)


@pytest.mark.parametrize("shape", KINDS)
def test_boxes_make_the_shape(shape: Shape) -> None:
    drawn = _drawn()
    level = shapes.expand(drawn, shape)
    parts = shapes.boxes_of(shape)
    assert level.obstacle.shape == (3 * parts, 5)
    assert level.obstacle.dtype == np.float32
    assert level.obstacle_present.shape == (3 * parts,)
    local = np.random.default_rng(0).uniform(-0.08, 0.08, (20_000, 2))
    for i, (x, y, yaw, *_) in enumerate(drawn.obstacle.astype(float)):
        cos, sin = math.cos(yaw), math.sin(yaw)
        points = np.stack([x + cos * local[:, 0] - sin * local[:, 1],
                           y + sin * local[:, 0] + cos * local[:, 1]], axis=-1)  # fmt: skip
        mine = level.obstacle[i * parts : (i + 1) * parts].astype(float)
        found, expected = _covers(mine, points), _inside(shape, local[:, 0], local[:, 1])
        # Boxes are rounded to 1e-6 m. Of 20,000 points in 0.0256 m2, about one lies that near to
        # 1 m of outline.
        assert (found != expected).sum() <= 3
        assert 0.02 < found.mean() < 0.8


@pytest.mark.parametrize("shape", KINDS)
def test_all_of_it_lies_within_the_circle_about_the_box(shape: Shape) -> None:
    level, drawn = shapes.expand(_drawn(), shape), _drawn()
    signs = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)])
    for i, box in enumerate(level.obstacle.astype(float)):
        corner = signs * box[3:]
        cos, sin = math.cos(box[2]), math.sin(box[2])
        place = box[:2] + corner @ np.array([[cos, sin], [-sin, cos]])
        centre = drawn.obstacle[i // shapes.boxes_of(shape), :2]
        assert np.linalg.norm(place - centre, axis=-1).max() <= OUTER + 3e-6  # rounding


def test_a_box_stays_and_so_does_all_else() -> None:
    drawn = _drawn()
    assert shapes.expand(drawn, "box") is drawn
    for name, field in shapes.expand(drawn, "ell")._asdict().items():
        if not name.startswith("obstacle"):
            np.testing.assert_array_equal(field, getattr(drawn, name))


def test_absent_obstacles_stay_absent() -> None:
    drawn = _drawn()._replace(obstacle_present=np.array([True, False, True]))
    assert shapes.expand(drawn, "cross").obstacle_present.tolist() == [1, 1, 0, 0, 1, 1]
