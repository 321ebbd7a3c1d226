"""Tests the paper's fixed level by hand, in the example's arena and in an arena of 1.2 m."""

import contextlib
import itertools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.config import ConfigError
from swarmjax.sim import gaps
from swarmjax.task import fixed_level, level
from swarmjax.task import stage as task_stage
from swarmjax.task.level import Level, Spacing
from swarmjax.task.stage_config import StageConfig

HULL = 0.037  # m
SPACING = Spacing(robots=5, obstacles=4, hull_radius=HULL, target_radius=0.05)
TOLERANCE = 1e-6  # m; float32 at the size of an arena
SIDES = (0.5, 0.7, 1.0, 1.2, 1.5)


Layout = Literal["boxes", "fence"]
LAYOUTS: tuple[Layout, ...] = ("boxes", "fence")


def _stage(side: float, robots: int, obstacles: int, layout: Layout) -> StageConfig:
    return StageConfig(
        name="fixed", robots=robots, side=side, obstacles=obstacles, level="fixed", layout=layout
    )


def _level(stage: StageConfig, uniform: float = 0.5) -> Level:
    single = task_stage.select(task_stage.stack([stage]), 0)
    uniforms = np.full(level.uniform_count(SPACING), uniform, np.float32)
    return level.sample(uniforms, single, SPACING, np)


def test_starts_and_targets_in_the_arena_of_the_example() -> None:
    found = _level(_stage(0.7, 5, 1, "boxes"))
    x = [-0.26, -0.16, -0.06, 0.04, 0.14]
    np.testing.assert_allclose(found.start[:, 0], x, atol=TOLERANCE)
    np.testing.assert_allclose(found.start[:, 1:], [[0.27, 0.0]] * 5, atol=TOLERANCE)
    targets = [(0.26, -0.23), (0.26, -0.13), (0.16, -0.23), (0.16, -0.13), (0.06, -0.23)]
    np.testing.assert_allclose(found.target, targets, atol=TOLERANCE)
    np.testing.assert_allclose(found.obstacle[0], [0.0, 0.02, 0.0, 0.05, 0.05], atol=TOLERANCE)


