"""The optimiser, and the step that every way of computing a gradient ends with."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.losses import Metrics
from swarmjax.ppo.networks import Networks, Params
from swarmjax.shards import ALONE, Shards

Progress = tuple[Params, optax.OptState]


class Learning(NamedTuple):
    """What every way of computing an update uses.

    Attributes:
      config: settings of PPO.
      networks: actor and critic.
      optimizer: the optimiser that `make` made.
      shards: how the samples are spread over devices.
      side_by_side: how many learners a device trains at once.
    """

    config: AlgoConfig
    networks: Networks
    optimizer: optax.GradientTransformation
    shards: Shards = ALONE
    side_by_side: int = 1


# The rule of `learning_rates`. Runs of 128 to 8,192 arenas ended well if the sum of their rates
# over all gradient steps equalled that of 6,000 to 15,000 steps whose rates fall from 3e-4 to 0.
# Larger sums ended worse (docs/results.md, "Why more training made the swarm worse").
_RATES = {"actor": 3e-4, "critic": 1e-3}
_FULL_RATE_STEPS = 15_000
# Mean over the run of the factor that a schedule applies to a rate.
_MEAN_OF_SCHEDULE = {"constant": 1.0, "linear": 0.5}


def gradient_steps(config: AlgoConfig, updates: int) -> int:
    """Counts the gradient steps of a run, including those without a valid sample.

    Args:
      config: Passes over each rollout, and minibatches of each pass.
      updates: Number of updates of the whole run.
    """
    return updates * config.epochs * config.num_minibatches


def learning_rates(config: AlgoConfig, updates: int) -> dict[str, float]:
    """Chooses the learning rates that a run begins with.

    A rate that is null in the config becomes its value in `_RATES` times a share of at most 1. The
    share limits the sum of the rates over the run. The limit is the sum over `_FULL_RATE_STEPS`
    steps whose rates fall linearly to 0.

    Args:
      config: Learning rates, or None for the rule; their schedule.
      updates: Number of updates of the whole run.

    Returns:
      The rate of the `actor` and of the `critic`.
    """
    mean = _MEAN_OF_SCHEDULE[config.learning_rate_schedule]
    most = _FULL_RATE_STEPS * _MEAN_OF_SCHEDULE["linear"]
    share = min(1.0, most / max(1.0, mean * gradient_steps(config, updates)))
    given = {"actor": config.actor_learning_rate, "critic": config.critic_learning_rate}
    return {name: _RATES[name] * share if rate is None else rate for name, rate in given.items()}


def make(config: AlgoConfig, updates: int) -> optax.GradientTransformation:
    """Makes the optimiser: one clip over all gradients, if any, then Adam for each network.

    Args:
      config: Learning rates, their schedule, and the norm at which gradients are clipped.
      updates: Number of updates of the whole run: the learning rate's horizon.

    Returns:
      An optimiser for `{"actor": .., "critic": ..}`.
    """
    rates, steps = learning_rates(config, updates), gradient_steps(config, updates)

    def adam(learning_rate: float) -> optax.GradientTransformation:
        schedule = {
            "constant": optax.constant_schedule(learning_rate),
            "linear": optax.linear_schedule(learning_rate, 0.0, steps),
        }[config.learning_rate_schedule]
        return optax.adam(schedule, eps=config.adam_epsilon)

    adams = optax.partition(
        {name: adam(rate) for name, rate in rates.items()},
        {"actor": "actor", "critic": "critic"},
    )
    if config.max_grad_norm is None:
        return adams
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adams)


def take(
    learning: Learning, progress: Progress, found: tuple[Params, Metrics], any_valid: jax.Array
) -> tuple[Progress, Metrics]:
    """Takes a step along a gradient, unless no sample is valid.

    Devices add up their gradients and metrics, and take the same step.

    A step is skipped, and counted, if its gradient or its result is not finite.
    `optax.apply_if_finite` is not enough: it checks the gradient alone, so a broken optimiser state
    would break the parameters. After some skipped steps it also takes a step that is not finite.

    Args:
      learning: The optimiser, and how the samples are spread over devices.
      progress: Parameters and the optimiser's state before.
      found: The gradient, and the metrics of its loss.
      any_valid: [], whether the gradient includes a valid sample.

    Returns:
      Parameters and the optimiser's state after, and the metrics with `grad_norm`, `taken_steps`
      and `skipped_steps`. In a skipped step all metrics but `skipped_steps` are zero.
    """
    params, optimizer_state = progress
    # One sum for all: on several devices each sum takes tens of microseconds, whatever its size.
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
      but some were skipped, the means are -inf. If none was skipped either, the means are 0.
    """
    taken, skipped = jnp.sum(metrics["taken_steps"]), jnp.sum(metrics["skipped_steps"])
    # Exactly 1 if all steps of the update were taken.
    share = metrics["taken_steps"].size / jnp.maximum(taken, 1.0)
    # Not NaN: JAX_DEBUG_NANS would take it for a mistake.
    lost = (taken == 0) & (skipped > 0)
    means = {n: jnp.where(lost, -jnp.inf, jnp.mean(x) * share) for n, x in metrics.items()}
    del means["taken_steps"]
    return means | {"skipped_steps": skipped}
