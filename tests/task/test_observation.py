"""Tests what a robot observes against values worked out by hand."""

import json
from types import ModuleType

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmjax.task import observation
from swarmjax.task.observation import Readings

MODULES = pytest.mark.parametrize("xp", [np, jnp])
PI = np.pi


def test_layout() -> None:
    infrared = [f"infrared_{i}" for i in range(8)]
    assert list(observation.NAMES) == [*infrared, "target_distance", "target_bearing"]
    assert observation.LAYOUTS["metric"].units == ("m",) * 9 + ("rad",)
    assert observation.LAYOUTS["webots"].units == ("counts",) * 8 + ("m", "rad")
    assert observation.SIZE == 10


def test_description_is_plain_data_that_says_everything() -> None:
    found = observation.describe("webots")
    assert json.loads(json.dumps(found)) == found
    assert found == {
        "names": list(observation.NAMES),
        "encoding": "webots",
        "units": ["counts"] * 8 + ["m", "rad"],
        "offset": [0.0] * 9 + [-PI],
        "scale": [1023.0] * 8 + [1.5, 2 * PI],
    }


@MODULES
@pytest.mark.parametrize(
    ("pose", "target", "distance", "bearing"),
    [
        ((0.0, 0.0, 0.0), (0.3, 0.4), 0.5, np.arctan2(4, 3)),
        ((0.1, 0.2, 0.0), (0.1, 0.7), 0.5, 0.5 * PI),  # left is positive
        ((0.1, 0.2, 0.5 * PI), (0.1, 0.7), 0.5, 0.0),  # straight ahead
        ((0.1, 0.2, PI), (0.1, 0.7), 0.5, -0.5 * PI),
        ((0.0, 0.0, 0.75 * PI), (0.2, 0.0), 0.2, -0.75 * PI),
        ((0.0, 0.0, 10 * PI + 0.3), (0.2, 0.0), 0.2, -0.3),  # a yaw is not bounded
        ((0.3, -0.3, 1.0), (0.3, -0.3), 0.0, 0.0),  # on the target
    ],
)
def test_target(
    xp: ModuleType,
    pose: tuple[float, float, float],
    target: tuple[float, float],
    distance: float,
    bearing: float,
) -> None:
    place = xp.asarray(pose, dtype=xp.float32)
    found = observation.to_target(place, xp.asarray(target, dtype=xp.float32), xp)
    # 1e-6 m and 1e-5 rad cover float32 at a yaw of 30 rad.
    assert float(found[0]) == pytest.approx(distance, abs=1e-6)
    assert float(found[1]) == pytest.approx(bearing, abs=1e-5)


@given(st.floats(-20.0, 20.0), st.floats(-PI, PI), st.floats(0.01, 2.0))
def test_bearing_lies_within_half_a_turn(yaw: float, angle: float, distance: float) -> None:
    pose = np.array([0.1, -0.2, yaw])
    target = pose[:2] + distance * np.array([np.cos(yaw + angle), np.sin(yaw + angle)])
    found, bearing = observation.to_target(pose, target, np)
    assert found == pytest.approx(distance, abs=1e-12)  # rounding of float64
    assert abs(bearing) <= PI
    # Bearings are compared as directions, because half a turn to the left is half a turn to the
    # right. 1e-11 covers the rounding of float64.
    assert abs(np.exp(1j * bearing) - np.exp(1j * angle)) < 1e-11


@MODULES
def test_order(xp: ModuleType) -> None:
    rays = 0.001 * np.arange(16).reshape(2, 8)
    found = observation.observe(
        Readings(xp.asarray(rays), xp.asarray([0.5, 0.6]), xp.asarray([-1.0, 2.0])),
        observation.LAYOUTS["metric"],
        xp,
    )
    expected = np.array([[*rays[0], 0.5, -1.0], [*rays[1], 0.6, 2.0]], np.float32)
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == np.float32


@MODULES
def test_scale_of_the_published_example(xp: ModuleType) -> None:
    # Entries are counts / 1023, distance / 1.5 m, and a bearing, 0.5 dead ahead and 1 at +pi.
    found = observation.observe(
        Readings(xp.asarray([[1023.0] * 7 + [67.19]]), xp.asarray([0.75]), xp.asarray([0.5 * PI])),
        observation.LAYOUTS["webots"],
        xp,
    )
    expected = [[*[1.0] * 7, 67.19 / 1023.0, 0.5, 0.75]]
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # float32
    ahead = observation.observe(
        Readings(xp.zeros(8), xp.zeros(()), xp.zeros(())), observation.LAYOUTS["webots"], xp
    )
    np.testing.assert_allclose(ahead, [0.0] * 9 + [0.5], atol=1e-7)  # float32
