"""One gradient step: the PPO loss of a minibatch, and the optimiser's step along its gradient.

A minibatch has B samples. Invalid samples are finite and do not affect the loss. Actions are
sampled from a diagonal Gaussian; U is the size of an action.
"""

import math
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax

from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.networks import Acted, Networks, Params
from swarmjax.shards import ALONE, Shards

Metrics = dict[str, jax.Array]
Progress = tuple[Params, optax.OptState]

# Weight of the bound term. With a weight of 1, robots that blocked each other did so for ever
# (docs/results.md, "Why more training made the swarm worse").
BOUND_COST = 1500.0
# Weight of the guess term, the error of the actor's guess of the state that the critic sees. Five
# policies trained with this term solved 98.1 % of the levels of `worlds`; policies trained without
# this term solved 97.3 %.
GUESS_COST = 0.02


class Learning(NamedTuple):
    """What every way of computing an update needs.

    Attributes:
      config: settings of PPO.
      networks: actor and critic.
      optimizer: the optimiser that `optimizer.make` made.
      shards: how the samples are spread over devices.
      side_by_side: how many learners a device trains at once.
    """

    config: AlgoConfig
    networks: Networks
    optimizer: optax.GradientTransformation
    shards: Shards = ALONE
    side_by_side: int = 1


def ppo_loss(
    params: Params,
    minibatch: Batch,
    networks: Networks,
    config: AlgoConfig,
    expected_valid: jax.Array,
) -> tuple[jax.Array, Metrics]:
    """Computes the loss to minimise.

    The loss is policy + value_cost * value - entropy_cost * entropy + BOUND_COST * bound. If the
    critic sees the state, GUESS_COST * guess is added.

    The policy term is the clipped surrogate of Schulman et al. 2017, "Proximal Policy Optimization
    Algorithms", equation 7, negated.

    The value term is half the squared error against the return. The value term is not clipped,
    because clipping hurts (Andrychowicz et al. 2021, "What Matters in On-Policy Reinforcement
    Learning?", section 3.4).

    The bound term is the squared distance of the mean action from -1..1, summed over the action.
    This term follows `bounds_loss` of rl_games, where the range ends at 1.1. If the mean lies
    several standard deviations beyond the range, all sampled actions have the same effect, and the
    policy learns nothing from them.

    The guess term is the squared error of the actor's guess of the state, summed over its numbers.

    Each term is a sum over the valid samples divided by `expected_valid`. Every valid sample of a
    batch then has the same weight, even if the minibatches are filled unevenly. The mean of
    a term over the minibatches is exactly its mean over the valid samples of the batch.

    Args:
      params: Parameters of the actor and the critic.
      minibatch: Samples, with normalised observations.
      networks: Actor and critic.
      config: Clip range and costs.
      expected_valid: [], valid samples of the whole batch / number of minibatches; a value below 1
        is used as 1.

    Returns:
      The loss [] and its parts before their costs, each [] and divided by `expected_valid` as
      described: `policy_loss`, `value_loss`, `bound_loss`, `entropy` (nats), `approx_kl` (nats, at
      least 0), `clip_fraction` (0..1) and, if the critic sees the state, `guess_loss`.
    """
    vectors = (minibatch.observation, minibatch.action)
    numbers = (minibatch.log_prob, minibatch.advantage, minibatch.return_, minibatch.valid)
    chex.assert_rank([*vectors, *numbers], [2, 2, 1, 1, 1, 1])
    metrics = _terms(*evaluate(params, networks, minibatch), minibatch, config, expected_valid)
    total = (
        metrics["policy_loss"]
        + config.value_cost * metrics["value_loss"]
        - config.entropy_cost * metrics["entropy"]
        + BOUND_COST * metrics["bound_loss"]
    )
    if "guess_loss" in metrics:
        total = total + GUESS_COST * metrics["guess_loss"]
    return total, metrics


def _terms(
    acted: Acted,
    value: jax.Array,
    minibatch: Batch,
    config: AlgoConfig,
    expected_valid: jax.Array,
) -> Metrics:
    """Returns the terms of the loss, before they are weighted by their costs."""
    valid = minibatch.valid.astype(bool)

    def mean(samples: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(valid, samples, 0.0)) / jnp.maximum(expected_valid, 1.0)

    log_prob = log_density(acted.mean, acted.std, minibatch.action)
    # Masked before exp: an overflow there would turn the masked zero gradient into NaN.
    log_ratio = jnp.where(valid, log_prob - minibatch.log_prob, 0.0)
    ratio = jnp.exp(log_ratio)
    metrics = {
        "policy_loss": -mean(_clipped_surrogate(ratio, minibatch.advantage, config.clip_epsilon)),
        "value_loss": mean(0.5 * (value - minibatch.return_) ** 2),
        "bound_loss": mean(jnp.sum(beyond_range(acted.mean) ** 2, axis=-1)),
        "entropy": mean(entropy(acted.std)),
        # Unbiased and never negative: Schulman 2020, "Approximating KL Divergence", estimator k3.
        "approx_kl": mean(ratio - 1.0 - log_ratio),
        "clip_fraction": mean(jnp.abs(ratio - 1.0) > config.clip_epsilon),
    }
    if config.critic == "state":
        error = acted.guess - minibatch.state
        metrics["guess_loss"] = mean(jnp.sum(error**2, axis=-1))
    return metrics


