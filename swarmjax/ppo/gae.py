"""Generalised advantage estimation."""

import chex
import jax
import jax.numpy as jnp


def generalized_advantages(
    rewards: jax.Array,
    values: jax.Array,
    next_values: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    *,
    discount: float,
    gae_lambda: float,
) -> tuple[jax.Array, jax.Array]:
    """Computes advantages and returns of a rollout, time first.

    Schulman et al. 2016, "High-Dimensional Continuous Control Using Generalized Advantage
    Estimation", equation 16. The sum is cut at the end of each episode and of the rollout. Values
    after an end, NaN included, never affect steps before it.

    Args:
      rewards: [T, ...], reward of step t.
      values: [T, ...], value of the observation before step t.
      next_values: [T, ...], value of the observation after step t, before any reset; ignored
        where `terminated`.
      terminated: [T, ...], bool: the task ended here and nothing more can be earned.
      truncated: [T, ...], bool: the episode was cut here and would have gone on.
      discount: Per step, 0..1.
      gae_lambda: 0 (one-step temporal difference) .. 1 (Monte Carlo).

    Returns:
      The advantages and the returns (advantage plus value), both [T, ...].
    """
    chex.assert_equal_shape([rewards, values, next_values, terminated, truncated])
    terminated = terminated.astype(bool)
    ends = terminated | truncated.astype(bool)
    errors = rewards + discount * jnp.where(terminated, 0.0, next_values) - values

    def accumulate(
        following: jax.Array, step: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        error, end = step
        advantage = error + discount * gae_lambda * jnp.where(end, 0.0, following)
        return advantage, advantage

    _, advantages = jax.lax.scan(
        accumulate, jnp.zeros_like(errors[0]), (errors, ends), reverse=True
    )
    return advantages, advantages + values
