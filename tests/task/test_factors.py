"""Tests the factors of an episode: their presence, distributions and independence."""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from swarmjax.sim.config import RobotConfig
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task import factors
from swarmjax.task.factors import Factors

ROBOT = RobotConfig()
ROBOTS, SENSORS, OBSTACLES = 5, 8, 3
SEEDS = np.arange(10_000, dtype=np.uint32)
# A standard normal number lies beyond +-4.42 with probability 1e-5, so a fair generator rarely
# fails.
FAR = 4.42
# XLA may fuse the product and the sum in low + u * (high - low), which changes float32 rounding.
ROUNDING = 3e-7

# For every factor, the setting that switches it on, its field, and the field's shape.
RANGES: dict[str, Any] = {
    "wheel_radius": (0.0198, 0.0207),
    "track": (0.052, 0.0575),
    "max_wheel_speed": (6.0, 6.9),
    "mass": (0.13, 0.20),
    "friction": (0.6, 1.2),
    "infrared_noise": (0.6, 3.5),
    "infrared_gain": (0.7, 1.3),
    "infrared_period": (0.01, 0.05),
    "reflectance": (0.35, 0.9),
    "reflectance_robot": (0.3, 1.0),
}
DEVIATIONS: dict[str, Any] = {"infrared_yaw": 0.0349}
LATENCIES: dict[str, Any] = {"action_latency": (0, 2), "observation_latency": (1, 4)}
EPISODE = {**RANGES, **DEVIATIONS, **LATENCIES, "dead_sensor": 0.02}
STEP: dict[str, Any] = {
    "speed_noise": 0.05,
    "target_distance_noise": 0.005,
    "target_bearing_noise": 0.0524,
}
SHAPES = {
    "seed": (),
    "wheel_radius": (ROBOTS, 2),
    "track": (ROBOTS,),
    "max_wheel_speed": (ROBOTS,),
    "mass": (ROBOTS,),
    "friction": (ROBOTS,),
    "infrared_noise": (ROBOTS, SENSORS),
    "infrared_gain": (ROBOTS, SENSORS),
    "infrared_yaw": (ROBOTS, SENSORS),
    "infrared_period": (ROBOTS,),
    "dead_sensor": (ROBOTS, SENSORS),
    "reflectance": (1 + OBSTACLES,),
    "reflectance_robot": (ROBOTS,),
    "action_latency": (ROBOTS,),
    "observation_latency": (ROBOTS,),
}


def _realism(**settings: Any) -> RealismConfig:
    return RealismConfig(infrared="real", **settings)


ALL = _realism(**EPISODE, **STEP, speed_quantisation="epuck2")


def _draw(realism: RealismConfig, seed: Any = SEEDS, robots: int = ROBOTS) -> Factors:
    return factors.draw(seed, realism, robots, OBSTACLES, np)


def _on(found: Factors) -> set[str]:
    """Returns the names of the fields that are not None."""
    return {name for name, value in found._asdict().items() if value is not None}


@pytest.fixture(scope="module")
def drawn() -> Factors:
    """Returns all factors of 10,000 episodes."""
    return _draw(ALL)


# --- which factors are present


def test_with_everything_off_there_is_nothing() -> None:
    for name in ("ideal", "webots", "real"):
        realism = RealismConfig(infrared=name)
        assert _on(_draw(realism)) == set()


def test_this_file_knows_every_factor() -> None:
    settings = {item.name for item in dataclasses.fields(RealismConfig)}
    others = {"name", "infrared", "speed_quantisation"}
    assert settings == {*EPISODE, *STEP} | others
    assert set(SHAPES) == set(Factors._fields)
    assert {*EPISODE, "seed"} == set(Factors._fields)


@pytest.mark.parametrize("name", EPISODE)
def test_a_factor_alone_makes_its_own_field(name: str) -> None:
    assert _on(_draw(_realism(**{name: EPISODE[name]}))) == {name, "seed"}


@pytest.mark.parametrize("name", STEP)
def test_a_factor_of_each_step_needs_the_seed_alone(name: str) -> None:
    found = _draw(_realism(**{name: STEP[name]}))
    assert _on(found) == {"seed"}
    np.testing.assert_array_equal(found.seed, SEEDS)


