"""One PPO learner: its state, how it acts and how it learns.

All functions are pure and handle one learner; for L learners, apply `jax.vmap` over state, batch
and key. G stands for groups of samples, N for the samples of a group. Minibatches consist of whole
groups.
"""

import functools
import math
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from swarmjax.config.section import MAX_COUNT
from swarmjax.ppo import dispatch, exploration, losses, networks, normalizer, optimizer
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.dispatch import Backend
from swarmjax.ppo.losses import Metrics, Minibatch
from swarmjax.ppo.memory import Recall
from swarmjax.ppo.networks import Params
from swarmjax.ppo.normalizer import Normalizer
from swarmjax.ppo.optimizer import Progress
from swarmjax.shards import ALONE, Shards

# Huang et al. 2022, "The 37 Implementation Details of Proximal Policy Optimization",
# continuous-action detail 7: bound of normalised observations.
OBSERVATION_LIMIT = 10.0
_ADVANTAGE_EPSILON = 1e-8


@struct.dataclass(kw_only=True)
class LearnerState:
    """The complete state of a learner.

    Attributes:
      params: `{"actor": .., "critic": ..}`.
      optimizer_state: State of the optimiser that `init` made.
      normalizer: Moments of the valid observations of all updates so far. A learner that does not
        normalise keeps the initial moments.
      explored: [], int32, control steps that the schedule of exploration has counted, at most
        2^31 - 1; None if exploration is learned.
    """

    params: Params
    optimizer_state: optax.OptState
    normalizer: Normalizer
    explored: jax.Array | None = None


@struct.dataclass(kw_only=True)
class Batch:
    """The samples of one update. Invalid samples may hold anything, NaN included.

    Attributes:
      observation: [G, N, O], raw.
      action: [G, N, U], as drawn.
      log_prob: [G, N], as `act` returned it.
      advantage: [G, N]. With `config.normalize_advantages`, the update normalises the advantages
        over the valid samples, unless the advantages come from Monte-Carlo returns, which are
        normalised already.
      return_: [G, N], target of the critic.
      valid: [G, N], bool or 0/1.
      memory: [G, S, H], memory of the S robots of a group before the rollout; None without
        memory. The N samples of a group are then ordered by step, [T S].
      begins: [G, N], whether an episode begins with the step; None without memory.
      state: [G, N, P], numbers of order 1 that the critic sees in addition; None if there are none.
    """

    observation: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    return_: jax.Array
    valid: jax.Array
    memory: Recall | None = None
    begins: jax.Array | None = None
    state: jax.Array | None = None


def init(
    key: jax.Array,
    config: AlgoConfig,
    observation_size: int,
    action_size: int,
    updates: int,
    state_size: int = 0,
) -> LearnerState:
    """Makes a new learner.

    Args:
      key: Random key, consumed.
      config: Settings of networks and optimiser.
      observation_size: O.
      action_size: U.
      updates: Number of updates of the whole run, at least 1; the learning rate's schedule spans
        them.
      state_size: P, how many numbers the critic sees in addition.

    Returns:
      The learner's first state.
    """
    params = networks.init_params(key, config, observation_size, action_size, state_size)
    return LearnerState(
        params=params,
        optimizer_state=optimizer.make(config, updates).init(params),
        normalizer=normalizer.init(observation_size),
        explored=jnp.zeros((), jnp.int32) if config.exploration == "scheduled" else None,
    )


def explore(learner: LearnerState, config: AlgoConfig, steps: jax.Array | int) -> LearnerState:
    """Moves a learner along the schedule of exploration, if there is one.

    Args:
      learner: The learner before these steps.
      config: The config that made the learner.
      steps: [], how many control steps follow, at least 1.

    Returns:
      The learner with the deviation of the last of these steps; unchanged if exploration is
      learned.
    """
    if learner.explored is None:
        return learner
    # The count stays at its largest value, since a run may go on from another one's count.
    explored = jnp.minimum(learner.explored, MAX_COUNT - steps) + steps
    std = exploration.scheduled_std(config, explored - 1)
    return replace(_with_log_std(learner, jnp.log(std)), explored=explored)


