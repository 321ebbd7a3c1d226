"""Checks Monte-Carlo returns against sums by hand and against NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.ppo.batch import normalize, sum_back

REWARD = np.array([1.0, 2.0, 4.0, 8.0, 16.0], np.float32)


def _returns(ends: list[int]) -> list[float]:
    boundary = np.isin(np.arange(5), ends)
    return sum_back(jnp.asarray(REWARD), jnp.asarray(boundary), 0.5).tolist()


def test_returns_by_hand() -> None:
    # Powers of two and their halves are exact. The returns end as if nothing followed step 4.
    assert _returns([]) == [5.0, 8.0, 12.0, 16.0, 16.0]
    # With an end at step 1, the returns of steps 0 and 1 leave out all later rewards.
    assert _returns([1]) == [2.0, 2.0, 12.0, 16.0, 16.0]
    # An end at the last step changes nothing, since no reward follows.
    assert _returns([1, 4]) == _returns([1])


def test_nothing_passes_a_boundary_not_even_nan() -> None:
    spoilt = REWARD.copy()
    spoilt[2:] = np.nan
    boundary = np.array([False, True, False, False, False])
    found = sum_back(jnp.asarray(spoilt), jnp.asarray(boundary), 0.5)
    assert found[:2].tolist() == [2.0, 2.0]


def test_arenas_keep_apart() -> None:
    reward = np.stack([REWARD, 3 * REWARD], axis=-1)
    boundary = np.zeros((5, 2), bool)
    boundary[1, 1] = True
    found = sum_back(jnp.asarray(reward), jnp.asarray(boundary), 0.5)
    assert found[:, 0].tolist() == _returns([])
    assert found[:, 1].tolist() == [3 * x for x in _returns([1])]


def _normalize(returns: np.ndarray, valid: np.ndarray) -> np.ndarray:
    values = jnp.asarray(returns, jnp.float32)
    return np.asarray(normalize(values, jnp.asarray(valid), ddof=1, epsilon=1e-7))


def test_returns_are_normalised_over_the_valid_samples() -> None:
    random = np.random.default_rng(0)
    returns = random.normal(3.0, 2.0, (50, 4))
    valid = random.random((50, 4)) < 0.6
    returns[~valid] = 1e6
    found = _normalize(returns, valid)
    inside = returns[valid]
    expected = (inside - inside.mean()) / (inside.std(ddof=1) + 1e-7)
    # float32 rounding of values around 3, with a deviation of 2.
    np.testing.assert_allclose(found[valid], expected, atol=2e-6)


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_samples_give_no_nan(count: int) -> None:
    valid = np.arange(3) < count
    found = _normalize(REWARD[:3], valid)
    assert np.isfinite(found).all()
    assert not found[:count].any()
