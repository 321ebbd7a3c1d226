"""Actor and critic networks, and the running moments that normalise what they see.

B stands for any number of leading axes, O for the size of an observation and U for the size of an
action.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import struct

from swarmjax.extension import Network
from swarmjax.ppo import own_network
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.memory import NO_MEMORY, Gru, Recall, uniform
from swarmjax.shards import ALONE, Shards

Params = dict[str, Any]

_ACTIVATIONS = {"tanh": nn.tanh, "relu": nn.relu, "swish": nn.swish}
_OUTPUTS = {"linear": lambda mean: mean, "tanh": nn.tanh}

# Gains of the orthogonal initialisation: Huang et al. 2022, "The 37 Implementation Details of
# Proximal Policy Optimization", core detail 2. Their gain for the critic's output is 1, because
# they scale rewards to a return of about 1. Our returns are in metres. A critic whose
# values begin between -1 and 1 is wrong by more than a robot can earn, and the policy follows the
# critic's errors (docs/results.md, "Why seeds were slow").
_HIDDEN_GAIN = math.sqrt(2.0)
_HEAD_GAIN = 0.01
# Least standard deviation to divide an observation by. It magnifies a number that has hardly varied
# by at most 1 / MIN_STD.
MIN_STD = 1e-3
# Huang et al. 2022, "The 37 Implementation Details of Proximal Policy Optimization",
# continuous-action detail 7: bound of normalised observations.
OBSERVATION_LIMIT = 10.0


class Sizes(NamedTuple):
    """Sizes of a policy's inputs and outputs.

    Attributes:
      observation: O, numbers of an observation.
      action: U, numbers of an action.
      state: P, numbers that the critic sees beside the observation.
    """

    observation: int
    action: int
    state: int = 0


@struct.dataclass(kw_only=True)
class Normalizer:
    """Mean and variance of the observations seen so far.

    This class replaces Brax's `running_statistics`, which loads MuJoCo, MJX and Warp, and divides 0
    by 0 if the first batch has no valid sample. A learner whose robots are still absent has such a
    batch.

    Attributes:
      count: [], float32, number of observations. Beyond 2**24 it is rounded. This is harmless,
        because the count only weighs a batch against the past, and a relative error of 2**-24 is
        negligible.
      mean: [O].
      variance: [O], population variance; 1 before the first observation.
      rest: [2, O], what rounding to float32 has taken from `mean` and from `variance`. It is kept
        because, after a million updates, one batch moves both by less than float32 can resolve.
    """

    count: jax.Array
    mean: jax.Array
    variance: jax.Array
    rest: jax.Array

    @property
    def std(self) -> jax.Array:
        """Standard deviation to divide by, [O], at least 1e-3."""
        return jnp.maximum(jnp.sqrt(self.variance), MIN_STD)

    @classmethod
    def init(cls, observation_size: int) -> "Normalizer":
        """Returns a new normalizer, which only clips observations until its first update."""
        return cls(
            count=jnp.zeros((), jnp.float32),
            mean=jnp.zeros((observation_size,), jnp.float32),
            variance=jnp.ones((observation_size,), jnp.float32),
            rest=jnp.zeros((2, observation_size), jnp.float32),
        )

    def normalize(self, observation: jax.Array) -> jax.Array:
        """Shifts and scales observations [..., O] to mean 0 and deviation 1, within +-10."""
        chex.assert_axis_dimension(observation, -1, self.mean.shape[-1])
        scaled = (observation - self.mean) / self.std
        return jnp.clip(scaled, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)

    def update(
        self, observation: jax.Array, valid: jax.Array, shards: Shards = ALONE
    ) -> "Normalizer":
        """Adds a batch of observations.

        The moments of two sets are merged as in Chan, Golub and LeVeque 1983, "Algorithms for
        Computing the Sample Variance: Analysis and Recommendations". The batch's own moments take
        two passes, which avoids subtracting large squares.

        Args:
          observation: [..., O]; may hold anything, NaN included, where not valid.
          valid: [...], bool or 0/1, the observations to count.
          shards: how the observations are spread over devices.

        Returns:
          The moments of all observations so far; unchanged if no observation is valid.
        """
        chex.assert_shape(observation, (*valid.shape, *self.mean.shape))
        axes = tuple(range(valid.ndim))
        keep = valid.astype(bool)[..., None]
        batch_count = shards.sum(jnp.sum(keep, dtype=jnp.float32))
        divisor = jnp.maximum(batch_count, 1.0)
        batch_mean = shards.sum(jnp.sum(jnp.where(keep, observation, 0.0), axis=axes)) / divisor
        deviation = jnp.where(keep, observation - batch_mean, 0.0)
        batch_variance = shards.sum(jnp.sum(deviation**2, axis=axes)) / divisor

        count = self.count + batch_count
        share = batch_count / jnp.maximum(count, 1.0)
        shift = batch_mean - self.mean
        spread = batch_variance + (1.0 - share) * shift**2
        # The first batch replaces the initial variance of 1: added to it, a small variance loses
        # digits.
        before = jnp.where(share == 1.0, spread, self.variance)
        mean, mean_rest = _add(self.mean, share * shift + self.rest[0])
        variance, variance_rest = _add(before, share * (spread - before) + self.rest[1])
        return Normalizer(
            count=count,
            mean=mean,
            variance=jnp.maximum(variance, 0.0),  # rounding may make it negative
            rest=jnp.stack([mean_rest, variance_rest]),
        )


def _add(total: jax.Array, change: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Adds two numbers; also returns what rounding takes from the sum.

    The two results add up to the exact sum: Knuth, "The Art of Computer Programming" 2, section
    4.2.2, theorem B.
    """
    new = total + change
    taken = new - total
    return new, (total - (new - taken)) + (change - taken)