def explore_anew(learner: LearnerState, config: AlgoConfig) -> LearnerState:
    """Resets the policy's deviation to the initial one, and its schedule to the beginning.

    Args:
      learner: The learner, with any leading axes.
      config: The config that made the learner.

    Returns:
      The learner with the exploration of a new learner.
    """
    begun = _with_log_std(learner, math.log(config.initial_std))
    return replace(begun, explored=jax.tree.map(jnp.zeros_like, learner.explored))


def _with_log_std(learner: LearnerState, log_std: jax.Array | float) -> LearnerState:
    actor = learner.params["actor"]
    actor = actor | {"log_std": jnp.full_like(actor["log_std"], log_std)}
    return replace(learner, params=learner.params | {"actor": actor})


def normalize(learner: LearnerState, observation: jax.Array) -> jax.Array:
    """Normalises raw observations [..., O] for the networks, within +-10."""
    return normalizer.normalize(learner.normalizer, observation, OBSERVATION_LIMIT)


def act(
    learner: LearnerState, config: AlgoConfig, observation: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Draws actions from a policy without memory.

    Args:
      learner: The learner with the policy.
      config: The config that made the learner.
      observation: [..., O], raw.
      noise: [..., U], standard normal.

    Returns:
      The action mean + std * noise, [..., U], unbounded, and its log density, [...].
    """
    return recall_act(learner, config, observation, noise, None)[:2]


def mode(learner: LearnerState, config: AlgoConfig, observation: jax.Array) -> jax.Array:
    """Returns the most likely actions [..., U] of a policy without memory; observations are raw."""
    return recall_mode(learner, config, observation, None)[0]


def values(learner: LearnerState, config: AlgoConfig, observation: jax.Array) -> jax.Array:
    """Returns the values [...] of raw observations, from a critic without memory or state."""
    return recall_values(learner, config, observation, None)[0]


def recall_act(
    learner: LearnerState,
    config: AlgoConfig,
    observation: jax.Array,
    noise: jax.Array,
    memory: jax.Array | None,
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Draws actions from the policy, and updates its memory.

    Args:
      learner: The learner with the policy.
      config: The config that made the learner.
      observation: [..., O], raw.
      noise: [..., U], standard normal.
      memory: [..., H], memory of the actor before; None without memory.

    Returns:
      The action mean + std * noise, [..., U], unbounded, its log density, [...], and the memory
      after.
    """
    seen = normalize(learner, observation)
    mean, std, after = networks.recall_action(learner.params, config, seen, memory)
    chex.assert_equal_shape([mean, noise])
    action = mean + std * noise
    return action, networks.log_prob(mean, std, action), after


def recall_mode(
    learner: LearnerState, config: AlgoConfig, observation: jax.Array, memory: jax.Array | None
) -> tuple[jax.Array, jax.Array | None]:
    """Returns the most likely action, [..., U], and the memory after; arguments as `recall_act`."""
    seen = normalize(learner, observation)
    mean, _, after = networks.recall_action(learner.params, config, seen, memory)
    return mean, after


def recall_values(
    learner: LearnerState,
    config: AlgoConfig,
    observation: jax.Array,
    memory: jax.Array | None,
    state: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array | None]:
    """Computes the critic's values, and updates its memory.

    Args:
      learner: The learner with the critic.
      config: The config that made the learner.
      observation: [..., O], raw.
      memory: [..., H], memory of the critic before; None without memory.
      state: [..., P], numbers of order 1 that the critic sees in addition; None if there are none.

    Returns:
      The expected discounted return, [...], and the memory after.
    """
    seen = networks.critic_input(normalize(learner, observation), state)
    return networks.recall_value(learner.params, config, seen, memory)


def update(
    learner: LearnerState,
    config: AlgoConfig,
    batch: Batch,
    key: jax.Array,
    updates: int,
    backend: Backend = "autodiff",
    shards: Shards = ALONE,
) -> tuple[LearnerState, Metrics]:
    """Learns from one batch: `config.epochs` passes in `config.num_minibatches` steps each.

    The log densities in the batch were computed with the normalizer from before this update. All
    epochs use this normalizer, so that the ratio of new to old density starts at 1. After the
    epochs, the batch's observations are added to the normalizer. A minibatch without a valid sample
    is skipped: it changes neither the parameters nor the learning rate's schedule.

    Args:
      learner: The learner before the update.
      config: The config that made the learner.
      batch: G groups of N samples; `config.num_minibatches` divides G.
      key: Random key, consumed.
      updates: The value given to `init`.
      backend: How to compute the update; `dispatch.resolve` chooses.
      shards: How the groups are spread over devices. All devices reach the same state.

    Returns:
      The state after, and metrics, each []. The metrics of `losses.ppo_loss` and `grad_norm`
      (before clipping) are means over the steps taken. `skipped_steps` counts the steps that were
      not finite. `std` is the policy's mean deviation after the update.
    """
    _check(config, batch, shards)
    counted = batch.valid.astype(bool)
    batch = replace(batch, valid=counted & _is_finite(batch))
    samples = _samples(learner, config, batch, shards)
    begun = (learner.params, learner.optimizer_state)
    learn = dispatch.find(backend) or _learn
    (params, optimizer_state), metrics = learn(config, updates, begun, samples, key, shards)
    # Without a finite sample no step is finite either.
    lost = shards.any(jnp.any(counted)) & ~shards.any(jnp.any(batch.valid))
    metrics["skipped_steps"] = jnp.where(lost, 1.0, metrics["skipped_steps"])
    metrics = optimizer.mean_of_taken(metrics)
    metrics["std"] = jnp.mean(jnp.exp(params["actor"]["log_std"]))
    moments = learner.normalizer
    if config.normalize_observations:
        moments = normalizer.update(moments, batch.observation, batch.valid, shards)
        moments = _leave_neighbours(moments, config)
    learned = replace(learner, params=params, optimizer_state=optimizer_state, normalizer=moments)
    return learned, metrics


def _leave_neighbours(moments: Normalizer, config: AlgoConfig) -> Normalizer:
    """Leaves neighbours' entries unnormalised: they are scaled, and their order must not matter."""
    if config.hearing is None:
        return moments
    heard = slice(config.hearing.first, config.hearing.last)
    return replace(
        moments,
        mean=moments.mean.at[heard].set(0.0),
        variance=moments.variance.at[heard].set(1.0),
    )


def _is_finite(batch: Batch) -> jax.Array:
    """Tells which samples, [G, N], hold only finite numbers."""
    numbers = (batch.log_prob, batch.advantage, batch.return_)
    vectors = [batch.observation, batch.action]
    vectors += [] if batch.state is None else [batch.state]
    found = [jnp.isfinite(x) for x in numbers]
    found += [jnp.all(jnp.isfinite(x), axis=-1) for x in vectors]
    return functools.reduce(jnp.logical_and, found)


def _check(config: AlgoConfig, batch: Batch, shards: Shards) -> None:
    chex.assert_rank([batch.observation, batch.action], 3)
    chex.assert_rank([batch.valid], 2)
    chex.assert_equal_shape([batch.log_prob, batch.advantage, batch.return_, batch.valid])
    chex.assert_equal_shape_prefix([batch.observation, batch.action, batch.valid], 2)
    chex.assert_is_divisible(batch.valid.shape[0], config.num_minibatches * shards.local_streams)


def _samples(learner: LearnerState, config: AlgoConfig, batch: Batch, shards: Shards) -> Minibatch:
    """Prepares samples for the loss, still [G, N, ...]: normalised, and zero where not valid."""
    valid, advantage = batch.valid.astype(bool), batch.advantage
    if config.advantage == "gae" and config.normalize_advantages:
        advantage = _normalize_advantages(advantage, valid, shards)
    samples = Minibatch(
        observation=normalize(learner, batch.observation),
        action=batch.action,
        log_prob=batch.log_prob,
        advantage=advantage,
        return_=batch.return_,
        valid=valid,
        state=batch.state,
    )
    # Otherwise a NaN in an invalid sample would spread through the networks into every gradient.
    masked = jax.tree.map(
        lambda x: jnp.where(valid.reshape(valid.shape + (1,) * (x.ndim - 2)), x, 0), samples
    )
    memory = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x), x, 0.0), batch.memory)
    return replace(masked, memory=memory, begins=batch.begins)


