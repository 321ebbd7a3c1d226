"""Rewards that a team shares, `algo.team_reward`.

A robot learns from a mix of its own reward and the mean reward of its arena. Such a mix is the
"team spirit" of Berner et al. 2019, "Dota 2 with Large Scale Deep Reinforcement Learning".

With `task.arrival=latch` a robot that arrives stops, and its samples end. But where it stands may
help or hinder the others, so it must learn from what they earn later. Other methods keep such
agents in the batch, or ignore their inputs in the critic (Cohen et al. 2021, "On the Use and Misuse
of Absorbing States in Multi-agent Reinforcement Learning"). Here the critic's values of the others
give what an arrived robot will still be paid. No samples of robots that stand still are needed.
"""

import jax.numpy as jnp
from jax import Array


def share(reward: Array, present: Array, part: float) -> Array:
    """Mixes each robot's reward with the mean reward of its arena.

    Args:
      reward: [..., R] each robot's own reward; 0 for robots that have arrived.
      present: [..., R] whether the robot is present, bool.
      part: weight of the mean, 0..1.

    Returns:
      [..., R] (1 - part) reward + part mean.
    """
    total = jnp.sum(jnp.where(present, reward, 0.0), axis=-1, keepdims=True)
    return (1.0 - part) * reward + part * total / _count(present)


def still_paid(value: Array, under_way: Array, present: Array, part: float) -> Array:
    """Returns what a robot that has arrived will still be paid, while the others go on.

    Let u be the expected return of a robot's own rewards; it is 0 for a robot that has arrived.
    Then the value of a robot under way is v = (1 - part) u + part sum(u) / n, in an arena of n
    robots. Summed over the k robots under way, sum(v) = (1 - part + part k / n) sum(u). An arrived
    robot will be paid part sum(u) / n.

    Args:
      value: [..., R] the critic's values, trained on shared rewards.
      under_way: [..., R] whether the robot is present and has not arrived, bool.
      present: [..., R] whether the robot is present, bool.
      part: weight of the mean reward, 0..1.

    Returns:
      [..., 1] expected return; 0 if no robot is under way.
    """
    left = jnp.sum(under_way, axis=-1, keepdims=True)
    total = jnp.sum(jnp.where(under_way, value, 0.0), axis=-1, keepdims=True)
    robots = _count(present)
    own = total / jnp.where(left > 0, 1.0 - part + part * left / robots, 1.0)
    return part * own / robots


def _count(present: Array) -> Array:
    """Returns the number of robots of each arena, [..., 1], at least 1."""
    return jnp.maximum(jnp.sum(present, axis=-1, keepdims=True), 1)
