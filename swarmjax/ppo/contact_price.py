"""A price on contacts between robots that finds its own height: high enough, and no higher.

PPO with a Lagrange multiplier (Ray, Achiam and Amodei 2019, "Benchmarking Safe Exploration in Deep
Reinforcement Learning", section 5: "PPO-Lagrangian") maximises the return less the multiplier
times the cost, and moves the multiplier along what the cost exceeds its limit by. Two things are
different here. It moves at a bounded pace, the same both ways: before a swarm has learned anything
it has twenty times as many contacts as it may, and afterwards never more than one limit too few, so
that a price that shot up at first would take for ever to come down. And it falls where robots do
not arrive, whatever their contacts: the surest way to have none is to stand still.
"""

from typing import NamedTuple

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
        arrivals: [], running mean of those that ended at the target.
    """

    height: jax.Array
    contacts: jax.Array
    episodes: jax.Array
    arrivals: jax.Array


def init() -> Price:
    """Begins without a price."""
    nothing = jnp.zeros(())
    return Price(height=nothing, contacts=nothing, episodes=nothing, arrivals=nothing)


class Seen(NamedTuple):
    """What an update saw of all robots.

    Attributes:
        contacts: [], with other robots.
        episodes: [], of robots, that ended.
        arrivals: [], of these at the target.
    """

    contacts: jax.Array
    episodes: jax.Array
    arrivals: jax.Array


def update(price: Price, config: AlgoConfig, seen: Seen, steps: int) -> Price:
    """Moves the price on.

    Args:
        price: Before.
        config: With a `contact_limit`.
        seen: In this update.
        steps: Control steps of each arena in it.

    Returns:
        The price after: higher by at most `contact_price_rate` for each of the steps if there are
        more contacts an episode than the limit, lower if there are less, or if less than
        `contact_price_arrivals` of the robots arrive; never below 0. Where nothing was seen, and
        before the first episode has ended, it stays.
    """
    assert config.contact_limit is not None
    before = Seen(price.contacts, price.episodes, price.arrivals)
    contacts, episodes, arrivals = (b + _NEW * (s - b) for b, s in zip(before, seen, strict=True))
    excess = contacts / jnp.maximum(episodes * config.contact_limit, 1e-9) - 1.0
    arrive = arrivals >= config.contact_price_arrivals * episodes
    pace = jnp.where(arrive, jnp.clip(excess, -1.0, 1.0), -1.0)
    rise = steps * config.contact_price_rate * jnp.where(episodes > 0.0, pace, 0.0)
    height = jnp.maximum(price.height + rise, 0.0)
    after = Price(height=height, contacts=contacts, episodes=episodes, arrivals=arrivals)
    any_seen = seen.contacts + seen.episodes > 0.0
    return jax.tree.map(lambda new, old: jnp.where(any_seen, new, old), after, price)