def _normalize_advantages(advantage: jax.Array, valid: jax.Array, shards: Shards) -> jax.Array:
    """Scales advantages to mean 0 and standard deviation 1 over the valid samples, [G, N]."""
    count = jnp.maximum(shards.sum(jnp.sum(valid)), 1)
    mean = shards.sum(jnp.sum(jnp.where(valid, advantage, 0.0))) / count
    variance = shards.sum(jnp.sum(jnp.where(valid, (advantage - mean) ** 2, 0.0))) / count
    return (advantage - mean) / (jnp.sqrt(variance) + _ADVANTAGE_EPSILON)


def _learn(
    config: AlgoConfig,
    updates: int,
    begun: Progress,
    samples: Minibatch,
    key: jax.Array,
    shards: Shards,
) -> tuple[Progress, Metrics]:
    """Runs all epochs, in minibatches; the metrics of each are [epochs, minibatches]."""
    expected_valid = shards.sum(jnp.sum(samples.valid)) / config.num_minibatches
    step = functools.partial(_step, config, updates, expected_valid, shards)
    epoch = functools.partial(_epoch, config, step, samples, shards)
    return jax.lax.scan(epoch, begun, jax.random.split(key, config.epochs))


def _epoch(
    config: AlgoConfig,
    step: functools.partial[tuple[Progress, Metrics]],
    samples: Minibatch,
    shards: Shards,
    progress: Progress,
    key: jax.Array,
) -> tuple[Progress, Metrics]:
    """Runs one pass over all samples. It shuffles whole groups, which are faster to gather."""
    order = _shuffle(key, samples.valid.shape[0], config.num_minibatches, shards)

    def learn(progress: Progress, rows: jax.Array) -> tuple[Progress, Metrics]:
        return step(progress, _gather(samples, rows, config))

    return jax.lax.scan(learn, progress, order)


