"""Checks advantages against values by hand, against a NumPy loop, and at lambda 0 and 1."""

import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.ppo.batch import generalized_advantages

T, B = 12, 7
Rollout = dict[str, np.ndarray]


def _rollout(seed: int = 0, end_share: float = 0.2) -> Rollout:
    random = np.random.default_rng(seed)
    terminated = random.random((T, B)) < end_share
    return {
        "rewards": random.normal(size=(T, B)).astype(np.float32),
        "values": random.normal(size=(T, B)).astype(np.float32),
        "next_values": random.normal(size=(T, B)).astype(np.float32),
        "terminated": terminated,
        "truncated": (random.random((T, B)) < end_share) & ~terminated,
    }


def _loop(rollout: Rollout, discount: float, gae_lambda: float) -> np.ndarray:
    """Returns the advantages of equation 16 of the GAE paper, summed step by step in float64."""
    advantages = np.zeros((T, B))
    for robot in range(B):
        for start in range(T):
            weight = 1.0
            for t in range(start, T):
                bootstrap = 0.0 if rollout["terminated"][t, robot] else discount
                error = (
                    rollout["rewards"][t, robot]
                    + bootstrap * rollout["next_values"][t, robot]
                    - rollout["values"][t, robot]
                )
                advantages[start, robot] += weight * error
                if rollout["terminated"][t, robot] or rollout["truncated"][t, robot]:
                    break
                weight *= discount * gae_lambda
    return advantages


@pytest.mark.parametrize(
    ("terminated", "truncated", "expected"),
    [
        # The errors are r + 0.5 V' - V; a step adds 0.5 * 0.5 = 0.25 of the next advantage.
        # Without an end, the errors are 1 + 2 - 2 = 1, 0 + 3 - 4 = -1 and 4 + 4 - 6 = 2;
        # A2 = 2, A1 = -1 + 0.25 * 2 = -0.5, A0 = 1 - 0.25 * 0.5 = 0.875.
        ([0, 0, 0], [0, 0, 0], [0.875, -0.5, 2.0]),
        # Terminated at step 1: its error is 0 - 4 = -4, and it adds nothing of A2;
        # A0 = 1 - 0.25 * 4 = 0.
        ([0, 1, 0], [0, 0, 0], [0.0, -4.0, 2.0]),
        # Truncated at step 1: its error is -1 with its bootstrap, and it adds nothing of A2;
        # A0 = 1 - 0.25 = 0.75.
        ([0, 0, 0], [0, 1, 0], [0.75, -1.0, 2.0]),
        # Terminated and truncated at step 1: the step counts as terminated.
        ([0, 1, 0], [0, 1, 0], [0.0, -4.0, 2.0]),
    ],
)
def test_three_steps_by_hand(
    terminated: list[int], truncated: list[int], expected: list[float]
) -> None:
    values = np.array([2.0, 4.0, 6.0], np.float32)
    advantages, returns = generalized_advantages(
        np.array([1.0, 0.0, 4.0], np.float32),
        values,
        np.array([4.0, 6.0, 8.0], np.float32),
        np.array(terminated, bool),
        np.array(truncated, bool),
        discount=0.5,
        gae_lambda=0.5,
    )
    np.testing.assert_array_equal(advantages, expected)
    np.testing.assert_array_equal(returns, np.array(expected) + values)


@pytest.mark.parametrize("seed", range(5))
def test_scan_equals_a_numpy_loop(seed: int) -> None:
    rollout = _rollout(seed)
    advantages, returns = generalized_advantages(**rollout, discount=0.97, gae_lambda=0.9)
    expected = _loop(rollout, 0.97, 0.9)
    # Sums of twelve terms of order 1, in float32 against float64.
    np.testing.assert_allclose(advantages, expected, atol=5e-6)
    np.testing.assert_allclose(returns, expected + rollout["values"], atol=5e-6)