def evaluate(params: Params, networks: Networks, minibatch: Batch) -> tuple[Acted, jax.Array]:
    """Runs actor and critic on samples, step by step if there is a memory; returns both outputs."""
    seen, state, memory = minibatch.observation, minibatch.state, minibatch.memory
    begins = minibatch.begins
    if begins is not None:
        begins = begins.reshape(-1, memory.actor.shape[0])
        seen, state = jax.tree.map(lambda x: x.reshape(*begins.shape, -1), (seen, state))
    acted = networks.act(params, seen, memory.actor, begins)
    value, _ = networks.value(params, seen, state, memory.critic, begins)
    mean, guess = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), (acted.mean, acted.guess))
    return acted._replace(mean=mean, guess=guess), value.reshape(-1)


def _clipped_surrogate(ratio: jax.Array, advantage: jax.Array, clip: float) -> jax.Array:
    clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    return jnp.minimum(ratio * advantage, clipped * advantage)


def beyond_range(mean: jax.Array) -> jax.Array:
    """Computes how far a mean action lies beyond the range of commands.

    Args:
      mean: [B, U]; -1..1 is the range of commands.

    Returns:
      [B, U]: 0 within the range, negative below it, positive above it.
    """
    return mean - jnp.clip(mean, -1.0, 1.0)


def log_density(mean: jax.Array, std: jax.Array, action: jax.Array) -> jax.Array:
    """Computes the log density of actions under a diagonal Gaussian.

    Args:
      mean: [B, U].
      std: [U], above 0.
      action: [B, U], as sampled, before any clipping.

    Returns:
      The log density summed over U, [B].
    """
    chex.assert_equal_shape([mean, action])
    chex.assert_shape(std, mean.shape[-1:])
    standardised = (action - mean) / std
    density = -0.5 * standardised**2 - jnp.log(std) - 0.5 * math.log(2.0 * math.pi)
    return jnp.sum(density, axis=-1)


def entropy(std: jax.Array) -> jax.Array:
    """Computes the differential entropy of a diagonal Gaussian.

    Args:
      std: [U], above 0.

    Returns:
      The entropy in nats, [].
    """
    chex.assert_rank(std, 1)
    return jnp.sum(jnp.log(std) + 0.5 * math.log(2.0 * math.pi * math.e))


def take(
    learning: Learning, progress: Progress, found: tuple[Params, Metrics], any_valid: jax.Array
) -> tuple[Progress, Metrics]:
    """Takes a step along a gradient, unless no sample is valid.

    Devices add up their gradients and metrics, and all of them take the same step.

    A step is skipped, and counted, if its gradient or its result is not finite.
    `optax.apply_if_finite` is not enough: it checks the gradient alone, so a broken optimiser state
    would break the parameters. After some skipped steps in a row, `apply_if_finite` also
    takes a step that is not finite.

    Args:
      learning: The optimiser, and how the samples are spread over devices.
      progress: Parameters and the optimiser's state before the step.
      found: The gradient, and the metrics of its loss.
      any_valid: [], whether any sample that the gradient includes is valid.

    Returns:
      Parameters and the optimiser's state after the step, and the metrics of the loss plus
      `grad_norm`, `taken_steps` and `skipped_steps`. In a skipped step all metrics but
      `skipped_steps` are zero.
    """
    params, optimizer_state = progress
    # One sum of all values: on several devices, each sum takes tens of microseconds at any size.
    (gradient, metrics), devices = learning.shards.sum((found, any_valid.astype(jnp.float32)))
    any_valid = devices > 0.0
    metrics["grad_norm"] = optax.tree.norm(gradient)
    steps, stepped_state = learning.optimizer.update(gradient, optimizer_state, params)
    stepped = (optax.apply_updates(params, steps), stepped_state)
    finite = jnp.isfinite(metrics["grad_norm"]) & _is_finite(stepped)
    metrics = {name: jnp.where(finite, metric, 0.0) for name, metric in metrics.items()}
    metrics["skipped_steps"] = (any_valid & ~finite).astype(jnp.float32)
    taken = any_valid & finite
    metrics["taken_steps"] = taken.astype(jnp.float32)
    # Adam's momentum would move the parameters even where the gradient is zero.
    return jax.tree.map(lambda new, old: jnp.where(taken, new, old), stepped, progress), metrics


def _is_finite(tree: Any) -> jax.Array:
    """Tells whether all numbers of a tree are finite: if one is not, their sum is not either."""
    return jnp.isfinite(sum(jnp.sum(leaf) for leaf in jax.tree.leaves(tree)))


def mean_of_taken(metrics: Metrics) -> Metrics:
    """Averages the metrics over the steps of an update.

    Args:
      metrics: Metrics of the update's steps, any shape, from `take`.

    Returns:
      The means over the steps taken, [], and the number of `skipped_steps`. If no step was taken
      but some were skipped, the means are -inf. If no step was taken or skipped, they are 0.
    """
    taken, skipped = jnp.sum(metrics["taken_steps"]), jnp.sum(metrics["skipped_steps"])
    # This is exactly 1 if all steps of the update were taken.
    share = metrics["taken_steps"].size / jnp.maximum(taken, 1.0)
    # A mean over no steps is -inf and not NaN, because JAX_DEBUG_NANS would stop at a NaN.
    lost = (taken == 0) & (skipped > 0)
    means = {n: jnp.where(lost, -jnp.inf, jnp.mean(x) * share) for n, x in metrics.items()}
    del means["taken_steps"]
    return means | {"skipped_steps": skipped}
