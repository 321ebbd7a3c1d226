"""Tests shared rewards against returns that are worked out step by step."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmjax.ppo import team


def test_a_reward_is_mixed_with_the_mean_of_the_robots_that_are_present() -> None:
    reward, present = jnp.array([3.0, -1.0, 0.0, 0.0]), jnp.array([True, True, True, False])
    found = team.share(reward, present, 0.75)
    # The mean of three robots is 2 / 3.
    np.testing.assert_allclose(found[:3], [1.25, 0.25, 0.5], rtol=1e-6)


@pytest.mark.parametrize("part", [0.25, 1.0])
def test_a_team_has_as_much_as_its_robots_earn(part: float) -> None:
    reward, present = jnp.array([3.0, -1.0, 0.5]), jnp.ones(3, bool)
    assert float(team.share(reward, present, part).sum()) == pytest.approx(2.5)


@given(part=st.floats(0.0, 1.0), discount=st.floats(0.5, 1.0), seed=st.integers(0, 2**32 - 1))
def test_what_an_arrived_robot_still_gets_follows_from_the_values_of_the_others(
    part: float, discount: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    arrival = random.integers(0, 6, size=4)  # the step in which each robot arrives
    under_way = np.arange(6)[:, None] <= arrival
    own = np.where(under_way, random.normal(size=(6, 4)), 0.0)
    paid = (1.0 - part) * own + part * own.mean(axis=-1, keepdims=True)
    for now in range(6):
        weight = discount ** np.arange(6 - now)
        value = weight @ paid[now:]  # of all robots, also of those that have arrived
        left = under_way[now]
        present = jnp.ones(4, bool)
        found = team.still_paid(jnp.asarray(value), jnp.asarray(left), present, part)
        arrived = value[~left]
        # 32-bit sums of at most 24 numbers of order 1, divided by at least 1 / 4.
        np.testing.assert_allclose(np.full(arrived.shape, found), arrived, atol=2e-5)


def test_nothing_is_left_once_all_have_arrived() -> None:
    value, under_way = jnp.array([1.0, jnp.nan]), jnp.zeros(2, bool)
    assert team.still_paid(value, under_way, jnp.ones(2, bool), 1.0).tolist() == [0.0]


def test_arenas_are_valued_each_by_itself() -> None:
    value = jnp.array([[1.0, 2.0], [3.0, 5.0]])
    left = jnp.array([[True, False], [True, True]])
    found = team.still_paid(value, left, jnp.ones((2, 2), bool), 0.5)
    # (1 / 0.75) / 4 with one of two robots under way, (8 / 1) / 4 with both.
    np.testing.assert_allclose(found, [[1 / 3], [2.0]], rtol=1e-6)
