"""The schedule of the action's deviation: constant for many steps, then one step down."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp

from swarmjax.ppo.config import AlgoConfig


def levels(config: AlgoConfig) -> tuple[float, ...]:
    """Lists the deviations of the schedule, from `initial_std` to where it stays.

    Each is the one before less `std_decrement`, rounded to four digits, and `std_floor` as soon as
    it would not be above that: PPO-PyTorch (nikhilbarhate99, commit 728cce8),
    `PPO.decay_action_std`.

    Args:
        config: With `exploration` scheduled.

    Returns:
        At least one deviation, in action units.
    """
    return tuple(_fall(config))


def _fall(config: AlgoConfig) -> Iterator[float]:
    assert config.std_decrement is not None
    assert config.std_floor is not None
    std = config.initial_std
    yield std
    while std > config.std_floor:
        lower = round(std - config.std_decrement, 4)
        # A decrement that rounding undoes is none: theirs would go on for ever without moving.
        if lower == std:
            return
        std = config.std_floor if lower <= config.std_floor else lower
        yield std


def scheduled_std(config: AlgoConfig, step: jax.Array) -> jax.Array:
    """Looks up with which deviation a control step is made.

    Args:
        config: With `exploration` scheduled.
        step: [...], int32, how many control steps were made before, at least 0.

    Returns:
        The deviation, [...]: the first level for the steps 0 to `std_interval` - 1, and so on.
    """
    assert config.std_interval is not None
    table = jnp.asarray(levels(config), dtype=float)
    return table[jnp.minimum(step // config.std_interval, table.shape[0] - 1)]
