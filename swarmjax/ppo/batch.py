"""From the trajectory of a rollout to the samples of an update: advantages and returns.

T stands for control steps, A for arenas, N for the robots of an arena that one learner drives. An
arena's samples form a group, which minibatches do not split.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from swarmjax.ppo import gae, monte_carlo
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.memory import NO_MEMORY, Recall
from swarmjax.shards import ALONE, Shards


class Trajectory(NamedTuple):
    """A learner's observations and actions and their results, [T, A, N, ...].

    Attributes:
      observation: [.., O], raw.
      action: [.., U].
      log_prob: of the action.
      value: of the observation.
      next_value: value of the observation after the step, before any reset.
      reward: of the step.
      terminated: whether nothing more can be earned after the step.
      truncated: whether the time ran out with the step.
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

    Attributes:
      observation: [G, N, O], raw.
      action: [G, N, U], as drawn.
      log_prob: [G, N], of the action under the policy that drew it.
      advantage: [G, N]. With `config.normalize_advantages`, the update normalises the advantages
        over the valid samples, unless the advantages come from Monte-Carlo returns, which are
        normalised already.
      return_: [G, N], target of the critic.
      valid: [G, N], bool or 0/1.
      memory: [G, S, H], memory of the S robots of a group before the rollout; () each without
        memory. With memory, the N samples of a group are ordered by step, [T S].
      begins: [G, N], whether an episode begins with the step; () without memory.
      state: [G, N, P], numbers of order 1 that the critic sees in addition; () if there are none.
    """

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    return_: jax.Array
    valid: jax.Array
    memory: Recall = NO_MEMORY
    begins: Any = ()
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
      memory: [A, N, H], memory before the rollout; () each without memory.
      over: [T, A], whether an arena's episode ended with the step.
      config: defines the return.
      shards: how the arenas are spread over devices.

    Returns:
      A groups with T * N samples.
    """
    estimate = {"gae": _bootstrapped, "monte_carlo": _monte_carlo}[config.advantage]
    advantages, returns = estimate(trajectory, config, shards)

    def group(x: jax.Array) -> jax.Array:
        x = jnp.moveaxis(x, 0, 1)
        return x.reshape(x.shape[0], -1, *x.shape[3:])

    begins = ()
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


def value_loss(batch: Batch, over: jax.Array) -> jax.Array:
    """Computes the positive value loss of each episode, over its transitions in a rollout.

    Args:
      batch: [L] batches, each of A groups with T N samples.
      over: [T, A], whether an arena's episode ended with the step.

    Returns:
      [T, A] mean of max(advantage, 0) over the transitions since the last end of an episode.
    """
    steps = over.shape[0]

    def by_step(x: jax.Array) -> jax.Array:
        return jnp.sum(x.reshape(*x.shape[:2], steps, -1), axis=(0, 3)).T

    positive = by_step(jnp.where(batch.valid, jnp.maximum(batch.advantage, 0.0), 0.0))
    valid = by_step(batch.valid.astype(jnp.float32))

    def step(sums: tuple[jax.Array, jax.Array], now: tuple[jax.Array, ...]) -> Any:
        total, count = sums[0] + now[0], sums[1] + now[1]
        going_on = jnp.where(now[2], 0.0, total), jnp.where(now[2], 0.0, count)
        return going_on, total / jnp.maximum(count, 1.0)

    none = jnp.zeros_like(positive[0])
    return jax.lax.scan(step, (none, none), (positive, valid, over))[1]


def _bootstrapped(
    trajectory: Trajectory, config: AlgoConfig, _: Shards
) -> tuple[jax.Array, jax.Array]:
    """Returns the advantages and returns of generalised advantage estimation."""
    terminated = trajectory.terminated
    if config.time_out == "terminal":
        terminated = terminated | _timed_out(trajectory)
    return gae.generalized_advantages(
        trajectory.reward,
        trajectory.value,
        trajectory.next_value,
        terminated,
        trajectory.truncated,
        discount=config.discount,
        gae_lambda=config.gae_lambda,
    )


def _monte_carlo(
    trajectory: Trajectory, config: AlgoConfig, shards: Shards
) -> tuple[jax.Array, jax.Array]:
    """Returns the normalised Monte-Carlo returns less the values, and the returns themselves."""
    boundary = trajectory.terminated | trajectory.truncated
    if config.time_out == "leak":
        boundary = boundary & ~_timed_out(trajectory)
    returns = monte_carlo.monte_carlo_returns(trajectory.reward, boundary, discount=config.discount)
    normal = monte_carlo.normalize(returns, trajectory.valid, shards)
    return normal - trajectory.value, normal


def _timed_out(trajectory: Trajectory) -> jax.Array:
    """Tells where the step limit ended episodes. Steps whose physics broke are not valid."""
    return trajectory.truncated & trajectory.valid