def test_lambda_zero_is_the_one_step_error() -> None:
    rollout = _rollout()
    _, returns = generalized_advantages(**rollout, discount=0.9, gae_lambda=0.0)
    expected = rollout["rewards"] + 0.9 * ~rollout["terminated"] * rollout["next_values"]
    # float32 rounding: the same value is subtracted and added once.
    np.testing.assert_allclose(returns, expected, atol=1e-6)


def test_lambda_one_is_the_discounted_return_whatever_the_values() -> None:
    rollout = _rollout(end_share=0.0)
    rollout["next_values"] = np.concatenate(
        [rollout["values"][1:], np.full((1, B), 2.0, np.float32)]
    )
    _, returns = generalized_advantages(**rollout, discount=0.9, gae_lambda=1.0)
    expected = np.zeros((T, B))
    following = np.full(B, 2.0)
    for t in reversed(range(T)):
        following = rollout["rewards"][t] + 0.9 * following
        expected[t] = following
    # Sums of twelve terms of order 1, in float32 against float64.
    np.testing.assert_allclose(returns, expected, atol=5e-6)


@pytest.mark.parametrize("end", ["terminated", "truncated"])
def test_nothing_after_an_end_reaches_what_is_before_it(end: str) -> None:
    rollout = _rollout(end_share=0.0)
    rollout[end][5] = True
    clean, _ = generalized_advantages(**rollout, discount=0.99, gae_lambda=0.95)
    for name in ("rewards", "values", "next_values"):
        rollout[name][6:] = np.nan
    spoilt, _ = generalized_advantages(**rollout, discount=0.99, gae_lambda=0.95)
    np.testing.assert_array_equal(spoilt[:6], clean[:6])


def test_a_terminated_step_does_not_read_its_next_value() -> None:
    rollout = _rollout()
    clean, _ = generalized_advantages(**rollout, discount=0.99, gae_lambda=0.95)
    rollout["next_values"][rollout["terminated"]] = np.nan
    spoilt, _ = generalized_advantages(**rollout, discount=0.99, gae_lambda=0.95)
    np.testing.assert_array_equal(spoilt, clean)


def test_a_truncated_step_reads_its_next_value() -> None:
    rollout = _rollout(end_share=0.0)
    rollout["truncated"][5] = True
    before, _ = generalized_advantages(**rollout, discount=0.5, gae_lambda=0.95)
    rollout["next_values"][5] += 2.0
    after, _ = generalized_advantages(**rollout, discount=0.5, gae_lambda=0.95)
    # The advantage grows by discount * 2 = 1, up to the rounding of values of order 1.
    np.testing.assert_allclose(after[5] - before[5], np.ones(B), atol=1e-6)


def test_shapes_that_would_broadcast_are_refused() -> None:
    rollout = _rollout()
    rollout["rewards"] = rollout["rewards"][:, :1]
    with pytest.raises(AssertionError):
        generalized_advantages(**rollout, discount=0.99, gae_lambda=0.95)


def test_agrees_with_brax_where_brax_is_right() -> None:
    """Compares with Brax's `vs - values`: Brax's own `advantages` are GAE only if lambda is 1."""
    from brax.training.agents.ppo import losses as brax_losses

    random = np.random.default_rng(3)
    rewards, values = random.normal(size=(2, 12, 5)).astype(np.float32)
    bootstrap = random.normal(size=5).astype(np.float32)
    terminated = random.random((12, 5)) < 0.2
    next_values = np.concatenate([values[1:], bootstrap[None]])
    never = np.zeros_like(terminated)
    targets, _ = brax_losses.compute_gae(
        truncation=jnp.zeros((12, 5)),
        termination=jnp.asarray(terminated, jnp.float32),
        rewards=jnp.asarray(rewards),
        values=jnp.asarray(values),
        bootstrap_value=jnp.asarray(bootstrap),
        lambda_=0.9,
        discount=0.95,
    )
    advantages, returns = generalized_advantages(
        rewards, values, next_values, terminated, never, discount=0.95, gae_lambda=0.9
    )
    # 2e-6: float32 sums of at most twelve terms, added in another order.
    np.testing.assert_allclose(advantages, targets - values, atol=2e-6)
    np.testing.assert_allclose(returns, targets, atol=2e-6)
