"""Proximal policy optimisation (PPO) of one learner: how it acts, computes values and learns.

All functions are pure and handle one learner; for L learners, apply `jax.vmap` over state, batch
and key. G stands for groups of samples, N for the samples of a group. Minibatches consist of whole
groups.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from swarmjax.config.section import MAX_COUNT
from swarmjax.extension import Network
from swarmjax.ppo import batch as batches
from swarmjax.ppo import dispatch, exploration, gradients, networks, optimizer
from swarmjax.ppo.batch import Batch, Trajectory
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.dispatch import Backend
from swarmjax.ppo.gradients import Learning, Metrics, Progress
from swarmjax.ppo.memory import NO_MEMORY, Recall
from swarmjax.ppo.networks import Normalizer, Params, Sizes
from swarmjax.shards import ALONE, Shards


@struct.dataclass(kw_only=True)
class LearnerState:
    """The complete state of a learner.

    Attributes:
      params: `{"actor": .., "critic": ..}`.
      optimizer_state: State of the optimiser, `PPO.learning.optimizer`.
      normalizer: Moments of the valid observations of all updates so far. A learner that does not
        normalise keeps the initial moments.
      explored: [], int32, control steps that the schedule of exploration has counted, at most
        2^31 - 1; None if exploration is learned.
    """

    params: Params
    optimizer_state: optax.OptState
    normalizer: Normalizer
    explored: jax.Array | None = None


@dataclass(frozen=True, eq=False)
class PPO:
    """PPO with its networks: `init`, `act`, `value` and `update`, and what they need.

    Attributes:
      learning: settings, networks and optimiser.
      sizes: sizes of what the policy sees and does.
      backend: how updates are computed.
    """

    learning: Learning
    sizes: Sizes
    backend: Backend = "autodiff"

    @classmethod
    def make(
        cls,
        config: AlgoConfig,
        sizes: Sizes,
        updates: int,
        *,
        pieces: Sequence[Network] = (),
        shards: Shards = ALONE,
        side_by_side: int = 1,
    ) -> "PPO":
        """Makes PPO for a policy; resolves everything that the config leaves to `auto`.

        Args:
          config: settings.
          sizes: sizes of what the policy sees and does.
          updates: number of updates of the whole run, at least 1; the learning rate's schedule
            spans them.
          pieces: networks of an extension.
          shards: how the samples are spread over devices.
          side_by_side: how many learners a device trains at once.

        Raises:
          ConfigError: the network that the config names is missing or does not fit.
        """
        nets = networks.make(config, sizes, pieces, dispatch.memory_kernels(config))
        adam = optimizer.make(config, updates)
        learning = Learning(config, nets, adam, shards, side_by_side)
        return cls(learning, sizes, dispatch.resolve(config, nets, sizes))

    @property
    def config(self) -> AlgoConfig:
        """The settings."""
        return self.learning.config

    def init(self, key: jax.Array) -> LearnerState:
        """Makes a new learner; the random key is consumed."""
        params = self.learning.networks.init(key)
        scheduled = self.config.exploration == "scheduled"
        return LearnerState(
            params=params,
            optimizer_state=self.learning.optimizer.init(params),
            normalizer=Normalizer.init(self.sizes.observation),
            explored=jnp.zeros((), jnp.int32) if scheduled else None,
        )

    def begin_memory(self, shape: tuple[int, ...]) -> Recall:
        """Returns actor's and critic's memory at the start of episodes: [*shape, H], or ()."""
        return self.learning.networks.begin_memory(shape)

    def act(
        self, learner: LearnerState, observation: jax.Array, noise: jax.Array, memory: Any = ()
    ) -> tuple[jax.Array, jax.Array, Any]:
        """Samples actions.

        Args:
          learner: the learner with the policy.
          observation: [..., O], raw.
          noise: [..., U], standard normal; 0 gives the most likely action.
          memory: [..., H], the actor's memory before the observation; () without memory.

        Returns:
          The action, mean + std * noise, [..., U], which is unbounded; its log density, [...]; and
          the actor's memory after the observation.
        """
        seen = learner.normalizer.normalize(observation)
        acted = self.learning.networks.act(learner.params, seen, memory)
        chex.assert_equal_shape([acted.mean, noise])
        action = acted.mean + acted.std * noise
        return action, gradients.log_density(acted.mean, acted.std, action), acted.memory

    def value(
        self, learner: LearnerState, observation: jax.Array, state: Any = (), memory: Any = ()
    ) -> tuple[jax.Array, Any]:
        """Computes the critic's values.

        Args:
          learner: the learner with the critic.
          observation: [..., O], raw.
          state: [..., P], what the critic sees in addition to the observation, scaled to order 1;
            () if nothing.
          memory: [..., H], the critic's memory before the observation; () without memory.

        Returns:
          The expected discounted return, [...], and the critic's memory after the observation.
        """
        seen = learner.normalizer.normalize(observation)
        return self.learning.networks.value(learner.params, seen, state, memory)

    def batch(self, trajectory: Trajectory, memory: Recall, over: jax.Array) -> Batch:
        """Turns a rollout into the samples of an update, with advantages and returns.

        Args:
          trajectory: [T, A, N, ...].
          memory: Memories of actor and critic before the rollout, each [A, N, H], or () without
            memory.
          over: [T, A], whether an arena's episode ended with the step.

        Returns:
          A batch of A groups, each with T * N samples.
        """
        return batches.make(trajectory, memory, over, self.config, self.learning.shards)

    def update(
        self, learner: LearnerState, batch: Batch, key: jax.Array
    ) -> tuple[LearnerState, Metrics]:
        """Learns from one batch in `config.epochs` passes of `config.num_minibatches` steps.

        The log densities in the batch were computed with the normalizer as it was before this
        update. All epochs use the same normalizer, so that the ratio of new to old density starts
        at 1. After the epochs, the batch's observations are added to the normalizer. A minibatch
        without a valid sample is skipped: it changes neither the parameters nor the learning rate's
        schedule.

        Args:
          learner: the learner before the update.
          batch: G groups of N samples; `config.num_minibatches` divides G.
          key: random key, consumed.

        Returns:
          The learner after the update, the same on all devices, and metrics, each []. The metrics
          of `gradients.ppo_loss` and `grad_norm` (before clipping) are means over the steps taken.
          `skipped_steps` counts the steps that were skipped because a number was not finite. `std`
          is the action's standard deviation after the update, averaged over the action's numbers.
        """
        config, shards = self.config, self.learning.shards
        _check(config, batch, shards)
        counted = batch.valid.astype(bool)
        batch = replace(batch, valid=counted & _is_finite(batch))
        samples = _samples(learner, config, batch, shards)
        begun = (learner.params, learner.optimizer_state)
        learn = _learn if self.backend == "autodiff" else dispatch.find(self.backend)
        (params, optimizer_state), metrics = learn(self.learning, begun, samples, key)
        # If the batch had valid samples but none of them is finite, all its steps count as skipped.
        lost = shards.any(jnp.any(counted)) & ~shards.any(jnp.any(batch.valid))
        metrics["skipped_steps"] = jnp.where(lost, 1.0, metrics["skipped_steps"])
        metrics = gradients.mean_of_taken(metrics)
        metrics["std"] = jnp.mean(jnp.exp(params["actor"]["log_std"]))
        moments = learner.normalizer
        if config.normalize_observations:
            moments = moments.update(batch.observation, batch.valid, shards)
        return replace(
            learner, params=params, optimizer_state=optimizer_state, normalizer=moments
        ), metrics

    def explore(self, learner: LearnerState, steps: jax.Array | int) -> LearnerState:
        """Moves learners along the schedule of exploration, if there is one.

        Args:
          learner: the learner before these steps, with any leading axes.
          steps: [], how many control steps follow, summed over all arenas, at least 1.

        Returns:
          The learner with the deviation that the schedule gives for the last of these steps; the
          same learner if exploration is learned.
        """
        if learner.explored is None:
            return learner
        # The count stops at MAX_COUNT: a run that continues another run's count may exceed it.
        explored = jnp.minimum(learner.explored, MAX_COUNT - steps) + steps
        std = exploration.scheduled_std(self.config, explored - 1)
        return replace(_with_log_std(learner, jnp.log(std)[..., None]), explored=explored)

    def begin_again(
        self, learner: LearnerState, *, optimizer: bool, exploration: bool
    ) -> LearnerState:
        """Resets parts of a learner, with any leading axes, to what a new learner has.

        Args:
          learner: the learner.
          optimizer: Whether to reset Adam's moments, and the count that corrects their bias. The
            learning rate's schedule has its own count and goes on.
          exploration: Whether to reset the deviation and its schedule.

        Returns:
          The changed learner; the given object itself if nothing is reset.
        """
        if optimizer:
            state = jax.tree.map(_without_moments, learner.optimizer_state, is_leaf=_is_adam)
            learner = replace(learner, optimizer_state=state)
        if exploration:
            begun = _with_log_std(learner, math.log(self.config.initial_std))
            learner = replace(begun, explored=jax.tree.map(jnp.zeros_like, learner.explored))
        return learner


def _is_adam(part: object) -> bool:
    return isinstance(part, optax.ScaleByAdamState)


def _without_moments(part: Any) -> Any:
    return jax.tree.map(jnp.zeros_like, part) if _is_adam(part) else part


def _with_log_std(learner: LearnerState, log_std: jax.Array | float) -> LearnerState:
    actor = learner.params["actor"]
    actor = actor | {"log_std": jnp.full_like(actor["log_std"], log_std)}
    return replace(learner, params=learner.params | {"actor": actor})


def _is_finite(batch: Batch) -> jax.Array:
    """Tells which samples, [G, N], hold only finite numbers."""
    numbers = (batch.observation, batch.action, batch.log_prob)
    numbers += (batch.advantage, batch.return_, batch.state)
    each = jax.tree.map(
        lambda x: jnp.all(jnp.isfinite(x).reshape(*batch.valid.shape, -1), axis=-1), numbers
    )
    return functools.reduce(jnp.logical_and, jax.tree.leaves(each))


def _check(config: AlgoConfig, batch: Batch, shards: Shards) -> None:
    chex.assert_rank([batch.observation, batch.action], 3)
    chex.assert_rank([batch.valid], 2)
    chex.assert_equal_shape([batch.log_prob, batch.advantage, batch.return_, batch.valid])
    chex.assert_equal_shape_prefix([batch.observation, batch.action, batch.valid], 2)
    chex.assert_is_divisible(batch.valid.shape[0], config.num_minibatches * shards.local_streams)


def _samples(learner: LearnerState, config: AlgoConfig, batch: Batch, shards: Shards) -> Batch:
    """Prepares samples for the loss, still [G, N, ...]: normalised, and zero where not valid."""
    valid, advantage = batch.valid.astype(bool), batch.advantage
    if config.advantage == "gae":
        advantage = batches.normalize(advantage, valid, shards, ddof=0, epsilon=1e-8)
    observation = learner.normalizer.normalize(batch.observation)
    samples = replace(batch, observation=observation, advantage=advantage, memory=NO_MEMORY)
    # Otherwise a NaN in an invalid sample would spread through the networks into every gradient.
    masked = jax.tree.map(
        lambda x: jnp.where(valid.reshape(valid.shape + (1,) * (x.ndim - 2)), x, 0), samples
    )
    memory = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x), x, 0.0), batch.memory)
    return replace(masked, valid=valid, memory=memory, begins=batch.begins)


def _learn(
    learning: Learning, begun: Progress, samples: Batch, key: jax.Array
) -> tuple[Progress, Metrics]:
    """Takes all gradient steps, epoch after epoch; also returns the metrics of each step."""
    config, shards = learning.config, learning.shards
    expected_valid = shards.sum(jnp.sum(samples.valid)) / config.num_minibatches

    def step(progress: Progress, rows: jax.Array) -> tuple[Progress, Metrics]:
        minibatch = _gather(samples, rows, config)
        gradient = jax.grad(gradients.ppo_loss, has_aux=True)(
            progress[0], minibatch, learning.networks, config, expected_valid
        )
        return gradients.take(learning, progress, gradient, jnp.any(minibatch.valid))

    # Whole groups are shuffled, because they are faster to gather than single samples.
    groups, keys = samples.valid.shape[0], jax.random.split(key, config.epochs)
    order = jax.vmap(lambda key: _shuffle(key, groups, config.num_minibatches, shards))(keys)
    return jax.lax.scan(step, begun, order.reshape(-1, order.shape[-1]))


def _gather(samples: Batch, rows: jax.Array, config: AlgoConfig) -> Batch:
    """Takes whole groups [G, N, ...] as samples [B, ...], ordered by step if there is a memory."""
    if not jax.tree.leaves(samples.memory):
        return jax.tree.map(lambda x: x[rows].reshape(-1, *x.shape[2:]), samples)

    def by_step(x: jax.Array) -> jax.Array:
        sequences = x[rows].reshape(len(rows), config.rollout_length, -1, *x.shape[2:])
        return jnp.moveaxis(sequences, 1, 0).reshape(-1, *x.shape[2:])

    memory = jax.tree.map(lambda x: x[rows].reshape(-1, x.shape[-1]), samples.memory)
    return replace(jax.tree.map(by_step, replace(samples, memory=NO_MEMORY)), memory=memory)


def _shuffle(key: jax.Array, groups: int, minibatches: int, shards: Shards) -> jax.Array:
    """Deals this device's G groups out to minibatches, [M, G / M], within each random stream."""
    streams = shards.local_streams
    size = groups // streams

    def order(key: jax.Array) -> jax.Array:
        return jax.random.permutation(key, size).reshape(minibatches, -1)

    first = size * jnp.arange(streams)
    return shards.draw(key, order, axis=1) + jnp.repeat(first, size // minibatches)