def _gather(samples: Minibatch, rows: jax.Array, config: AlgoConfig) -> Minibatch:
    """Takes whole groups [G, N, ...] as samples [B, ...], ordered by step if there is a memory."""
    if samples.memory is None:
        return jax.tree.map(lambda x: x[rows].reshape(-1, *x.shape[2:]), samples)

    def by_step(x: jax.Array) -> jax.Array:
        sequences = x[rows].reshape(len(rows), config.rollout_length, -1, *x.shape[2:])
        return jnp.moveaxis(sequences, 1, 0).reshape(-1, *x.shape[2:])

    memory = jax.tree.map(lambda x: x[rows].reshape(-1, x.shape[-1]), samples.memory)
    flat = jax.tree.map(by_step, replace(samples, memory=None))
    return replace(flat, memory=memory)


def _shuffle(key: jax.Array, groups: int, minibatches: int, shards: Shards) -> jax.Array:
    """Deals this device's groups [G] out to M minibatches, [M, G / M], each stream by itself."""
    streams = shards.local_streams
    size = groups // streams

    def order(key: jax.Array) -> jax.Array:
        return jax.random.permutation(key, size).reshape(minibatches, -1)

    first = size * jnp.arange(streams)
    return shards.draw(key, order, axis=1) + jnp.repeat(first, size // minibatches)


def _step(
    config: AlgoConfig,
    updates: int,
    expected_valid: jax.Array,
    shards: Shards,
    progress: Progress,
    minibatch: Minibatch,
) -> tuple[Progress, Metrics]:
    """Takes one step of the optimiser on a minibatch."""
    gradient = jax.grad(losses.ppo_loss, has_aux=True)
    found = gradient(progress[0], minibatch, config, expected_valid)
    return optimizer.take(config, updates, progress, found, jnp.any(minibatch.valid), shards)
