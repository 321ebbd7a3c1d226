"""Monte-Carlo returns, as in PPO-PyTorch (nikhilbarhate99, commit 728cce8, `PPO.update`)."""

import chex
import jax
import jax.numpy as jnp

from swarmjax.shards import ALONE, Shards

_EPSILON = 1e-7  # as in PPO-PyTorch


def monte_carlo_returns(reward: jax.Array, boundary: jax.Array, *, discount: float) -> jax.Array:
    """Sums the discounted rewards from each step to the next boundary, time first.

    Nothing is bootstrapped: the sum ends at a boundary and at the end of the rollout, as if no more
    rewards followed. If an episode ends without a boundary, the return goes on into the next
    episode.

    Args:
      reward: [T, ...], reward of step t.
      boundary: [T, ...], bool: the return of step t ends with the reward of this step.
      discount: Per step, 0..1.

    Returns:
      The returns, [T, ...].
    """
    chex.assert_equal_shape([reward, boundary])

    def accumulate(
        following: jax.Array, step: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        earned, end = step
        total = earned + discount * jnp.where(end, 0.0, following)
        return total, total

    _, returns = jax.lax.scan(
        accumulate, jnp.zeros_like(reward[0]), (reward, boundary.astype(bool)), reverse=True
    )
    return returns


def normalize(returns: jax.Array, valid: jax.Array, shards: Shards = ALONE) -> jax.Array:
    """Shifts and scales returns to mean 0 and deviation 1 over the valid samples.

    The deviation is the unbiased one, which divides by N - 1, plus 1e-7.

    Args:
      returns: [...].
      valid: [...], bool or 0/1.
      shards: How the samples are spread over devices.

    Returns:
      The normalised returns, [...], including those that are not valid.
    """
    chex.assert_equal_shape([returns, valid])
    valid = valid.astype(bool)
    count = shards.sum(jnp.sum(valid))
    mean = shards.sum(jnp.sum(jnp.where(valid, returns, 0.0))) / jnp.maximum(count, 1)
    squares = shards.sum(jnp.sum(jnp.where(valid, (returns - mean) ** 2, 0.0)))
    return (returns - mean) / (jnp.sqrt(squares / jnp.maximum(count - 1, 1)) + _EPSILON)
