"""The optimiser, and the one step that every way of computing a gradient ends in."""

import jax
import jax.numpy as jnp
import optax

from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.losses import Metrics
from swarmjax.ppo.networks import Params

# The metrics of a step: those of `losses.ppo_loss`, and the norm of the gradient before clipping.
METRICS = (
    "approx_kl",
    "bound_loss",
    "clip_fraction",
    "entropy",
    "policy_loss",
    "value_loss",
    "grad_norm",
)

Progress = tuple[Params, optax.OptState]


def make(config: AlgoConfig, updates: int) -> optax.GradientTransformation:
    """Makes the optimiser: one clip over all gradients, if any, then Adam for each network.

    Args:
        config: Learning rates, their schedule, and the norm at which gradients are clipped.
        updates: Number of updates of the whole run: the learning rate's horizon.

    Returns:
        An optimiser of `{"actor": .., "critic": ..}`.
    """
    steps = updates * config.epochs * config.num_minibatches

    def adam(learning_rate: float) -> optax.GradientTransformation:
        schedule = {
            "constant": optax.constant_schedule(learning_rate),
            "linear": optax.linear_schedule(learning_rate, 0.0, steps),
        }[config.learning_rate_schedule]
        return optax.adam(schedule, eps=config.adam_epsilon)

    adams = optax.partition(
        {"actor": adam(config.actor_learning_rate), "critic": adam(config.critic_learning_rate)},
        {"actor": "actor", "critic": "critic"},
    )
    if config.max_grad_norm is None:
        return adams
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adams)


def take(
    config: AlgoConfig,
    updates: int,
    progress: Progress,
    found: tuple[Params, Metrics],
    any_valid: jax.Array,
) -> tuple[Progress, Metrics]:
    """Takes a step along a gradient; none at all if no sample is valid.

    Args:
        config: Of the optimiser.
        updates: As given to `make`.
        progress: Parameters and the optimiser's state before.
        found: The gradient, and the metrics of its loss.
        any_valid: [], whether the gradient is of any valid sample.

    Returns:
        Parameters and the optimiser's state after, and the metrics with `grad_norm`.
    """
    (params, optimizer_state), (gradient, metrics) = progress, found
    metrics["grad_norm"] = optax.tree.norm(gradient)
    steps, stepped_state = make(config, updates).update(gradient, optimizer_state, params)
    stepped = (optax.apply_updates(params, steps), stepped_state)
    # Adam moves by its momentum even where the gradient is zero.
    return jax.tree.map(lambda new, old: jnp.where(any_valid, new, old), stepped, progress), metrics
