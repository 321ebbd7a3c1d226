"""Running mean and variance of observations.

Brax's `running_statistics` is unsuitable: importing it loads MuJoCo, MJX and Warp, which this
package does not need. It also divides 0 by 0 if the first batch has no valid sample. That happens
to a learner whose robots are still absent.
"""

import chex
import jax
import jax.numpy as jnp
from flax import struct

from swarmjax.shards import ALONE, Shards

# An observation that has hardly varied yet is magnified by at most 1 / this.
MIN_STD = 1e-3
# Huang et al. 2022, "The 37 Implementation Details of Proximal Policy Optimization",
# continuous-action detail 7: bound of normalised observations.
OBSERVATION_LIMIT = 10.0


@struct.dataclass(kw_only=True)
class Normalizer:
    """Mean and variance of the observations seen so far.

    Attributes:
      count: [], float32, number of observations. Beyond 2**24 it is rounded. This is harmless,
        because the count only weighs a batch against the past, and a relative error of 2**-24 is
        negligible.
      mean: [O].
      variance: [O], of the population; 1 before the first observation.
      rest: [2, O], what rounding to float32 has taken from mean and variance. After a million
        updates, a batch moves them by less than float32 can hold.
    """

    count: jax.Array
    mean: jax.Array
    variance: jax.Array
    rest: jax.Array

    @property
    def std(self) -> jax.Array:
        """Standard deviation to divide by, [O], at least 1e-3."""
        return jnp.maximum(jnp.sqrt(self.variance), MIN_STD)


def init(observation_size: int) -> Normalizer:
    """Returns a new normalizer, which changes nothing yet."""
    return Normalizer(
        count=jnp.zeros((), jnp.float32),
        mean=jnp.zeros((observation_size,), jnp.float32),
        variance=jnp.ones((observation_size,), jnp.float32),
        rest=jnp.zeros((2, observation_size), jnp.float32),
    )


def update(
    normalizer: Normalizer, observation: jax.Array, valid: jax.Array, shards: Shards = ALONE
) -> Normalizer:
    """Adds a batch of observations.

    It merges the moments of two sets as in Chan, Golub and LeVeque 1983, "Algorithms for Computing
    the Sample Variance: Analysis and Recommendations". The batch's own moments take two passes,
    which avoids subtracting large squares.

    Args:
      normalizer: Moments so far.
      observation: [..., O]; may hold anything, NaN included, where not valid.
      valid: [...], bool or 0/1, the observations to count.
      shards: How the observations are spread over devices.

    Returns:
      The moments of all observations; unchanged if none is valid.
    """
    chex.assert_shape(observation, (*valid.shape, *normalizer.mean.shape))
    axes = tuple(range(valid.ndim))
    keep = valid.astype(bool)[..., None]
    batch_count = shards.sum(jnp.sum(keep, dtype=jnp.float32))
    divisor = jnp.maximum(batch_count, 1.0)
    batch_mean = shards.sum(jnp.sum(jnp.where(keep, observation, 0.0), axis=axes)) / divisor
    deviation = jnp.where(keep, observation - batch_mean, 0.0)
    batch_variance = shards.sum(jnp.sum(deviation**2, axis=axes)) / divisor

    count = normalizer.count + batch_count
    share = batch_count / jnp.maximum(count, 1.0)
    shift = batch_mean - normalizer.mean
    spread = batch_variance + (1.0 - share) * shift**2
    # The first batch replaces the variance of 1, from which a small one would lose digits.
    before = jnp.where(share == 1.0, spread, normalizer.variance)
    mean, mean_rest = _add(normalizer.mean, share * shift + normalizer.rest[0])
    variance, variance_rest = _add(before, share * (spread - before) + normalizer.rest[1])
    return Normalizer(
        count=count,
        mean=mean,
        variance=jnp.maximum(variance, 0.0),  # rounding may leave less
        rest=jnp.stack([mean_rest, variance_rest]),
    )


def _add(total: jax.Array, change: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Adds two numbers; also returns what rounding takes from the sum.

    Together, both are exact: Knuth, "The Art of Computer Programming" 2, section 4.2.2, theorem B.
    """
    found = total + change
    taken = found - total
    return found, (total - (found - taken)) + (change - taken)


def normalize(normalizer: Normalizer, observation: jax.Array) -> jax.Array:
    """Shifts and scales observations to mean 0 and standard deviation 1.

    Args:
      normalizer: Moments so far.
      observation: [..., O].

    Returns:
      The normalised observations, [..., O], within plus or minus 10.
    """
    chex.assert_axis_dimension(observation, -1, normalizer.mean.shape[-1])
    scaled = (observation - normalizer.mean) / normalizer.std
    return jnp.clip(scaled, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)
