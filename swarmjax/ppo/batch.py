"""Turns the trajectory of a rollout into samples of an update, with advantages and returns.

T stands for control steps, A for arenas, N for the robots of an arena that one learner drives. An
arena's samples form a group, which minibatches do not split.
"""

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct

from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.memory import NO_MEMORY, Recall
from swarmjax.shards import ALONE, Shards


class Trajectory(NamedTuple):
    """A learner's observations, actions and rewards in a rollout, [T, A, N, ...].

    Attributes:
      observation: [.., O], raw.
      action: [.., U].
      log_prob: log density of the action.
      value: the critic's value of the observation.
      next_value: value of the observation after the step, before any reset.
      reward: reward for the step.
      terminated: whether no reward can follow the step.
      truncated: whether the step reached the episode's time limit.
      valid: whether to learn from the transition.
      state: [.., P], what the critic sees in addition to the observation; () if nothing.
    """

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    next_value: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    valid: jax.Array
    state: Any = ()


@struct.dataclass(kw_only=True)
class Batch:
    """The samples of one update, in G groups of N. Invalid samples may hold anything, NaN included.

    A minibatch has the same fields, but its samples lie on one axis, [B, ...], and its memories are
    [S, H].

    Attributes:
      observation: [G, N, O], raw.
      action: [G, N, U], as sampled, before any clipping.
      log_prob: [G, N], log density of the action under the policy that sampled it.
      advantage: [G, N]. The update normalises the advantages over the valid samples, unless they
        come from Monte-Carlo returns, which are normalised already.
      return_: [G, N], target of the critic.
      valid: [G, N], bool or 0/1.
      memory: Memories of actor and critic before the rollout, each [G, S, H] for the S robots of a
        group, or () without memory. With memory, the N samples of a group are ordered by step,
        [T S].
      begins: [G, N], whether an episode begins with the step; None without memory.
      state: [G, N, P], numbers of order 1 that the critic sees beside the observation; () if none.
    """

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    return_: jax.Array
    valid: jax.Array
    memory: Recall = NO_MEMORY
    begins: jax.Array | None = None
    state: Any = ()


def make(
    trajectory: Trajectory,
    memory: Recall,
    over: jax.Array,
    config: AlgoConfig,
    shards: Shards = ALONE,
) -> Batch:
    """Turns a rollout into the samples of an update.

    Args:
      trajectory: [T, A, N, ...].
      memory: Memories of actor and critic before the rollout, each [A, N, H], or () without memory.
      over: [T, A], whether an arena's episode ended with the step.
      config: says how to compute advantages and returns.
      shards: how the arenas are spread over devices.

    Returns:
      A batch of A groups, each with T * N samples.
    """
    if config.advantage == "gae":
        advantages, returns = generalized_advantages(
            trajectory.reward,
            trajectory.value,
            trajectory.next_value,
            trajectory.terminated,
            trajectory.truncated,
            discount=config.discount,
            gae_lambda=config.gae_lambda,
        )
    else:
        boundary = trajectory.terminated | trajectory.truncated
        # As in `PPO.update` of PPO-PyTorch (nikhilbarhate99, commit 728cce8), nothing is
        # bootstrapped.
        returns = sum_back(trajectory.reward, boundary, config.discount)
        returns = normalize(returns, trajectory.valid, shards, ddof=1, epsilon=1e-7)
        advantages = returns - trajectory.value

    def group(x: jax.Array) -> jax.Array:
        x = jnp.moveaxis(x, 0, 1)
        return x.reshape(x.shape[0], -1, *x.shape[3:])

    begins = None
    if jax.tree.leaves(memory):
        first = jnp.concatenate([jnp.zeros_like(over[:1]), over[:-1]])
        begins = group(jnp.broadcast_to(first[..., None], trajectory.valid.shape))
    return Batch(
        observation=group(trajectory.observation),
        action=group(trajectory.action),
        log_prob=group(trajectory.log_prob),
        advantage=group(advantages),
        return_=group(returns),
        valid=group(trajectory.valid),
        memory=memory,
        begins=begins,
        state=jax.tree.map(group, trajectory.state),
    )


def generalized_advantages(
    rewards: jax.Array,
    values: jax.Array,
    next_values: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    *,
    discount: float,
    gae_lambda: float,
) -> tuple[jax.Array, jax.Array]:
    """Computes advantages and returns of a rollout; time is the first axis.

    Schulman et al. 2016, "High-Dimensional Continuous Control Using Generalized Advantage
    Estimation", equation 16. The sum is cut at the end of each episode and of the rollout. Values
    after the end of an episode, NaN included, never affect steps before this end.

    Args:
      rewards: [T, ...], reward of step t.
      values: [T, ...], value of the observation before step t.
      next_values: [T, ...], value of the observation after step t, before any reset; ignored
        where `terminated`.
      terminated: [T, ...], bool: the task ended here and no reward can follow.
      truncated: [T, ...], bool: the episode was cut here and would have gone on.
      discount: Per step, 0..1.
      gae_lambda: 0 (one-step temporal difference) .. 1 (Monte Carlo).

    Returns:
      The advantages and the returns (advantage plus value), both [T, ...].
    """
    chex.assert_equal_shape([rewards, values, next_values, terminated, truncated])
    terminated = terminated.astype(bool)
    ends = terminated | truncated.astype(bool)
    errors = rewards + discount * jnp.where(terminated, 0.0, next_values) - values
    advantages = sum_back(errors, ends, discount * gae_lambda)
    return advantages, advantages + values


def sum_back(terms: jax.Array, ends: jax.Array, factor: float) -> jax.Array:
    """Sums discounted terms from each step to the next step in `ends`, or to the rollout's end.

    Args:
      terms: [T, ...], term of step t.
      ends: [T, ...], bool: the sum of step t ends with the term of this step.
      factor: Discount per step, 0..1.

    Returns:
      [T, ...]: the term of each step, plus `factor` times the result of the next step unless the
      step is an end.
    """

    def add(following: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        term, end = step
        total = term + factor * jnp.where(end, 0.0, following)
        return total, total

    return jax.lax.scan(add, jnp.zeros_like(terms[0]), (terms, ends), reverse=True)[1]


def normalize(
    values: jax.Array, valid: jax.Array, shards: Shards = ALONE, *, ddof: int, epsilon: float
) -> jax.Array:
    """Shifts and scales values to mean 0 and deviation 1 over the valid samples.

    Args:
      values: [...].
      valid: [...], bool or 0/1.
      shards: How the samples are spread over devices.
      ddof: The variance is divided by the number of valid samples minus `ddof`.
      epsilon: Added to the deviation.

    Returns:
      The normalised values, [...], including those that are not valid.
    """
    chex.assert_equal_shape([values, valid])
    valid = valid.astype(bool)
    count = shards.sum(jnp.sum(valid))
    mean = shards.sum(jnp.sum(jnp.where(valid, values, 0.0))) / jnp.maximum(count, 1)
    squares = shards.sum(jnp.sum(jnp.where(valid, (values - mean) ** 2, 0.0)))
    return (values - mean) / (jnp.sqrt(squares / jnp.maximum(count - ddof, 1)) + epsilon)
