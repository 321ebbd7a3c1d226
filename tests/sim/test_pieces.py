"""Tests that taking things one by one gives the same result as taking all at once."""

import functools
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.sim import gaps, infrared
from swarmjax.sim.dispatch import MOST_PIECES, pieces

RADIUS = 0.037  # m
RANGE = 0.04  # m
MODULES = pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])


def test_jax_takes_few_things_one_by_one() -> None:
    assert pieces(3, jnp) == [slice(0, 1), slice(1, 2), slice(2, 3)]
    assert len(pieces(MOST_PIECES, jnp)) == MOST_PIECES


@pytest.mark.parametrize(("count", "xp"), [(0, jnp), (MOST_PIECES + 1, jnp), (0, np), (3, np)])
def test_many_things_none_and_numpy_are_one_piece(count: int, xp: ModuleType) -> None:
    assert pieces(count, xp) == [slice(None)]


@MODULES
@pytest.mark.parametrize("count", [2, MOST_PIECES + 1])
def test_the_last_of_few_and_of_many_robots_and_boxes_is_met(xp: ModuleType, count: int) -> None:
    """Puts robot 0 at the origin, with the last box ahead of it and the last robot on its left."""
    pose = np.array([[0.0, -2.0 - 0.2 * i, 0.0] for i in range(count)], np.float32)
    pose[0], pose[-1] = 0.0, [0.0, 0.1, 0.0]
    box = np.array([[-2.0 - 0.2 * i, 0.0, 0.0, 0.05, 0.05] for i in range(count)], np.float32)
    box[-1, :2] = [0.1, 0.0]
    look = functools.partial(infrared.distances, hull_radius=RADIUS, limit=RANGE, xp=xp)
    measure = functools.partial(gaps.gaps, hull_radius=RADIUS, xp=xp)
    if xp is jnp:
        look, measure = jax.jit(look), jax.jit(measure)
    pose, side, box = xp.asarray(pose), np.float32(20.0), xp.asarray(box)
    seen, gap = look(pose, side, box), measure(pose, side, box)
    # 1e-6 m covers several roundings of float32. The walls are 10 m away.
    np.testing.assert_allclose(gap[0], [0.1 - 2 * RADIUS, 0.05 - RADIUS, 10 - RADIUS], atol=1e-6)
    # Sensor 5 sits 0.031 m beside the centre and looks left. Sensor 0 sits 0.030 m ahead of the
    # centre and looks at the face of the box, turned by 0.30081 rad.
    assert seen[0, 5] == pytest.approx(0.1 - RADIUS - 0.031, abs=1e-6)
    assert seen[0, 0] == pytest.approx((0.05 - 0.030) / np.cos(0.30081), abs=1e-6)
    assert seen[0, 2] == np.float32(RANGE)  # nothing is to the right
