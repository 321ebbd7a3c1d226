"""The diagonal Gaussian of actions. B stands for any number of leading axes, U for the action."""

import math

import chex
import jax
import jax.numpy as jnp


def beyond_range(mean: jax.Array) -> jax.Array:
    """Computes how far a mean action lies beyond the range of commands.

    Args:
      mean: [B, U], -1..1 spans the commands.

    Returns:
      [B, U]: 0 within the range, negative below it, positive above it.
    """
    return mean - jnp.clip(mean, -1.0, 1.0)


def log_prob(mean: jax.Array, std: jax.Array, action: jax.Array) -> jax.Array:
    """Computes the log density of actions under a diagonal Gaussian.

    Args:
      mean: [B, U].
      std: [U], above 0.
      action: [B, U], as drawn, before any clipping.

    Returns:
      The log density summed over U, [B].
    """
    chex.assert_equal_shape([mean, action])
    chex.assert_shape(std, mean.shape[-1:])
    standardised = (action - mean) / std
    log_density = -0.5 * standardised**2 - jnp.log(std) - 0.5 * math.log(2.0 * math.pi)
    return jnp.sum(log_density, axis=-1)


def entropy(std: jax.Array) -> jax.Array:
    """Computes the differential entropy of a diagonal Gaussian.

    Args:
      std: [U], above 0.

    Returns:
      The entropy in nats, [].
    """
    chex.assert_rank(std, 1)
    return jnp.sum(jnp.log(std) + 0.5 * math.log(2.0 * math.pi * math.e))