def test_what_is_not_random_needs_no_seed() -> None:
    assert _on(_draw(_realism(speed_quantisation="epuck1"))) == set()


@pytest.mark.parametrize("name", EPISODE)
def test_switching_a_factor_off_leaves_the_others_alone(name: str, drawn: Factors) -> None:
    without = _draw(dataclasses.replace(ALL, **{name: None}))
    assert _on(without) == set(Factors._fields) - {name}
    for field in _on(without):
        np.testing.assert_array_equal(getattr(without, field), getattr(drawn, field), field)


# --- shapes, types, and agreement of NumPy and JAX


def test_shapes_and_types(drawn: Factors) -> None:
    one = _draw(ALL, np.uint32(3))
    grid = _draw(ALL, SEEDS[:6].reshape(2, 3))
    kinds = {"seed": np.uint32, "dead_sensor": np.bool_}
    kinds |= {"action_latency": np.int32, "observation_latency": np.int32}
    for name, shape in SHAPES.items():
        assert np.shape(getattr(one, name)) == shape, name
        assert getattr(drawn, name).shape == (len(SEEDS), *shape), name
        assert getattr(grid, name).shape == (2, 3, *shape), name
        assert getattr(drawn, name).dtype == kinds.get(name, np.float32), name


def test_numpy_and_jax_draw_the_same_factors(drawn: Factors) -> None:
    def episode(seed: Any) -> Factors:
        return factors.draw(seed, ALL, ROBOTS, OBSTACLES, jnp)

    for found in (jax.jit(jax.vmap(episode))(SEEDS), jax.jit(episode)(SEEDS)):
        for name, expected in drawn._asdict().items():
            value = getattr(found, name)
            assert value.dtype == expected.dtype, name
            if expected.dtype != np.float32:
                np.testing.assert_array_equal(value, expected, name)
                continue
            # Normal numbers of NumPy and JAX differ by up to 2e-6 of their deviation, see
            # tests/sim/test_noise.py.
            scale = DEVIATIONS.get(name, 0.0)
            np.testing.assert_allclose(
                value, expected, rtol=ROUNDING, atol=2e-6 * scale, err_msg=name
            )


def test_an_episode_is_drawn_alike_alone_and_among_others(drawn: Factors) -> None:
    one = _draw(ALL, np.uint32(77))
    for name, value in one._asdict().items():
        # SIMD and scalar paths of NumPy's log and cos differ in the last bits.
        scale = 2e-6 * DEVIATIONS.get(name, 0.0)
        np.testing.assert_allclose(value, getattr(drawn, name)[77], rtol=0, atol=scale)


def test_more_robots_leave_the_first_alone() -> None:
    few, many = _draw(ALL, SEEDS[:50]), _draw(ALL, SEEDS[:50], robots=12)
    for name, shape in SHAPES.items():
        if shape[:1] == (ROBOTS,):
            more = getattr(many, name)
            assert more.shape[1] == 12, name
            # NumPy's log and cos differ in the last bits, as above.
            scale = 2e-6 * DEVIATIONS.get(name, 0.0)
            np.testing.assert_allclose(getattr(few, name), more[:, :ROBOTS], rtol=0, atol=scale)


# --- distributions


@pytest.mark.parametrize("name", RANGES)
def test_a_range_is_drawn_from_evenly(name: str) -> None:
    low, high = RANGES[name]
    found = getattr(_draw(_realism(**{name: RANGES[name]})), name).astype(float)
    if name == "wheel_radius":
        found = found[..., 0]  # both wheels are equal
    count = found.size
    assert found.min() >= low * (1 - ROUNDING)
    assert found.max() <= high * (1 + ROUNDING)
    share = ((found - low) / (high - low)).reshape(-1)
    # The variances of a share and of its squared distance from the middle are 1/12 and 1/180.
    assert abs(share.mean() - 0.5) < FAR * math.sqrt(1 / 12 / count)
    assert abs(((share - 0.5) ** 2).mean() - 1 / 12) < FAR * math.sqrt(1 / 180 / count)
    counts = np.histogram(np.clip(share, 0, 1), bins=20, range=(0, 1))[0]
    assert stats.chisquare(counts).pvalue > 1e-5  # a fair generator rarely fails


