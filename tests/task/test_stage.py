"""Stages as arrays."""

import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.config import StageConfig
from swarmjax.task import stage

PLAIN = StageConfig(name="a", robots=2, side=0.5)
BOXES = StageConfig(name="b", robots=5, side=1.2, obstacles=3, obstacle_size=0.2)
FENCE = StageConfig(name="c", robots=3, side=1.4, obstacles=1, level="fixed", layout="fence")


def test_stack() -> None:
    found = stage.stack([PLAIN, BOXES, FENCE])
    expected = stage.Stage(
        robots=np.array([2, 5, 3], np.int32),
        obstacles=np.array([0, 3, 1], np.int32),
        side=np.array([0.5, 1.2, 1.4], np.float32),
        obstacle_size=np.array([0.1, 0.2, 0.1], np.float32),
        fixed=np.array([False, False, True]),
        fence=np.array([False, False, True]),
    )
    for mine, theirs in zip(found, expected, strict=True):
        assert mine.dtype == theirs.dtype
        np.testing.assert_array_equal(mine, theirs)


def test_select_one_or_many() -> None:
    stages = stage.stack([PLAIN, BOXES, FENCE])
    assert stage.select(stages, 1).robots == 5
    many = stage.select(stage.Stage(*map(jnp.asarray, stages)), jnp.array([2, 0, 2]))
    assert many.robots.tolist() == [3, 2, 3]
    assert many.fence.tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("stages", "expected"),
    [
        ([PLAIN], 0.05),
        ([PLAIN, BOXES], 0.1),
        ([PLAIN, BOXES, FENCE], 0.5),  # half of 0.50 m a 0.7 m of side, at 1.4 m
    ],
)
def test_largest_half(stages: list[StageConfig], expected: float) -> None:
    assert stage.largest_half(stages) == pytest.approx(expected, rel=1e-12)  # rounding of float64
