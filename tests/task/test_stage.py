"""Tests stages as arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.config import ConfigError
from swarmjax.task import stage
from swarmjax.task.stage_config import StageConfig

PLAIN = StageConfig(name="a", robots=2, side=0.5)
BOXES = StageConfig(name="b", robots=5, side=1.2, obstacles=3, obstacle_size=0.2)
OPEN = StageConfig(name="e", robots=2, side=(0.8, 1.6))
FENCE = StageConfig(name="c", robots=3, side=1.4, obstacles=1, level="fixed", layout="fence")
SMALL = StageConfig(name="d", robots=1, side=1.0, obstacles=1, obstacle_size=0.02, level="fixed")


def test_stack() -> None:
    found = stage.stack([PLAIN, BOXES, FENCE, OPEN])
    expected = stage.Stage(
        robots=np.array([2, 5, 3, 2], np.int32),
        obstacles=np.array([0, 3, 1, 0], np.int32),
        side=np.array([0.5, 1.2, 1.4, 0.8], np.float32),
        largest_side=np.array([0.5, 1.2, 1.4, 1.6], np.float32),
        obstacle_size=np.array([0.1, 0.2, 0.1, 0.1], np.float32),
        fixed=np.array([False, False, True, False]),
        fence=np.array([False, False, True, False]),
        drawing=np.zeros(4, np.int32),
    )
    assert found.map is found.layouts is found.distance is found.laid_out is None
    for mine, theirs in zip(found[:-4], expected[:-4], strict=True):
        assert mine.dtype == theirs.dtype
        np.testing.assert_array_equal(mine, theirs)


def test_select_one_or_many() -> None:
    stages = stage.stack([PLAIN, BOXES, FENCE])
    assert stage.select(stages, 1).robots == 5
    many = stage.select(jax.tree.map(jnp.asarray, stages), jnp.array([2, 0, 2]))
    assert many.robots.tolist() == [3, 2, 3]
    assert many.fence.tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("stages", "expected"),
    [
        ([PLAIN], 0.05),
        ([PLAIN, BOXES], 0.1),
        ([PLAIN, BOXES, FENCE], 0.5),  # half of a fence of 0.50 m per 0.7 m of side (1.4 m)
        ([SMALL], 0.05),  # the boxes of a fixed level are 0.1 m, whatever `obstacle_size`
    ],
)
def test_largest_half(stages: list[StageConfig], expected: float) -> None:
    assert stage.largest_half(stages) == pytest.approx(expected, rel=1e-12)  # rounding of float64


@pytest.mark.parametrize(
    ("robots", "obstacles", "key", "most"),
    [
        # Starts lie at -0.26 * 10 / 7 + 0.1 n and keep 0.06 m from the wall at 0.5 m: n up to 8.
        (10, 0, "robots", 9),
        (2, 5, "obstacles", 4),
    ],
)
def test_a_fixed_level_has_room_for_so_many(
    robots: int, obstacles: int, key: str, most: int
) -> None:
    with pytest.raises(ConfigError, match=f"{key} is .* give at most {most}"):
        StageConfig(name="full", robots=robots, side=1.0, obstacles=obstacles, level="fixed")
    fitting = StageConfig(
        name="fits",
        robots=min(robots, 9),
        side=1.0,
        obstacles=min(obstacles, 4),
        level="fixed",
    )
    assert stage.stack([fitting]).fixed.all()
