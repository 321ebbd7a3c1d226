"""Tests the speeds of wheels against the firmware, and their noise."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmjax.sim import motor, noise
from swarmjax.sim.noise import Stream
from swarmjax.sim.realism_config import RealismConfig

IDEAL = RealismConfig()
RATE = 2 * math.pi / 1000  # rad/s at one step per second
SEED = np.uint32(11)


# --- NumPy and JAX


@pytest.mark.parametrize("version", ["epuck1", "epuck2", None])
@pytest.mark.parametrize("deviation", [0.05, None])
def test_numpy_with_leading_axes_and_mapped_jax_disturb_alike(
    version: Any, deviation: float | None
) -> None:
    realism = RealismConfig(speed_noise=deviation, speed_quantisation=version)
    seeds = np.arange(20, dtype=np.uint32)
    wheels = np.random.default_rng(3).uniform(-7, 7, (20, 5, 2)).astype(np.float32)

    def arena(wheel: Any, seed: Any, clock: Any) -> Any:
        return motor.disturb(wheel, realism, seed, clock, jnp)

    expected = motor.disturb(wheels, realism, seeds, 4, np)
    found = jax.jit(jax.vmap(arena, in_axes=(0, 0, None)))(wheels, seeds, jnp.int32(4))
    assert found.dtype == expected.dtype == np.float32
    # 5e-6 rad/s covers the normal numbers' error of 2e-6 times 0.05, and 10 ulp of a float32 at 8.
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-6)


# --- wheels


@pytest.mark.parametrize(
    ("version", "asked", "made"),
    [
        # Version 1 makes 10000 / int(10000 / s) steps per second. A step here takes 10, 11, 12 or
        # 16 ticks of 0.1 ms (`e_motors.c` of e-puck-library).
        ("epuck1", 1000, 1000.0),
        ("epuck1", 950, 1000.0),
        ("epuck1", 900, 909.0909),
        ("epuck1", 800, 833.3333),
        ("epuck1", 600, 625.0),
        # Version 2 makes 100000 / (2 int(100000 / (2 s))) steps per second. The integer here is 50,
        # 52, 83, 45 or 50000.
        ("epuck2", 1000, 1000.0),
        ("epuck2", 950, 961.5385),
        ("epuck2", 600, 602.4096),
        ("epuck2", 1100, 1111.1111),
        ("epuck2", 1, 1.0),
        # A fraction of a step per second is cut off, so 0.98 steps per second become 0.
        ("epuck1", 909.9, 909.0909),
        ("epuck2", 1.98, 1.0),
        ("epuck1", 0.98, 0.0),
        ("epuck2", 0.98, 0.0),
        ("epuck1", 0, 0.0),
        # No timer is faster than its tick.
        ("epuck1", 1e12, 10_000.0),
        ("epuck2", 1e12, 50_000.0),
    ],
)
def test_speeds_of_the_firmware(version: Any, asked: float, made: float) -> None:
    # A thousandth of a step per second keeps whole numbers from being rounded down by one.
    speed = np.array([asked + 1e-3, -asked - 1e-3]) * RATE
    for xp, kind in ((np, np.float64), (np, np.float32), (jnp, np.float32)):
        found = motor.quantise(xp.asarray(speed, kind), version, xp)
        assert found.dtype == kind
        # 5e-7 covers half of the table's last digit and three roundings of float32.
        np.testing.assert_allclose(np.asarray(found) / RATE, [made, -made], rtol=5e-7)


@given(st.sampled_from(["epuck1", "epuck2"]), st.floats(-8.0, 8.0, width=32, allow_subnormal=False))
def test_the_wheel_makes_the_next_faster_speed_that_the_timer_has(
    version: Any, speed: float
) -> None:
    found = float(motor.quantise(np.array([speed], np.float32), version, np)[0])
    asked, made = abs(speed) / RATE, abs(found) / RATE
    if asked < 1.0 - 1e-6:
        assert found == 0.0
    if asked < 1.0 + 1e-6:
        return
    assert math.copysign(1.0, found) == math.copysign(1.0, speed)
    # The firmware cuts off less than one step per second and less than one tick. 1e-6 is the
    # rounding of float32.
    ticks = {"epuck1": 10_000, "epuck2": 50_000}[version]
    assert made * (1 + 1e-6) >= asked - 1.0
    assert ticks / made * (1 + 1e-6) > ticks / asked - 1.0
    assert ticks / made == pytest.approx(round(ticks / made), rel=1e-6)


def test_speed_noise_is_relative_and_each_wheels_own() -> None:
    realism = RealismConfig(speed_noise=0.05)
    wheels = np.full((50_000, 1, 2), -4.0, np.float32)
    found = motor.disturb(wheels, realism, np.arange(50_000, dtype=np.uint32), 7, np)
    relative = (found / wheels - 1.0).astype(float)[:, 0]
    # The mean, the standard deviation and the correlation are each off by more than 4.42 of their
    # deviations with probability 1e-5.
    assert np.abs(relative.mean(axis=0)).max() < 4.42 * 0.05 / math.sqrt(50_000)
    assert np.abs(relative.std(axis=0) - 0.05).max() < 4.42 * 0.05 / math.sqrt(2 * 50_000)
    assert abs(np.corrcoef(relative.T)[0, 1]) < 4.42 / math.sqrt(50_000)
    # Each control step draws new noise.
    later = motor.disturb(wheels, realism, np.arange(50_000, dtype=np.uint32), 8, np)
    both = np.stack([found[:, 0, 0], later[:, 0, 0]])
    assert abs(np.corrcoef(both)[0, 1]) < 4.42 / math.sqrt(50_000)


def test_the_noise_comes_on_top_of_what_the_firmware_makes() -> None:
    realism = RealismConfig(speed_noise=0.05, speed_quantisation="epuck1")
    wheels = np.full((4, 2), 950.5 * RATE)  # the firmware makes it 1000 steps per second
    noisy = motor.disturb(wheels, realism, SEED, 0, np)
    drawn = noise.normal(SEED, 0, Stream.SPEED_NOISE, (4, 2), np)
    # 1e-6 covers the rounding of float32 at 6.3 rad/s.
    np.testing.assert_allclose(noisy, 1000 * RATE * (1 + 0.05 * drawn), rtol=1e-6)


def test_wheels_at_rest_stay_at_rest() -> None:
    realism = RealismConfig(speed_noise=0.5, speed_quantisation="epuck2")
    np.testing.assert_array_equal(motor.disturb(np.zeros((3, 2)), realism, SEED, 0, np), 0.0)


def test_ideal_wheels_do_as_they_are_told() -> None:
    wheels = np.random.default_rng(0).normal(size=(3, 2))
    assert motor.disturb(wheels, IDEAL, SEED, 0, np) is wheels
