"""Actor and critic networks.

B stands for any number of leading axes, O for the observation and U for the action.
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

from swarmjax.config import ConfigError
from swarmjax.config.foreign_code import explained
from swarmjax.extension import Network
from swarmjax.ppo.config import AlgoConfig, resolve
from swarmjax.ppo.memory import NO_MEMORY, Gru, Recall, uniform

Params = dict[str, Any]

_ACTIVATIONS = {"tanh": nn.tanh, "relu": nn.relu, "swish": nn.swish}
_OUTPUTS = {"linear": lambda mean: mean, "tanh": nn.tanh}

# Gains of the orthogonal initialisation: Huang et al. 2022, "The 37 Implementation Details of
# Proximal Policy Optimization", core detail 2. Their gain is 1 for the critic, because they scale
# rewards to a return of about 1. Our returns are metres. A critic that begins between -1 and 1 is
# wrong by more than a robot can earn, and the policy follows the critic's errors (docs/results.md,
# "Why seeds were slow").
_HIDDEN_GAIN = math.sqrt(2.0)
_HEAD_GAIN = 0.01


class Hearing(NamedTuple):
    """The place of neighbours in an observation: `rows` of `width` entries each, from `first` on.

    The first entry of a row is 1 if there is a neighbour, otherwise 0.
    """

    first: int
    rows: int
    width: int

    @property
    def last(self) -> int:
        """Index of the entry after the neighbours."""
        return self.first + self.rows * self.width


class Sizes(NamedTuple):
    """What a policy sees and does.

    Attributes:
      observation: O, numbers of an observation.
      action: U, numbers of an action.
      state: P, numbers that the critic sees in addition.
      hearing: place of the neighbours in an observation; None if robots do not hear.
    """

    observation: int
    action: int
    state: int = 0
    hearing: Hearing | None = None


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
    """An affine layer of the features and, if there is one, the memory.

    Features and memory are multiplied by different rows of one kernel, so they need not be copied
    side by side.
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
      memory: [B, H], memory after; () without memory.
      guess: [B, P], guess of the state that the critic sees; () if the critic sees no state.
    """

    mean: jax.Array
    std: jax.Array
    memory: Any
    guess: Any


class _Network(nn.Module):
    """The layers that actor and critic have in common: what a head sees of an observation.

    Attributes:
      config: settings of the layers.
      sizes: what a policy sees and does.
      torso: an extension's network, in place of the hidden layers; None for these.
      kernels: what computes a memory on a GPU, as in `Gru`.
    """

    config: AlgoConfig
    sizes: Sizes
    torso: Any = None
    kernels: Any = None

    def _features(
        self, seen: jax.Array, memory: Any, begins: jax.Array | None
    ) -> tuple[tuple[jax.Array, ...], Any]:
        """Returns the features for the heads, and the memory after."""
        make = self.torso or functools.partial(_Torso, self.config)
        features = make(name="torso")(_hear(self.config, self.sizes.hearing, seen))
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

    If the critic sees a state, the actor also guesses it (`guess`).
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
    """Value (`value`) of an observation, and of the state if the critic sees it: [B]."""

    @nn.compact
    def __call__(
        self, observation: jax.Array, state: Any, memory: Any, begins: jax.Array | None = None
    ) -> tuple[jax.Array, Any]:
        seen = jnp.concatenate([observation, *jax.tree.leaves(state)], axis=-1)
        features, memory = self._features(seen, memory, begins)
        return _Head(self.config, 1, name="value")(*features)[..., 0], memory


def _hear(config: AlgoConfig, hearing: Hearing | None, seen: jax.Array) -> jax.Array:
    """Sums neighbours up: applies one layer (`hearing`) to each neighbour and adds the results.

    This is the form of a function of a set: Zaheer et al. 2017, "Deep Sets", theorem 2. The order
    and the number of robots therefore do not matter.

    Args:
      config: settings of the layer.
      hearing: place of the neighbours.
      seen: [B, O], or [B, O + P] for a critic that sees the state too.

    Returns:
      [B, O - K W + E], or [B, O - K W + E + P] for a critic that sees the state too. E is the width
      of the first hidden layer. Without neighbours, `seen` unchanged.
    """
    if hearing is None:
        return seen
    rows = seen[..., hearing.first : hearing.last]
    rows = rows.reshape(*seen.shape[:-1], hearing.rows, hearing.width)
    kernel, bias = _initializers(config, hearing.width, _HIDDEN_GAIN)
    width = config.hidden_sizes[0]
    layer = nn.Dense(width, kernel_init=kernel, bias_init=bias, name="hearing")
    each = _ACTIVATIONS[config.activation](layer(rows)) * rows[..., :1]
    parts = [seen[..., : hearing.first], jnp.sum(each, axis=-2), seen[..., hearing.last :]]
    return jnp.concatenate(parts, axis=-1)


def _initializers(config: AlgoConfig, inputs: int, gain: float) -> tuple[Any, Any]:
    """Returns initialisers of kernel and bias of a layer; `gain` is for orthogonal kernels."""
    if config.initialization == "orthogonal":
        return nn.initializers.orthogonal(gain), nn.initializers.zeros_init()
    # `torch.nn.Linear.reset_parameters` does the same: the bound of both is 1 / sqrt(inputs).
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
        """Returns the memory [*shape, H] of episodes that begin; () each without memory."""
        config = self.actor.config
        if config.memory == "none":
            return NO_MEMORY
        zero = jnp.zeros((*shape, config.memory_size), jnp.float32)
        return Recall(zero, zero)

    def act(
        self, params: Params, observation: jax.Array, memory: Any, begins: jax.Array | None = None
    ) -> Acted:
        """Runs the actor.

        Args:
          params: result of `init`.
          observation: [B, O], normalised, or [T, B, O] of sequences.
          memory: [B, H], memory before; () without memory.
          begins: [T, B] of sequences, whether an episode begins with the step; None for a single
            step.

        Returns:
          The diagonal Gaussian of the action. Its mean is within -1..1 if the output is tanh,
          otherwise unbounded. Its deviation does not depend on the observation, and has no gradient
          if it is scheduled. Also the memory after, and a guess of the state that the critic sees.
          The guess is not used for acting. Its error trains the memory to hold what a robot can
          know about its surroundings (Mirowski et al. 2017, "Learning to Navigate in Complex
          Environments", section 3).
        """
        self._check(params["actor"], observation)
        output = self.actor.apply({"params": params["actor"]}, observation, memory, begins)
        return cast("Acted", output)

    def value(
        self,
        params: Params,
        observation: jax.Array,
        state: Any,
        memory: Any,
        begins: jax.Array | None = None,
    ) -> tuple[jax.Array, Any]:
        """Runs the critic.

        Args:
          params: result of `init`.
          observation: [B, O] or [T, B, O], normalised.
          state: [B, P] or [T, B, P], numbers of order 1; () if the critic sees no state.
          memory: [B, H], memory before; () without memory.
          begins: as in `act`.

        Returns:
          The expected discounted return, [B] or [T, B], and the memory after.
        """
        self._check(params["critic"], observation)
        output = self.critic.apply({"params": params["critic"]}, observation, state, memory, begins)
        return cast("tuple[jax.Array, Any]", output)

    def _check(self, network: Params, observation: jax.Array) -> None:
        """Checks an observation's size for the hidden layers; other networks check it alone."""
        if self.actor.torso is None:
            chex.assert_axis_dimension(observation, -1, self.actor.sizes.observation)


def make(
    config: AlgoConfig, sizes: Sizes, pieces: Sequence[Network] = (), kernels: Any = None
) -> Networks:
    """Makes actor and critic.

    Args:
      config: settings of the layers. It may name a network, or leave the choice to the extension.
      sizes: what the policy sees and does.
      pieces: networks of an extension.
      kernels: what computes a memory on a GPU, as in `Gru`.

    Returns:
      The networks.

    Raises:
      ConfigError: the network is missing, or does not return features.
    """
    name = resolve(config, pieces)
    torso = {piece.name: piece.function for piece in pieces}.get(name)
    if torso is not None:
        _check_torso(torso, name, sizes.observation)
        if sizes.state:
            whose = f"{name} for a critic of the state"
            _check_torso(torso, whose, sizes.observation + sizes.state)
    parts = (config, sizes, torso, kernels)
    return Networks(_Actor(*parts), _Critic(*parts))


def _check_torso(torso: Any, name: str, observation_size: int) -> None:
    """Refuses a network that fails, or does not turn [B, O] into [B, F]."""
    seen = jax.ShapeDtypeStruct((3, observation_size), jnp.float32)
    where = f"network {name}"
    with explained(f"{where} fails"):
        made = torso()
        found, variables = jax.eval_shape(made.init_with_output, jax.random.key(0), seen)
    other = sorted(set(variables) - {"params"})
    if other:
        raise ConfigError(f"{where} keeps {', '.join(other)}: a network may keep only params.")
    shape = getattr(found, "shape", ())
    if len(shape) != 2 or shape[0] != 3 or found.dtype != jnp.float32:
        kind = getattr(found, "dtype", type(found).__name__)
        raise ConfigError(
            f"{where} turns float32 [3, {observation_size}] into {kind} {list(shape)}: return "
            "float32 [3, F], the features that the heads take."
        )
