"""A price on contacts between robots that finds its own height: high enough, and no higher.

PPO with a Lagrange multiplier (Ray, Achiam and Amodei 2019, "Benchmarking Safe Exploration in Deep
Reinforcement Learning", section 5: "PPO-Lagrangian") maximises the return less the multiplier
times the cost, and moves the multiplier along what the cost exceeds its limit by. Here it moves at
a bounded pace, the same both ways. Before a swarm has learned anything it has twenty times as many
contacts as it may, afterwards it can have none and still have less than one limit too few: moved
along the excess itself, the price would shoot up at first, robots that learn to stand still would
keep their contacts at 0, and it would take for ever to come down.
"""

import jax
import jax.numpy as jnp
from flax import struct

from swarmjax.config import AlgoConfig

# Share of an update in what is remembered: a rollout of 32 control steps sees a tenth of an episode
# end, and one of few arenas mostly none at all.
_NEW = 0.05


@struct.dataclass(kw_only=True)
class Price:
    """The price, and what it follows.

    Attributes:
        height: [], metres of progress that a contact costs, at least 0.
        contacts: [], running mean of the contacts of an update.
        episodes: [], running mean of the robots' episodes that ended in one.
    """

    height: jax.Array
    contacts: jax.Array
    episodes: jax.Array


def init() -> Price:
    """Begins without a price."""
    return Price(height=jnp.zeros(()), contacts=jnp.zeros(()), episodes=jnp.zeros(()))


def update(
    price: Price, config: AlgoConfig, contacts: jax.Array, episodes: jax.Array, steps: int
) -> Price:
    """Moves the price on.

    Args:
        price: Before.
        config: With a `contact_limit`.
        contacts: [], with other robots in this update, of all robots.
        episodes: [], of robots, that ended in it.
        steps: Control steps of each arena in it.

    Returns:
        The price after: higher by at most `contact_price_rate` for each of the steps if there are
        more contacts an episode than the limit, lower if there are less, but never below 0. Before
        the first episode has ended it stays.
    """
    assert config.contact_limit is not None
    seen = price.contacts + _NEW * (contacts - price.contacts)
    ended = price.episodes + _NEW * (episodes - price.episodes)
    excess = seen / jnp.maximum(ended * config.contact_limit, 1e-9) - 1.0
    pace = jnp.where(ended > 0.0, jnp.clip(excess, -1.0, 1.0), 0.0)
    height = jnp.maximum(price.height + steps * config.contact_price_rate * pace, 0.0)
    return Price(height=height, contacts=seen, episodes=ended)