class _Torso(nn.Module):
    """Hidden layers `hidden_0`, `hidden_1`, ...: [B, O] -> [B, hidden[-1]]."""

    config: AlgoConfig

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        for index, width in enumerate(self.config.hidden_sizes):
            kernel, bias = _initializers(self.config, features.shape[-1], _HIDDEN_GAIN)
            layer = nn.Dense(width, kernel_init=kernel, bias_init=bias, name=f"hidden_{index}")
            features = _ACTIVATIONS[self.config.activation](layer(features))
        return features


class _Head(nn.Module):
    """An affine layer; its inputs are the features and, if there is one, the memory.

    Features and memory are multiplied by different rows of one kernel, so they need not be copied
    into one array.
    """

    config: AlgoConfig
    size: int

    @nn.compact
    def __call__(self, *features: jax.Array) -> jax.Array:
        widths = [part.shape[-1] for part in features]
        kernel_init, bias_init = _initializers(self.config, sum(widths), _HEAD_GAIN)
        kernel = self.param("kernel", kernel_init, (sum(widths), self.size), jnp.float32)
        bias = self.param("bias", bias_init, (self.size,), jnp.float32)
        rows = jnp.split(kernel, np.cumsum(widths)[:-1])
        products = [part @ weights for part, weights in zip(features, rows, strict=True)]
        return bias + functools.reduce(jnp.add, products)


class Acted(NamedTuple):
    """Output of the actor.

    Attributes:
      mean: [B, U], mean action.
      std: [U], standard deviation of the action.
      memory: [B, H], memory after the observation; () without memory.
      guess: [B, P], guess of the state that the critic sees; () if the critic sees no state.
    """

    mean: jax.Array
    std: jax.Array
    memory: Any
    guess: Any


class _Network(nn.Module):
    """The layers of both actor and critic, from an observation to the features.

    The heads take the features. Actor and critic do not share weights.

    Attributes:
      config: settings of the layers.
      sizes: what a policy sees and does.
      torso: an extension's network, in place of the hidden layers; None means hidden layers.
      kernels: module that computes a memory on a GPU, as in `Gru`.
    """

    config: AlgoConfig
    sizes: Sizes
    torso: Any = None
    kernels: Any = None

    def _features(
        self, seen: jax.Array, memory: Any, begins: jax.Array | None
    ) -> tuple[tuple[jax.Array, ...], Any]:
        """Returns the features for the heads, and the memory after the observation."""
        make = self.torso or functools.partial(_Torso, self.config)
        features = make(name="torso")(seen)
        if self.config.memory == "none":
            return (features,), ()
        recalled, memory = Gru(
            self.config.memory_size,
            uniform=self.config.initialization == "uniform",
            kernels=self.kernels,
            name="memory",
        )(features, memory, begins)
        return (features, recalled), memory


class _Actor(_Network):
    """Mean (`mean`) and logarithm of the standard deviation (`log_std`) of the action.

    The action is a diagonal Gaussian. Its mean is within -1..1 if `mean_activation` is tanh,
    otherwise unbounded. Its deviation does not depend on the observation, and has no gradient if
    exploration is scheduled.

    If the critic sees a state, the actor also guesses it (`guess`). The guess is not used for
    acting. The guess's error trains the memory to hold what a robot can know about its surroundings
    (Mirowski et al. 2017, "Learning to Navigate in Complex Environments", section 3).

    Observations are [B, O], or [T, B, O] for sequences of T steps. The memory before the first
    observation is [B, H], or () without memory. For sequences, `begins` [T, B] tells whether an
    episode begins with the step.
    """

    @nn.compact
    def __call__(
        self, observation: jax.Array, memory: Any = (), begins: jax.Array | None = None
    ) -> Acted:
        features, memory = self._features(observation, memory, begins)
        head, guess = _Head(self.config, self.sizes.action, name="mean"), ()
        if self.sizes.state:
            guess = _Head(self.config, self.sizes.state, name="guess")(*features)
        log_std = self.param(
            "log_std",
            nn.initializers.constant(math.log(self.config.initial_std)),
            (self.sizes.action,),
            jnp.float32,
        )
        std = jnp.exp(log_std)
        if self.config.exploration == "scheduled":
            std = jax.lax.stop_gradient(std)
        return Acted(_OUTPUTS[self.config.mean_activation](head(*features)), std, memory, guess)


