"""The optimiser of a run, and its learning rates."""

import optax

from swarmjax.ppo.config import AlgoConfig

# Numbers for `learning_rates`. Runs of 128 to 8,192 arenas ended well if the sum of their learning
# rates over all gradient steps was as large as the sum over 6,000 to 15,000 steps whose rates fall
# from 3e-4 to 0. Runs with larger sums ended worse (docs/results.md, "Why more training made the
# swarm worse").
_RATES = {"actor": 3e-4, "critic": 1e-3}
_FULL_RATE_STEPS = 15_000
# Mean over the run of the factor by which a schedule multiplies a learning rate.
_MEAN_OF_SCHEDULE = {"constant": 1.0, "linear": 0.5}


def gradient_steps(config: AlgoConfig, updates: int) -> int:
    """Counts the gradient steps of a run, including those without a valid sample.

    Args:
      config: Gives the passes over each rollout, and the minibatches of each pass.
      updates: Number of updates of the whole run.
    """
    return updates * config.epochs * config.num_minibatches


def learning_rates(config: AlgoConfig, updates: int) -> dict[str, float]:
    """Chooses the learning rates that a run begins with.

    A rate that is null in the config becomes its value in `_RATES` times a share of at most 1. The
    share limits the sum of the rates over all steps of the run. The limit is the sum over
    `_FULL_RATE_STEPS` steps whose rates fall linearly from that value to 0.

    Args:
      config: Learning rates, each None if this function is to choose it, and their schedule.
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
    """Makes the optimiser: it clips the norm of all gradients, then Adam updates each network.

    Args:
      config: Learning rates, their schedule, and the norm at which gradients are clipped.
      updates: Number of updates of the whole run, over which a linear schedule falls to 0.

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
