"""The reward that a team shares, `task.team_reward`.

Each robot's reward is a mix of its own and of the mean over the robots of its arena. PettingZoo's
multi-agent particle environments mix in the same way; there the weight of the own reward is called
`local_ratio` (Terry et al. 2021, "PettingZoo").

With `task.arrival=latch` a robot that arrives stops, and has no further samples to learn from. But
where it stands may help or hinder the others, and a part of what they still earn belongs to it.
This part follows from the values of the others, so that it needs no samples of robots that stand
still.
"""

import jax.numpy as jnp
from jax import Array


def share(reward: Array, present: Array, part: float) -> Array:
    """Mixes each robot's reward with the mean over its arena.

    Args:
      reward: [R] each robot's own reward; 0 for robots that earn nothing any more.
      present: [R] whether the robot is present, bool.
      part: weight of the mean, 0..1.

    Returns:
      [R] (1 - part) reward + part mean.
    """
    mean = jnp.sum(jnp.where(present, reward, 0.0)) / jnp.maximum(jnp.sum(present), 1)
    return (1.0 - part) * reward + part * mean


def still_earned(value: Array, under_way: Array, present: Array, part: float) -> Array:
    """Values the part of an arrived robot in the rewards that the others still earn.

    Let u be the return of a robot's own rewards, 0 for a robot that has arrived. Then the value of
    a robot under way is v = (1 - part) u + part sum(u) / n, in an arena of n robots. Summed over
    the k robots under way, sum(v) = (1 - part + part k / n) sum(u). So an arrived robot's part is
    part sum(u) / n, with sum(u) from the values of the others.

    Args:
      value: [R] values of the robots with shared rewards.
      under_way: [R] whether the robot is present and has not arrived, bool.
      present: [R] whether the robot is present, bool.
      part: weight of the mean in the reward, 0..1.

    Returns:
      [] value of an arrived robot; 0 if no robot is under way.
    """
    robots = jnp.maximum(jnp.sum(present), 1)
    left = jnp.sum(under_way)
    total = jnp.sum(jnp.where(under_way, value, 0.0))
    own = total / jnp.where(left > 0, 1.0 - part + part * left / robots, 1.0)
    return part * own / robots
