"""The exploration schedule: the action's standard deviation falls in steps, as in PPO-PyTorch."""

import jax
import jax.numpy as jnp

from swarmjax.ppo.config import AlgoConfig


def scheduled_stds(config: AlgoConfig) -> tuple[float, ...]:
    """Lists the standard deviations of the schedule, from `initial_std` to the last one.

    Each deviation is the previous one minus `std_decrement`, rounded to four digits. If the result
    is not above `std_floor`, the deviation is `std_floor`, and the list ends.
    `PPO.decay_action_std` of PPO-PyTorch (nikhilbarhate99, commit 728cce8) does the same.

    Args:
      config: Settings with `exploration=scheduled`.

    Returns:
      At least one deviation, in action units.
    """
    stds = [config.initial_std]
    while stds[-1] > config.std_floor:
        lower = round(stds[-1] - config.std_decrement, 4)
        # Rounding can undo a small decrement: PPO-PyTorch's deviation would then never fall.
        if lower == stds[-1]:
            break
        stds.append(max(lower, config.std_floor))
    return tuple(stds)


def scheduled_std(config: AlgoConfig, step: jax.Array) -> jax.Array:
    """Looks up the deviation at a control step.

    Args:
      config: Settings with `exploration=scheduled`.
      step: [...], int32, how many control steps came before this one, at least 0.

    Returns:
      The deviation, [...]: the first of `scheduled_stds` for steps 0 to `std_interval` - 1, the
      second for the next `std_interval` steps, and so on.
    """
    table = jnp.asarray(scheduled_stds(config), dtype=float)
    return table[jnp.minimum(step // config.std_interval, table.shape[0] - 1)]
