"""Checks running moments against NumPy's moments of all valid observations at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.ppo.networks import Normalizer

OBSERVATION = 3


def test_masked_batches_give_the_moments_of_all_valid_observations() -> None:
    random = np.random.default_rng(0)
    state = Normalizer.init(OBSERVATION)
    seen = []
    for size in (5, 40, 3):
        observation = random.normal([10.0, -2.0, 0.0], [0.5, 3.0, 1.0], (size, 4, OBSERVATION))
        valid = random.random((size, 4)) < 0.5
        seen.append(observation[valid])
        observation[~valid] = np.nan
        state = state.update(observation.astype(np.float32), valid)
    expected = np.concatenate(seen)
    assert state.count == len(expected)
    # float32 against float64: means of order 10 have a rounding error of order 1e-6.
    np.testing.assert_allclose(state.mean, expected.mean(axis=0), atol=5e-6)
    np.testing.assert_allclose(state.variance, expected.var(axis=0), rtol=1e-5)


def test_a_batch_without_a_valid_observation_changes_nothing() -> None:
    fresh = Normalizer.init(OBSERVATION)
    used = fresh.update(np.arange(12, dtype=np.float32).reshape(4, OBSERVATION), np.ones(4, bool))
    nothing = np.full((4, OBSERVATION), np.nan, np.float32)
    for state in (fresh, used):
        after = state.update(nothing, np.zeros(4, bool))
        jax.tree.map(np.testing.assert_array_equal, after, state)


def test_small_deviations_on_a_large_offset_keep_their_variance() -> None:
    observation = np.array([[1000.0], [1000.5], [1001.0]], np.float32)
    state = Normalizer.init(1)
    for _ in range(2):
        state = state.update(observation, np.ones(3, bool))
    # Deviations of -0.5, 0 and 0.5 have a variance of 0.5 / 3. The mean rounds at
    # 1000 * 2**-24 = 6e-5, which enters the variance squared.
    np.testing.assert_allclose(state.variance, [0.5 / 3.0], rtol=1e-6)


def test_a_small_variance_of_the_first_batch_keeps_its_digits() -> None:
    observation = np.array([[1e-3], [-1e-3]], np.float32)
    state = Normalizer.init(1).update(observation, np.ones(2, bool))
    np.testing.assert_allclose(state.variance, [1e-6], rtol=1e-6)  # float32


def test_rounding_does_not_add_up() -> None:
    def exact(count: float, mean: float, variance: float) -> tuple[float, float]:
        """Merges the same batch again and again, in float64, with the formula of two sets."""
        for _ in range(updates):
            count += 4.0
            share = 4.0 / count
            variance = (1 - share) * (variance + share * (5.0 - mean) ** 2) + share * 1.25
            mean += share * (5.0 - mean)
        return mean, variance

    updates, past = 100_000, 4e7  # ten million batches of four before
    batch = jnp.array([[3.5], [4.5], [5.5], [6.5]])  # mean 5, variance 1.25
    begun = Normalizer(
        count=jnp.float32(past),
        mean=jnp.array([4.0]),
        variance=jnp.array([9.0]),
        rest=jnp.zeros((2, 1)),
    )

    @jax.jit
    def ended() -> Normalizer:
        def step(state: Normalizer, _: None) -> tuple[Normalizer, None]:
            return state.update(batch, jnp.ones(4, bool)), None

        return jax.lax.scan(step, begun, length=updates)[0]

    mean, variance = exact(past, 4.0, 9.0)
    # Half a unit in the last place of float32, 2^-24, of 4 and of 9.
    np.testing.assert_allclose(ended().mean, [mean], rtol=1e-6)
    np.testing.assert_allclose(ended().variance, [variance], rtol=1e-6)


def test_normalize_is_shift_scale_and_clip() -> None:
    state = Normalizer(
        count=np.float32(9.0),
        mean=np.array([1.0, 0.0, 5.0], np.float32),
        variance=np.array([4.0, 0.25, 0.0], np.float32),
        rest=np.zeros((2, 3), np.float32),
    )
    observation = np.array([[3.0, -9.0, 5.0], [0.0, 0.5, 5.001]], np.float32)
    # Column 3 has variance 0, so it is divided by the smallest allowed deviation, 0.001.
    expected = [[1.0, -10.0, 0.0], [-0.5, 1.0, 1.0]]
    # float32 rounds 5.001 by at most 2**-22, so the result is off by at most
    # 2**-22 / 0.001 = 2.4e-4.
    np.testing.assert_allclose(state.normalize(observation), expected, atol=5e-4)


def test_fresh_normalizer_leaves_observations_as_they_are() -> None:
    observation = np.array([[0.5, -3.0, 9.0]], np.float32)
    np.testing.assert_array_equal(Normalizer.init(OBSERVATION).normalize(observation), observation)


def test_mask_of_another_shape_is_refused() -> None:
    with pytest.raises(AssertionError):
        Normalizer.init(OBSERVATION).update(
            np.zeros((4, 2, OBSERVATION), np.float32),
            np.ones(4, bool),
        )


def test_agrees_with_brax_over_several_batches() -> None:
    from brax.training.acme import running_statistics, specs

    random = np.random.default_rng(5)
    mine = Normalizer.init(3)
    theirs = running_statistics.init_state(specs.Array((3,), jnp.dtype("float32")))
    for scale in (1.0, 3.0, 0.5):
        batch = jnp.asarray(random.normal(scale, scale, (40, 3)), jnp.float32)
        valid = jnp.asarray(random.random(40) < 0.7)
        mine = mine.update(batch, valid)
        theirs = running_statistics.update(theirs, batch, weights=valid.astype(jnp.float32))
    # 1e-5: float32 rounding, since Brax sums squares and this project merges moments.
    np.testing.assert_allclose(mine.mean, np.asarray(theirs.mean), rtol=1e-5)
    np.testing.assert_allclose(mine.std, np.asarray(theirs.std), rtol=1e-5)