@pytest.mark.parametrize("name", DEVIATIONS)
def test_a_deviation_is_that_of_a_normal_number(name: str, drawn: Factors) -> None:
    found = getattr(drawn, name).astype(float).reshape(-1) / DEVIATIONS[name]
    # The standard errors of the means of z and z**2 are sqrt(1 / n) and sqrt(2 / n).
    assert abs(found.mean()) < FAR / math.sqrt(found.size)
    assert abs((found**2).mean() - 1.0) < FAR * math.sqrt(2 / found.size)
    assert stats.kstest(found, "norm").pvalue > 1e-5  # a fair generator rarely fails


@pytest.mark.parametrize("name", LATENCIES)
def test_each_latency_is_as_likely(name: str, drawn: Factors) -> None:
    low, high = LATENCIES[name]
    found = getattr(drawn, name).reshape(-1)
    assert found.min() == low
    assert found.max() == high
    assert stats.chisquare(np.bincount(found)[low:]).pvalue > 1e-5  # as above


def test_sensors_are_dead_as_often_as_asked(drawn: Factors) -> None:
    count = len(SEEDS) * ROBOTS * SENSORS
    share = np.asarray(drawn.dead_sensor).mean()
    assert abs(share - 0.02) < FAR * math.sqrt(0.02 * 0.98 / count)
    assert not np.asarray(_draw(_realism(dead_sensor=0.0)).dead_sensor).any()
    assert np.asarray(_draw(_realism(dead_sensor=1.0)).dead_sensor).all()


def test_a_range_of_one_number_is_that_number() -> None:
    realism = _realism(
        **{name: (value[0], value[0]) for name, value in RANGES.items()},
        action_latency=(2, 2),
        observation_latency=(0, 0),
    )
    found = _draw(realism)
    for name, (low, _) in RANGES.items():
        np.testing.assert_array_equal(getattr(found, name), np.float32(low), name)
    np.testing.assert_array_equal(found.action_latency, 2)
    np.testing.assert_array_equal(found.observation_latency, 0)


# --- wheels


def test_the_wheels_of_a_robot_are_alike() -> None:
    radius = np.asarray(_draw(_realism(wheel_radius=(0.0198, 0.0207))).wheel_radius)
    np.testing.assert_array_equal(radius[..., 0], radius[..., 1])
    assert len(np.unique(radius)) > 40_000  # of 50,000 robots


def test_no_draw_exceeds_the_largest_wheels() -> None:
    assert factors.largest(ROBOT, RealismConfig()).wheel_radius == ROBOT.wheel_radius
    wide = factors.largest(ROBOT, _realism(wheel_radius=(0.0198, 0.0207)))
    assert wide == dataclasses.replace(ROBOT, wheel_radius=0.0207, wheel_limit="clip")


# --- independence


def test_robots_sensors_axes_and_factors_know_nothing_of_each_other(drawn: Factors) -> None:
    # Each number of an episode has a column.
    parts = [np.asarray(drawn.wheel_radius)[..., 0].astype(float)]
    parts += [
        getattr(drawn, name).astype(float)
        for name in Factors._fields
        if name not in ("seed", "wheel_radius")
    ]
    columns = np.concatenate([part.reshape(len(SEEDS), -1) for part in parts], axis=-1)
    correlation = np.corrcoef(columns.T)
    pairs = np.abs(correlation[np.triu_indices(len(correlation), 1)])
    assert len(pairs) > 20_000
    # The bound is 6 standard errors of 1 / sqrt(n). The largest of 22,000 exceeds it with
    # probability 5e-5.
    assert pairs.max() < 6.0 / math.sqrt(len(SEEDS))


def test_the_seed_fixes_an_episode(drawn: Factors) -> None:
    again = _draw(ALL)
    jax.tree.map(np.testing.assert_array_equal, again, drawn)
    assert len(np.unique(np.asarray(drawn.track)[:, 0])) > 0.99 * len(SEEDS)
