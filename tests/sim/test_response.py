"""Tests the sensors' counts against Webots' figures, a measured robot and a repeated fit."""

import functools
import math
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import optimize

from swarmjax import epuck
from swarmjax.sim import infrared, response
from swarmjax.sim.infrared import Reflectance
from swarmjax.sim.response import REACH, Wear

RADIUS = 0.037  # m
TILT = math.cos(0.16)
# One text computes both. JAX compiles each shape anew, so only the comparisons below take it.
MODULES = pytest.mark.parametrize(
    "xp", [np, pytest.param(jnp, marks=pytest.mark.slow)], ids=["numpy", "jax"]
)
RESPONSES = pytest.mark.parametrize("name", ["webots", "real"])
NO_BOX = np.zeros((0, 5), np.float32)
# Float32 rounds counts of up to 4095 by 2.4e-4. Float32 rounds lengths of up to 0.07 m by 4e-9 m,
# which adds 1.6e-3 counts at the steepest slope, 3.9e5 counts/m.
ROUNDING = 4e-3
# The table of Webots' E-puckDistanceSensor: length (m), counts, relative standard deviation.
LENGTH = (0.0, 0.005, 0.010, 0.015, 0.020, 0.030, 0.040, 0.050, 0.060, 0.070)
COUNTS = (4095.0, 2133.33, 1465.73, 601.46, 383.84, 234.93, 158.03, 120.0, 104.09, 67.19)
SHARE = (0.002, 0.003, 0.007, 0.0406, 0.01472, 0.0241, 0.0287, 0.04225, 0.03065, 0.04897)


def _f32(*values: Any) -> np.ndarray:
    return np.array(values, np.float32)


def _before_a_wall(gap: float, xp: ModuleType) -> np.ndarray:
    """Returns the counts [8] of a robot that faces a wall with this gap to its hull."""
    kind = xp.float32 if xp is jnp else float
    pose = xp.array([[0.5 - RADIUS - gap, 0.1, 0.0]], kind)
    side, box = xp.array(1.0, kind), xp.array(NO_BOX, kind)
    ray, bright = infrared.sights(
        pose, side, box, RADIUS, REACH["webots"], Reflectance(), infrared.EPUCK
    )
    return np.asarray(response.read("webots", ray, bright, Wear(), None, xp))[0]


@MODULES
@pytest.mark.parametrize(
    ("gap", "front", "diagonal"),
    [
        (0.000, 1809.7, 356.6),
        (0.005, 994.4, 248.3),
        (0.010, 469.6, 185.9),
        (0.015, 334.2, 144.1),
        (0.020, 255.3, 118.5),
        (0.025, 204.6, 106.9),
        (0.030, 163.9, 83.9),
        (0.035, 140.8, 67.2),
        (0.040, 120.6, 67.2),
        (0.050, 102.4, 67.2),
    ],
)
def test_counts_of_webots_before_a_wall(
    xp: ModuleType, gap: float, front: float, diagonal: float
) -> None:
    """Checks the right-hand sensors against figures, the left-hand ones against the table.

    The left-hand sensors look in slightly different directions.
    """
    counts = _before_a_wall(gap, xp)
    # 0.05 of the tolerance is the rounding of the figures.
    assert counts[0] == pytest.approx(front, abs=0.1)
    assert counts[1] == pytest.approx(diagonal, abs=0.1)
    for sensor, x, yaw in ((7, 0.030, 0.29920), (6, 0.022, 0.79920)):
        length = (RADIUS + gap - x) / (math.cos(yaw) * TILT)
        # Float32 rounds the distance to the wall by 6e-8 m, at a slope of 1.7e5 counts/m.
        assert counts[sensor] == pytest.approx(np.interp(length, LENGTH, COUNTS), abs=0.02)
    np.testing.assert_allclose(counts[2:6], 67.19, atol=ROUNDING)  # free space


@MODULES
def test_the_table_of_webots_and_its_ends(xp: ModuleType) -> None:
    ray = TILT * _f32(*LENGTH, 0.0025, 0.065, 0.08, 1.0)
    middle = [(4095 + 2133.33) / 2, (104.09 + 67.19) / 2, 67.19, 67.19]
    counts = response.expected("webots", xp.array(ray), xp)
    assert counts.dtype == np.float32
    np.testing.assert_allclose(counts, [*COUNTS, *middle], atol=ROUNDING)


