"""Tests each term of the reward by hand, and equation 3 of the paper."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.task import reward
from swarmjax.task.config import RewardConfig

RANGE = 0.04  # m
NOTHING = RewardConfig(progress=0.0, proximity=0.0, contact=0.0, step_penalty=0.0)
EQUATION_3 = RewardConfig(proximity=-0.001, contact=0.0, step_penalty=0.0)


@pytest.fixture
def step() -> reward.Step:
    """Returns a step of four robots.

    The first is free. The second has a short ray and a contact. The third has three short rays and
    two contacts, and arrives. The fourth backs off and touches a wall.
    """
    infrared = np.full((4, 8), RANGE, np.float32)
    infrared[1, 2] = 0.039
    infrared[2, :3] = 0.0, 0.01, 0.02
    return reward.Step(
        distance_before=jnp.array([0.5, 0.25, 0.0625, 0.25]),
        distance=jnp.array([0.375, 0.25, 0.03125, 0.5]),
        infrared=jnp.asarray(infrared),
        sensor_range=RANGE,
        arrives=jnp.array([False, False, True, False]),
        contact_begins=jnp.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 0]], bool),
        touching=jnp.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], bool),
        outside=jnp.ones(4, bool),
        path_before=jnp.array([0.75, 0.5, 0.0625, 0.5]),
        path=jnp.array([0.5, 0.625, 0.03125, 0.5]),
    )


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("progress", [0.125, 0.0, 0.03125, -0.25]),  # before - now, exact in binary
        ("path_progress", [0.25, -0.125, 0.03125, 0.0]),
        ("proximity", [0, 1, 1, 0]),  # counted once for all rays; a full ray sees nothing
        ("arrival", [0, 0, 1, 0]),
        ("contact", [0, 1, 2, 0]),
        ("touching", [0, 1, 1, 1]),  # counted once for all kinds, even if no contact begins
        ("step_penalty", [1, 1, 1, 1]),
    ],
)
def test_term_and_its_weight(step: reward.Step, name: str, expected: list[float]) -> None:
    np.testing.assert_array_equal(reward.TERMS[name](step), expected)
    weights = dataclasses.replace(NOTHING, **{name: -4.0})
    np.testing.assert_array_equal(reward.total(step, weights), -4.0 * np.array(expected))


def test_numpy_computes_the_terms_of_jax(step: reward.Step) -> None:
    """Replays give NumPy arrays; all numbers of `step` are exact in float32."""
    weights = RewardConfig(**dict.fromkeys(reward.TERMS, -0.5))
    step = step._replace(outside=jnp.array([True, True, False, True]))
    told = jax.tree.map(np.asarray, step)._replace(sensor_range=RANGE)
    terms, expected = reward.weighted(told, weights), reward.weighted(step, weights)
    for name, term in terms.items():
        assert isinstance(term, np.ndarray)
        np.testing.assert_array_equal(term, expected[name], err_msg=name)


def test_every_weight_has_its_term() -> None:
    assert set(reward.TERMS) == {field.name for field in dataclasses.fields(RewardConfig)} - {
        "extra"
    }


def test_without_its_prices_the_default_is_equation_3(step: reward.Step) -> None:
    expected = np.float32([0.125, -0.001, 0.03125 - 0.001, -0.25])
    # 1e-8 covers one float32 rounding of the sum.
    np.testing.assert_allclose(reward.total(step, EQUATION_3), expected, atol=1e-8)


def test_default_adds_prices_of_contacts_and_time(step: reward.Step) -> None:
    # A contact that begins costs 0.2 m, a control step 0.002 m, and a short ray nothing.
    expected = np.float32([0.123, -0.202, 0.03125 - 0.402, -0.252])
    # 2e-8 covers a few float32 roundings of numbers below 0.3.
    np.testing.assert_allclose(reward.total(step, RewardConfig()), expected, atol=2e-8)


def test_terms_add_up(step: reward.Step) -> None:
    weights = RewardConfig(
        progress=2.0, proximity=-1.0, arrival=8.0, contact=-0.5, step_penalty=-0.25
    )
    # 2 * progress - proximity + 8 * arrival - contact / 2 - 1/4, exact in binary.
    expected = [0.25 - 0.25, -1.0 - 0.5 - 0.25, 0.0625 - 1.0 + 8.0 - 1.0 - 0.25, -0.5 - 0.25]
    np.testing.assert_array_equal(reward.total(step, weights), expected)


def test_no_weight_no_reward(step: reward.Step) -> None:
    np.testing.assert_array_equal(reward.total(step, NOTHING), np.zeros(4))


def test_progress_telescopes() -> None:
    distance = np.random.default_rng(0).uniform(0.0, 1.0, (21, 3)).astype(np.float32)
    none = jnp.zeros((3, 3), bool)
    rest = (jnp.zeros((3, 8)), RANGE, none[0], none, none, none[0])
    total = np.zeros(3)
    for before, now in itertools.pairwise(distance):
        total += reward.progress(reward.Step(jnp.asarray(before), jnp.asarray(now), *rest))
    # 1e-6 m covers twenty float32 differences.
    np.testing.assert_allclose(total, distance[0] - distance[-1], atol=1e-6)