def test_starts_targets_and_boxes_in_an_arena_of_1200_mm() -> None:
    # Places are scaled by 12/7; distances between robots and sizes of boxes are not.
    found = _level(_stage(1.2, 5, 4, "boxes"))
    x = -0.26 * 12 / 7 + np.array([0.0, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(found.start[:, 0], x, atol=TOLERANCE)
    np.testing.assert_allclose(found.start[:, 1], 0.27 * 12 / 7, atol=TOLERANCE)
    corner = np.array([0.26, -0.23]) * 12 / 7
    steps = np.array([(0.0, 0.0), (0.0, 0.1), (-0.1, 0.0), (-0.1, 0.1), (-0.2, 0.0)])
    np.testing.assert_allclose(found.target, corner + steps, atol=TOLERANCE)
    centres = np.array([(0.0, 0.02), (-0.17, -0.12), (0.17, 0.1), (0.02, -0.2)]) * 12 / 7
    np.testing.assert_allclose(found.obstacle[:, :2], centres, atol=TOLERANCE)
    np.testing.assert_allclose(found.obstacle[:, 2:], [[0.0, 0.05, 0.05]] * 4, atol=TOLERANCE)


@pytest.mark.parametrize(
    ("side", "expected"),
    [
        (0.7, (-0.10, 0.16, 0.0, 0.25, 0.03)),
        (1.2, (-0.10 * 12 / 7, 0.16 * 12 / 7, 0.0, 0.25 * 12 / 7, 0.03)),
    ],
)
@pytest.mark.parametrize("obstacles", [1, 2])
def test_fence_is_one_obstacle(side: float, expected: tuple[float, ...], obstacles: int) -> None:
    found = _level(_stage(side, 2, obstacles, "fence"))
    assert found.obstacle_present.tolist() == [True, False, False, False]
    np.testing.assert_allclose(found.obstacle[0], expected, atol=TOLERANCE)
    # The fence begins at the west wall, as in the example.
    assert found.obstacle[0, 0] - found.obstacle[0, 3] == pytest.approx(-side / 2, abs=TOLERANCE)


def _accepted() -> list[StageConfig]:
    """Returns stages of the shipped sizes, in either layout, that fit their arena."""
    stages = []
    for side, robots, layout in itertools.product(SIDES, (2, 3, 5), LAYOUTS):
        for obstacles in range(5) if layout == "boxes" else (1,):
            with contextlib.suppress(ConfigError):
                stages.append(_stage(side, robots, obstacles, layout))
    return stages


@pytest.mark.parametrize(
    "stage", _accepted(), ids=lambda s: f"{s.side}-{s.robots}-{s.layout}{s.obstacles}"
)
def test_nothing_overlaps(stage: StageConfig) -> None:
    found = _level(stage)
    assert found.present.sum() == stage.robots
    assert found.obstacle_present.sum() == stage.obstacles
    for place in (found.start, np.column_stack([found.target, found.start[:, 2]])):
        gap = gaps.gaps(place, found.side, found.obstacle, HULL, np)
        assert (gap[: stage.robots] > 0.0).all()
    for start in found.start[: stage.robots, :2]:
        apart = np.linalg.norm(found.target[: stage.robots] - start, axis=-1)
        assert (apart > SPACING.target_radius).all()


@pytest.mark.parametrize("side", [1.0, 1.2, 1.5])
def test_a_robot_passes_between_the_boxes_of_larger_arenas(side: float) -> None:
    found = _level(_stage(side, 2, 4, "boxes"))
    centre = found.obstacle[:, :2]
    # The boxes are 0.1 m wide and not turned. The gap between two boxes is therefore at least the
    # larger of their gaps along x and along y.
    apart = np.abs(centre[:, None] - centre[None]).max(axis=-1) - 0.1
    assert (apart[~np.eye(4, dtype=bool)] >= 0.1).all()
    assert (0.5 * side - np.abs(centre) - 0.05 >= 0.1).all()


@pytest.mark.parametrize("side", SIDES)
def test_row_of_starts_holds_most_robots(side: float) -> None:
    most = fixed_level.most_robots(side)
    x = fixed_level.starts(most + 1, np.float32(side), np)[:, 0]
    # The last robot keeps a hull and 23 mm from the right wall; one more robot would keep less.
    assert x[most - 1] <= 0.5 * side - 0.06 + TOLERANCE
    assert x[most] > 0.5 * side - 0.06 - TOLERANCE


@pytest.mark.parametrize("layout", LAYOUTS)
def test_nothing_is_drawn_and_numpy_and_jax_agree(layout: Layout) -> None:
    stage = _stage(1.2, 3, 2, layout)
    expected = _level(stage, 0.1)
    # The last field, the seed, is left out, since it is drawn even in a fixed level.
    for mine, theirs in zip(_level(stage, 0.9)[:-1], expected[:-1], strict=True):
        np.testing.assert_array_equal(mine, theirs)
    single = jax.tree.map(jnp.asarray, task_stage.select(task_stage.stack([stage]), 0))
    uniforms = jnp.full(level.uniform_count(SPACING), 0.3)
    found = jax.jit(level.sample, static_argnums=(2, 3))(uniforms, single, SPACING, jnp)
    for mine, theirs in zip(found[:-1], expected[:-1], strict=True):
        # XLA may round float32 products differently: one ulp at 5 m, where robots are parked.
        np.testing.assert_allclose(mine, theirs, atol=5e-7)


def test_no_obstacles_compiled_in() -> None:
    stage = task_stage.select(task_stage.stack([_stage(0.7, 2, 0, "boxes")]), 0)
    assert fixed_level.obstacles(0, stage.side, stage.fence, np).shape == (0, 5)