SAMPLES = 100_000


def _moments(name: Any, ray: np.ndarray, wear: Wear) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mean and the standard deviation of sampled counts, [2, 8] each."""
    normal = np.random.default_rng(0).standard_normal((SAMPLES, 2, 8))
    counts = response.read(name, np.broadcast_to(ray, normal.shape), None, wear, normal, np)
    return counts.mean(axis=0), counts.std(axis=0)


def _assert_moments(found: tuple[np.ndarray, np.ndarray], mean: Any, sd: Any) -> None:
    # The bounds are five standard errors: sd / sqrt(n) for the mean and sd / sqrt(2 n) for the
    # standard deviation. By chance one of the 32 figures exceeds its bound for one seed in 5e4, and
    # the seed is fixed.
    assert (np.abs(found[0] - mean) < 5 * sd / math.sqrt(SAMPLES)).all()
    assert (np.abs(found[1] - sd) < 5 * sd / math.sqrt(2 * SAMPLES)).all()


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_the_noise_of_webots_is_a_share_of_the_counts(factor: float) -> None:
    length = np.linspace(0.0, 0.075, 16).reshape(2, 8)  # the table's points and points between
    mean = np.interp(length, LENGTH, COUNTS)
    sd = factor * mean * np.interp(length, LENGTH, SHARE)
    wear = Wear(noise=np.full((2, 8), factor))
    _assert_moments(_moments("webots", TILT * length, wear), mean, sd)


def test_the_noise_of_a_measured_robot_is_that_of_each_sensor_wherever_it_looks() -> None:
    ray = np.array([[0.02] * 8, [0.2] * 8])
    factor = np.linspace(0.6, 3.5, 16).reshape(2, 8)
    # The median of each sensor's standard deviations measured at 1 to 7 cm.
    median = np.median(np.array(epuck.MEASURED_INFRARED_SD)[:, 1:], axis=-1)
    mean = response.expected("real", ray, np)
    found = _moments("real", ray, Wear(noise=factor))
    _assert_moments(found, mean, factor * median)
    # The counts of free space are subtracted, and negative counts are not cut off.
    np.testing.assert_array_equal(mean[1], 0.0)
    assert (np.abs(found[0][1]) < 0.2).all()


@RESPONSES
def test_compiled_over_a_batch_jax_reads_what_numpy_reads(name: Any) -> None:
    draw = np.random.default_rng(3)
    shape = (50, 4, 8)
    wear = Wear(
        noise=draw.uniform(0.6, 3.5, shape),
        gain=draw.uniform(0.7, 1.3, shape),
        dead=draw.uniform(size=shape) < 0.1,
    )
    given = draw.uniform(0.0, 0.12, shape), draw.uniform(0.35, 1.0, shape), wear
    normal = draw.standard_normal(shape)
    read = jax.jit(jax.vmap(functools.partial(response.read, name, xp=jnp)))
    found = read(*given, normal)
    assert found.dtype == jnp.float32
    expected = response.read(name, *given, normal, np)
    # The steepest slope is 9e5 counts/m, of a measured sensor before it saturates. The rounding of
    # 0.01 m, 5e-10 m, then makes less than 2e-3 counts. Several roundings of 4095 add to that.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-2)


def _to_hull() -> np.ndarray:
    """Returns distances [8] in m from the sensors along their rays to the hull, by root finding."""
    found = []
    for x, y, yaw in epuck.SENSOR_POSES:
        reach = optimize.brentq(
            lambda t, x=x, y=y, yaw=yaw: (
                math.hypot(x + t * math.cos(yaw), y + t * math.sin(yaw)) - RADIUS
            ),
            0.0,
            0.02,
        )
        found.append(reach)
    return np.array(found)


TO_HULL = _to_hull()
MEASURED = np.array(epuck.MEASURED_INFRARED)
MEASURED_SD = np.array(epuck.MEASURED_INFRARED_SD)
GAPS = np.arange(1, 8) * 0.01  # m
SPAN = np.array(epuck.INFRARED_FIT)[:, 4] - np.array(epuck.INFRARED_FIT)[:, 2]  # counts


def test_the_hull_lies_as_far_from_the_sensors_as_stated() -> None:
    # These values in mm were computed independently of this project and are exact to their last
    # digit.
    stated = [5.38, 3.70, 6.00, 3.46, 3.46, 6.00, 3.70, 5.38]
    np.testing.assert_allclose(1e3 * TO_HULL, stated, atol=0.005)


@MODULES
def test_the_curves_run_through_what_was_measured_at_1_to_7_cm(xp: ModuleType) -> None:
    free = np.array(epuck.INFRARED_FIT)[:, 2]
    ray = _f32(GAPS[:, None] + TO_HULL)[0]
    counts = np.asarray(response.expected("real", xp.array(ray), xp)).T + free[:, None]
    residual = counts - MEASURED[:, 1:]
    relative = np.sqrt(np.mean((residual / MEASURED_SD[:, 1:]) ** 2, axis=-1))
    assert relative.max() <= 2.2
    assert np.abs(residual).max() <= 13.0
    # The residuals are those stated in epuck.py, to the digits given here.
    worst = np.abs(residual).max(axis=-1)
    np.testing.assert_allclose(
        relative, [0.59, 1.38, 2.06, 1.32, 2.00, 1.43, 0.87, 0.56], atol=0.006
    )
    np.testing.assert_allclose(worst, [13.0, 11.4, 11.6, 8.3, 11.2, 12.4, 6.5, 6.4], atol=0.06)


@pytest.mark.parametrize("sensor", range(8))
def test_the_fit_done_again_gives_the_same_curves(sensor: int) -> None:
    mean, sd = MEASURED[sensor, 1:], MEASURED_SD[sensor, 1:]

    def residual(scaled: np.ndarray) -> np.ndarray:
        strength, depth, free = scaled * (0.1, 0.001, 100.0)
        return strength / (GAPS + depth) ** 2 + free - mean

    found = optimize.minimize(
        lambda scaled: np.mean((residual(scaled) / sd) ** 2),
        (1.8, 3.0, mean[-1] / 100 - 0.3),
        method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": lambda scaled: 13.0 - residual(scaled)},
            {"type": "ineq", "fun": lambda scaled: 13.0 + residual(scaled)},
        ],
        options={"ftol": 1e-15, "maxiter": 500},
    )
    # The constants have five digits, and the fit is more accurate than the last digit.
    fitted = found.x * (0.1, 0.001, 100.0)
    np.testing.assert_allclose(epuck.INFRARED_FIT[sensor][:3], fitted, rtol=1e-4)
    assert epuck.INFRARED_FIT[sensor][3] == np.median(sd)
    assert epuck.INFRARED_FIT[sensor][4] == MEASURED[sensor, 0]


@MODULES
def test_a_measured_robot_saturates_at_its_hull_and_inside(xp: ModuleType) -> None:
    free = np.array(epuck.INFRARED_FIT)[:, 2]
    for gap in (0.0, -0.002):
        counts = response.expected("real", xp.array(_f32(TO_HULL + gap)[0]), xp)
        np.testing.assert_allclose(counts + free, MEASURED[:, 0], atol=ROUNDING)
    # A sensor with a higher gain does not report more than the limit.
    bright = response.read("real", xp.array(_f32(TO_HULL)[0]), None, Wear(gain=1.3), None, xp)
    np.testing.assert_allclose(bright + free, MEASURED[:, 0], atol=ROUNDING)


@MODULES
def test_a_measured_robot_that_is_pressed_into_something_sees_it_at_its_hull(
    xp: ModuleType,
) -> None:
    strength, depth, *_ = np.array(epuck.INFRARED_FIT).T
    dim = xp.full((2, 8), 0.1, xp.float32)  # too dim to saturate
    ray = xp.array(_f32([0.0] * 8, TO_HULL))
    counts = response.read("real", ray, dim, Wear(), None, xp)
    expected = np.minimum(0.1 * strength / depth**2, SPAN)
    # The hull's distance of 4 to 6 mm is rounded by 2e-10 m. The counts go with the inverse square
    # of depths of 1.5 mm, so their relative error is twice 2e-10 m / 1.5 mm.
    np.testing.assert_allclose(counts, [expected, expected], rtol=1e-6)


@MODULES
def test_a_measured_robot_sees_nothing_at_its_reach(xp: ModuleType) -> None:
    ray = xp.array(_f32([0.0999] * 8, [0.1] * 8, [1.0] * 8))
    counts = np.asarray(response.expected("real", ray, xp))
    assert (counts[0] > 10.0).all()
    np.testing.assert_array_equal(counts[1:], 0.0)


def _edge_of_saturation() -> np.ndarray:
    """Returns the longest rays [8] in m at which a nominal sensor saturates.

    There A / (gap + d)^2 = limit - b.
    """
    strength, depth, free, _, limit = np.array(epuck.INFRARED_FIT).T
    return np.sqrt(strength / (limit - free)) - depth + TO_HULL


EDGE = _edge_of_saturation()


@MODULES
@RESPONSES
@given(share=st.lists(st.floats(0.0, 1.0, width=32), min_size=8, max_size=8))
def test_distance_undoes_expected(xp: ModuleType, name: Any, share: list[float]) -> None:
    low = EDGE if name == "real" else 0.0
    # A thing that is 1e-6 m closer than the reach is seen in float32 as well.
    ray = _f32(low + np.array(share) * (REACH[name] - 1e-6 - low))[0]
    back = response.distance(name, response.expected(name, xp.array(ray), xp), xp)
    assert back.dtype == np.float32
    # Float32 rounds counts by a share of 6e-8, which is 2e-9 m at the flattest slope of the table
    # (3.7e3 counts/m at 67 to 104 counts). Lengths of 0.1 m are rounded about as much. The
    # tolerance allows several roundings of both.
    np.testing.assert_allclose(back, ray, rtol=0, atol=5e-8)


@MODULES
@RESPONSES
def test_counts_fall_as_things_recede(xp: ModuleType, name: Any) -> None:
    low = EDGE if name == "real" else np.zeros(8)
    ray = np.linspace(low + 1e-6, REACH[name] - 1e-6, 1000)
    counts = np.asarray(response.expected(name, xp.array(ray, xp.float32), xp))
    assert (np.diff(counts, axis=0) < 0.0).all()


@MODULES
def test_distance_of_counts_that_no_sensor_should_report(xp: ModuleType) -> None:
    counts = xp.array(_f32([-50.0] * 8, [0.0] * 8, [5.0] * 8, [4000.0] * 8, [9000.0] * 8))
    webots = response.distance("webots", counts, xp)
    for row in (0, 1, 2):
        np.testing.assert_allclose(webots[row], 0.07 * TILT, rtol=1e-6)
    # 4000 counts are 95 counts below 4095, on the first segment of the table.
    np.testing.assert_allclose(webots[3], TILT * 95 * 0.005 / (4095 - 2133.33), rtol=1e-5)
    np.testing.assert_array_equal(webots[4], 0.0)
    real = response.distance("real", counts, xp)
    for row in (0, 1, 2):
        np.testing.assert_allclose(real[row], 0.10, rtol=1e-6)
    for row in (3, 4):
        np.testing.assert_allclose(real[row], EDGE, rtol=1e-5)


@MODULES
@pytest.mark.parametrize(
    ("length", "counts"),
    [
        (0.0266, 67.19),  # the farthest sight, at the end of the table: 0.07 * 0.38
        (0.0152, 158.03),  # as a wall at 0.04 m
        (0.0253, 80.0),  # 0.07 - 0.01 * (80 - 67.19) / (104.09 - 67.19) = 0.0665; * 0.38
    ],
)
def test_another_epuck_seen_side_by_side(xp: ModuleType, length: float, counts: float) -> None:
    """Checks that an e-puck of reflectance 0.38 is seen up to 26.6 mm along a ray.

    The ray rises, so this is 26.3 mm along the floor.
    """
    side, kind = xp.array(2.0, xp.float32), xp.float32
    apart = 0.031 + length * TILT + RADIUS  # sensor, ray, hull
    pose = xp.array([[0.0, 0.0, 0.0], [0.0, apart, 0.0]], kind)
    ray, bright = infrared.sights(
        pose, side, xp.array(NO_BOX), RADIUS, REACH["webots"],
        Reflectance(robot=xp.array([0.38, 0.38], kind)), infrared.EPUCK,
    )  # fmt: skip
    found = np.asarray(response.read("webots", ray, bright, Wear(), None, xp))
    expected = np.full((2, 8), 67.19)
    expected[0, 5] = expected[1, 2] = counts
    # 0.0253 is rounded from 0.02527, which gives 80.0. The difference of 3e-5 / 0.38 m times
    # 3.7e3 counts/m is 0.3 counts.
    np.testing.assert_allclose(found, expected, atol=0.3)
    assert (found[0, 5] > 67.19 + ROUNDING) == (length < 0.026)


@MODULES
def test_reflectance_of_a_measured_robot_is_a_share_of_what_comes_back(xp: ModuleType) -> None:
    strength, depth, *_ = np.array(epuck.INFRARED_FIT).T
    ray = xp.array(_f32(TO_HULL + 0.02)[0])
    found = response.read("real", ray, xp.full(8, 0.5, xp.float32), Wear(), None, xp)
    np.testing.assert_allclose(found, 0.5 * strength / (0.02 + depth) ** 2, rtol=1e-5)


@MODULES
def test_gain_and_dead_of_webots(xp: ModuleType) -> None:
    """Checks rays of length 0.04 m: 158.03 counts, of which 67.19 are the counts of free space."""
    wear = Wear(
        gain=xp.array(_f32(1.0, 1.2, 0.7, 1.2, 1.0, 1.2, 1.2, 1.0)),
        dead=xp.array([False, False, False, False, False, True, False, True]),
    )
    ray = xp.full(8, 0.04 * TILT, xp.float32)
    found = response.read("webots", ray, None, wear, None, xp)
    echo = 158.03 - 67.19
    expected = [158.03, 67.19 + 1.2 * echo, 67.19 + 0.7 * echo, 67.19 + 1.2 * echo, 158.03]
    expected += [67.19, 67.19 + 1.2 * echo, 67.19]
    np.testing.assert_allclose(found, expected, atol=ROUNDING)
    # A normal number of 1 and a noise factor of 2 add two standard deviations. The noise is a share
    # of the counts from table and gain. A dead sensor has the noise of free space.
    share = np.array([0.0287] * 5 + [0.04897, 0.0287, 0.04897])
    noisy = response.read("webots", ray, None, wear._replace(noise=xp.full(8, 2.0)), xp.ones(8), xp)
    np.testing.assert_allclose(noisy, expected * (1 + 2 * share), atol=ROUNDING)


@MODULES
def test_gain_and_dead_of_a_measured_robot(xp: ModuleType) -> None:
    strength, depth, _, sd, _ = np.array(epuck.INFRARED_FIT).T
    gain = _f32(1.0, 1.3, 0.7, 1.3, 1.0, 1.3, 1.3, 1.0)
    dead = np.array([False, False, False, False, False, True, False, True])
    wear = Wear(gain=xp.array(gain), dead=xp.array(dead))
    ray = xp.array(_f32(TO_HULL + 0.03)[0])
    expected = np.where(dead, 0.0, gain * strength / (0.03 + depth) ** 2)
    found = response.read("real", ray, None, wear, None, xp)
    np.testing.assert_allclose(found, expected, atol=ROUNDING)
    noisy = wear._replace(noise=xp.full(8, 2.0))
    found = response.read("real", ray, None, noisy, xp.full(8, -1.0), xp)
    np.testing.assert_allclose(found, expected - 2 * sd, atol=ROUNDING)


@RESPONSES
def test_noise_that_is_off_leaves_the_reading_alone(name: Any) -> None:
    ray = np.full(8, 0.03)
    clean = response.expected(name, ray, np)
    ones = np.ones(8)
    np.testing.assert_array_equal(response.read(name, ray, None, Wear(), ones, np), clean)
    noisy = Wear(noise=ones)
    np.testing.assert_array_equal(response.read(name, ray, None, noisy, None, np), clean)
    assert (response.read(name, ray, None, noisy, ones, np) > clean).all()