class _Critic(_Network):
    """Value (`value`) [B] of an observation and a state: the expected discounted return.

    The state is [B, P], or () if the critic sees no state. Memory and `begins` are as for `_Actor`.
    """

    @nn.compact
    def __call__(
        self,
        observation: jax.Array,
        state: Any = (),
        memory: Any = (),
        begins: jax.Array | None = None,
    ) -> tuple[jax.Array, Any]:
        seen = jnp.concatenate([observation, *jax.tree.leaves(state)], axis=-1)
        features, memory = self._features(seen, memory, begins)
        return _Head(self.config, 1, name="value")(*features)[..., 0], memory


def _initializers(config: AlgoConfig, inputs: int, gain: float) -> tuple[Any, Any]:
    """Returns initialisers of kernel and bias of a layer; `gain` is for orthogonal kernels."""
    if config.initialization == "orthogonal":
        return nn.initializers.orthogonal(gain), nn.initializers.zeros_init()
    # `torch.nn.Linear.reset_parameters` does the same: kernel and bias have the bound
    # 1 / sqrt(inputs).
    within = functools.partial(uniform, bound=1.0 / math.sqrt(inputs))
    return within, within


class Networks(NamedTuple):
    """Actor and critic, for one policy.

    Attributes:
      actor: Flax module of the actor.
      critic: Flax module of the critic.
    """

    actor: _Actor
    critic: _Critic

    def init(self, key: jax.Array) -> Params:
        """Draws the parameters of a new actor and a new critic.

        Args:
          key: random key, consumed.

        Returns:
          `{"actor": {"torso": {"hidden_0": ..}, "mean": .., "log_std": [U]}, "critic": {"torso":
          {"hidden_0": ..}, "value": ..}}`. Each layer is a dict of `kernel` [in, out] and `bias`
          [out]. With `config.memory`, each network also has `{"memory": {"input": ..,
          "recurrent": ..}}`. If the critic sees a state, the actor also has `{"guess": ..}`.
        """
        actor_key, critic_key = jax.random.split(key)
        sizes, memory = self.actor.sizes, self.begin_memory(())
        seen = jnp.zeros(sizes.observation)
        state = jnp.zeros(sizes.state) if sizes.state else ()
        return {
            "actor": self.actor.init(actor_key, seen, memory.actor)["params"],
            "critic": self.critic.init(critic_key, seen, state, memory.critic)["params"],
        }

    def begin_memory(self, shape: tuple[int, ...]) -> Recall:
        """Returns actor's and critic's memory at the start of episodes: [*shape, H], or ()."""
        config = self.actor.config
        if config.memory == "none":
            return NO_MEMORY
        zero = jnp.zeros((*shape, config.memory_size), jnp.float32)
        return Recall(zero, zero)

    def act(self, params: Params, *seen: Any) -> Acted:
        """Runs the actor; `seen` holds what `_Actor` takes, with normalised observations."""
        return cast("Acted", self.actor.apply({"params": params["actor"]}, *seen))

    def value(self, params: Params, *seen: Any) -> tuple[jax.Array, Any]:
        """Runs the critic; `seen` holds what `_Critic` takes, with normalised observations."""
        value = self.critic.apply({"params": params["critic"]}, *seen)
        return cast("tuple[jax.Array, Any]", value)


def make(
    config: AlgoConfig, sizes: Sizes, pieces: Sequence[Network] = (), kernels: Any = None
) -> Networks:
    """Makes actor and critic.

    Args:
      config: settings of the layers. It may name a network, or leave the choice to the extension.
      sizes: what the policy sees and does.
      pieces: networks of an extension.
      kernels: module that computes a memory on a GPU, as in `Gru`.

    Returns:
      The networks.

    Raises:
      ConfigError: the network that the config names is missing, or does not return features.
    """
    torso = own_network.load(config, pieces, sizes.observation, sizes.state)
    parts = (config, sizes, torso, kernels)
    return Networks(_Actor(*parts), _Critic(*parts))
