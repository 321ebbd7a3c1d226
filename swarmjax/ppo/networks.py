"""Actor and critic networks, and the diagonal Gaussian that the actor describes.

B stands for any number of leading axes, O for the observation and U for the action.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn

from swarmjax.config import ConfigError
from swarmjax.config.foreign_code import explained
from swarmjax.extension import Network
from swarmjax.ppo import memory as ppo_memory
from swarmjax.ppo.config import AlgoConfig, resolve
from swarmjax.ppo.memory import Gru, Recall

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
    def __call__(self, features: jax.Array, recalled: jax.Array | None) -> jax.Array:
        seen = features.shape[-1]
        inputs = seen if recalled is None else seen + recalled.shape[-1]
        kernel_init, bias_init = _initializers(self.config, inputs, _HEAD_GAIN)
        kernel = self.param("kernel", kernel_init, (inputs, self.size), jnp.float32)
        bias = self.param("bias", bias_init, (self.size,), jnp.float32)
        found = features @ kernel[:seen]
        return bias + (found if recalled is None else found + recalled @ kernel[seen:])


class Acted(NamedTuple):
    """Output of the actor.

    Attributes:
      mean: [B, U], mean action.
      std: [U], standard deviation of the action.
      memory: [B, H], memory after; None without memory.
      guess: [B, P], guess of the state that the critic sees; None if the critic sees no state.
    """

    mean: jax.Array
    std: jax.Array
    memory: jax.Array | None
    guess: jax.Array | None


class _Actor(nn.Module):
    """Mean (`mean`) and logarithm of the standard deviation (`log_std`) of the action.

    If `state_size` is not 0, it also guesses the state that the critic sees (`guess`).
    """

    config: AlgoConfig
    action_size: int
    state_size: int = 0

    @nn.compact
    def __call__(
        self,
        observation: jax.Array,
        memory: jax.Array | None = None,
        begins: jax.Array | None = None,
    ) -> Acted:
        features = _torso(self.config)(_hear(self.config, observation))
        recalled, guess = None, None
        if memory is not None:
            recalled, memory = _gru(self.config)(features, memory, begins)
        head = _Head(self.config, self.action_size, name="mean")
        if self.state_size:
            guess = _Head(self.config, self.state_size, name="guess")(features, recalled)
        log_std = self.param(
            "log_std",
            nn.initializers.constant(math.log(self.config.initial_std)),
            (self.action_size,),
            jnp.float32,
        )
        mean = _OUTPUTS[self.config.mean_activation](head(features, recalled))
        return Acted(mean, jnp.exp(log_std), memory, guess)


class _Critic(nn.Module):
    """Value (`value`) of an observation: [B, O] -> [B], and the memory after."""

    config: AlgoConfig

    @nn.compact
    def __call__(
        self,
        observation: jax.Array,
        memory: jax.Array | None = None,
        begins: jax.Array | None = None,
    ) -> tuple[jax.Array, jax.Array | None]:
        features = _torso(self.config)(_hear(self.config, observation))
        recalled = None
        if memory is not None:
            recalled, memory = _gru(self.config)(features, memory, begins)
        return _Head(self.config, 1, name="value")(features, recalled)[..., 0], memory


def _hear(config: AlgoConfig, seen: jax.Array) -> jax.Array:
    """Sums neighbours up: applies one layer (`hearing`) to each neighbour and adds the results.

    This is the form of a function of a set: Zaheer et al. 2017, "Deep Sets", theorem 2. The order
    and the number of robots therefore do not matter.

    Args:
      config: Gives the neighbours' place.
      seen: [B, O], or [B, O + P] for a critic that sees the state too.

    Returns:
      [B, O - K W + E], or [B, O - K W + E + P] for a critic that sees the state too. E is the width
      of the first hidden layer. Without neighbour messages, `seen` unchanged.
    """
    hearing = config.hearing
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


def _gru(config: AlgoConfig) -> Gru:
    return Gru(
        _memory_size(config),
        uniform=config.initialization == "uniform",
        kernels=config.memory_kernels,
        name="memory",
    )


def _memory_size(config: AlgoConfig) -> int:
    assert config.memory_size is not None  # the config has filled it in
    return config.memory_size


def _torso(config: AlgoConfig) -> nn.Module:
    """Makes the layers before the heads: hidden layers, or an extension's network."""
    return _Torso(config, name="torso") if config.torso is None else config.torso(name="torso")


def _initializers(config: AlgoConfig, inputs: int, gain: float) -> tuple[Any, Any]:
    """Returns initialisers of kernel and bias of a layer; `gain` is for orthogonal kernels."""
    if config.initialization == "orthogonal":
        return nn.initializers.orthogonal(gain), nn.initializers.zeros_init()
    # `torch.nn.Linear.reset_parameters` does the same: the bound of both is 1 / sqrt(inputs).
    uniform = functools.partial(ppo_memory.uniform, bound=1.0 / math.sqrt(inputs))
    return uniform, uniform


def init_params(
    key: jax.Array,
    config: AlgoConfig,
    observation_size: int,
    action_size: int,
    state_size: int = 0,
) -> Params:
    """Draws the parameters of a new actor and a new critic.

    Args:
      key: Random key, consumed.
      config: Layers, their initialisation, and the first standard deviation.
      observation_size: O.
      action_size: U.
      state_size: P, how many numbers the critic sees in addition.

    Returns:
      `{"actor": {"torso": {"hidden_0": ..}, "mean": .., "log_std": [U]}, "critic": {"torso":
      {"hidden_0": ..}, "value": ..}}`. Each layer is a dict of `kernel` [in, out] and `bias`
      [out]. With `config.memory`, each network also has `{"memory": {"input": .., "recurrent":
      ..}}`. If the critic sees the state, the actor also has `{"guess": ..}`.
    """
    actor_key, critic_key = jax.random.split(key)
    seen, judged = (jnp.zeros(n) for n in (observation_size, observation_size + state_size))
    memory = begin_memory(config, ())
    mine, theirs = (None, None) if memory is None else memory
    return {
        "actor": _Actor(config, action_size, state_size).init(actor_key, seen, mine)["params"],
        "critic": _Critic(config).init(critic_key, judged, theirs)["params"],
    }


def begin_memory(config: AlgoConfig, shape: tuple[int, ...]) -> Recall | None:
    """Returns the memory of episodes that begin.

    Args:
      config: Whether there is a memory, and its size.
      shape: Leading axes.

    Returns:
      [*shape, H] each, or None without a memory.
    """
    if config.memory == "none":
        return None
    return ppo_memory.begin((*shape, _memory_size(config)))


def action_distribution(
    params: Params, config: AlgoConfig, observation: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Computes the diagonal Gaussian of the action, for a policy without memory.

    Args:
      params: Result of `init_params`.
      config: The config that made `params`.
      observation: [B, O], normalised.

    Returns:
      The mean [B, U], within -1..1 if the output is tanh, otherwise unbounded, and the standard
      deviation [U]. The deviation does not depend on the observation. If it is scheduled, it has
      no gradient.
    """
    return recall_action(params, config, observation, None)[:2]


def value(params: Params, config: AlgoConfig, observation: jax.Array) -> jax.Array:
    """Computes the value of an observation, for a critic without memory.

    Args:
      params: Result of `init_params`.
      config: The config that made `params`.
      observation: [B, O + P], normalised, as in `recall_value`.

    Returns:
      The expected discounted return, [B].
    """
    return recall_value(params, config, observation, None)[0]


def recall_action(
    params: Params,
    config: AlgoConfig,
    observation: jax.Array,
    memory: jax.Array | None,
    begins: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array | None]:
    """Computes the diagonal Gaussian of the action, and the memory.

    Args:
      params: Result of `init_params`.
      config: The config that made `params`.
      observation: [B, O], normalised, or [T, B, O] of sequences.
      memory: [B, H], memory of the actor before; None without memory.
      begins: [T, B] of sequences, whether an episode begins with the step; None for a single
        step.

    Returns:
      Mean and standard deviation as in `action_distribution`, and the memory [B, H] after.
    """
    return run_actor(params, config, observation, memory, begins)[:3]


def run_actor(
    params: Params,
    config: AlgoConfig,
    observation: jax.Array,
    memory: jax.Array | None,
    begins: jax.Array | None = None,
) -> Acted:
    """Runs the actor; arguments as in `recall_action`.

    Returns:
      What `recall_action` returns, and a guess of the state that the critic sees. The guess is not
      used for acting. Its error trains the memory to hold what a robot can know about its
      surroundings (Mirowski et al. 2017, "Learning to Navigate in Complex Environments", section
      3).
    """
    mine = params["actor"]
    _check_input(mine, observation, config)
    sizes = mine["log_std"].shape[-1], mine["guess"]["bias"].shape[-1] if "guess" in mine else 0
    output = _Actor(config, *sizes).apply({"params": mine}, observation, memory, begins)
    acted = cast("Acted", output)
    if config.exploration == "scheduled":
        acted = acted._replace(std=jax.lax.stop_gradient(acted.std))
    return acted


def recall_value(
    params: Params,
    config: AlgoConfig,
    observation: jax.Array,
    memory: jax.Array | None,
    begins: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array | None]:
    """Computes the value of an observation, and the memory.

    Args:
      params: Result of `init_params`.
      config: The config that made `params`.
      observation: [B, O + P] or [T, B, O + P], normalised. It is the policy's observation, followed
        by the state that the critic sees in addition, if any.
      memory: [B, H], memory of the critic before; None without memory.
      begins: As in `recall_action`.

    Returns:
      The value [B], or [T, B], and the memory [B, H] after.
    """
    _check_input(params["critic"], observation, config)
    output = _Critic(config).apply({"params": params["critic"]}, observation, memory, begins)
    return cast("tuple[jax.Array, jax.Array | None]", output)


def critic_input(observation: jax.Array, state: jax.Array | None) -> jax.Array:
    """Joins the critic's inputs.

    Args:
      observation: [B, O], normalised.
      state: [B, P], numbers that the critic sees in addition; None if there are none.

    Returns:
      [B, O + P], for `recall_value`.
    """
    return observation if state is None else jnp.concatenate([observation, state], axis=-1)


def beyond_range(mean: jax.Array) -> jax.Array:
    """Computes how far a mean action lies beyond the range of commands.

    Args:
      mean: [B, U], -1..1 spans the commands.

    Returns:
      [B, U]: 0 within the range, negative below it, positive above it.
    """
    return mean - jnp.clip(mean, -1.0, 1.0)


def log_prob(mean: jax.Array, std: jax.Array, action: jax.Array) -> jax.Array:
    """Computes the log density of actions under a diagonal Gaussian.

    Args:
      mean: [B, U].
      std: [U], above 0.
      action: [B, U], as drawn, before any clipping.

    Returns:
      The log density summed over U, [B].
    """
    chex.assert_equal_shape([mean, action])
    chex.assert_shape(std, mean.shape[-1:])
    standardised = (action - mean) / std
    log_density = -0.5 * standardised**2 - jnp.log(std) - 0.5 * math.log(2.0 * math.pi)
    return jnp.sum(log_density, axis=-1)


def entropy(std: jax.Array) -> jax.Array:
    """Computes the differential entropy of a diagonal Gaussian.

    Args:
      std: [U], above 0.

    Returns:
      The entropy in nats, [].
    """
    chex.assert_rank(std, 1)
    return jnp.sum(jnp.log(std) + 0.5 * math.log(2.0 * math.pi * math.e))


def _check_input(network: Params, observation: jax.Array, config: AlgoConfig) -> None:
    """Checks an observation's size for the hidden layers; other networks check it themselves."""
    first = network.get("torso", {}).get("hidden_0", {})
    if "kernel" in first:
        size = first["kernel"].shape[-2]
        if config.hearing is not None:
            size += config.hearing.last - config.hearing.first - config.hidden_sizes[0]
        chex.assert_axis_dimension(observation, -1, size)


def bind_hearing(config: AlgoConfig, observation_size: int, count: int, width: int) -> AlgoConfig:
    """Adds the neighbours' place to a config: they are the last entries of an observation.

    Args:
      config: Settings of the learner.
      observation_size: O.
      count: K, how many neighbours a robot hears; 0: robots do not hear.
      width: W, entries for each neighbour.

    Returns:
      The config with its `hearing`; unchanged if robots do not hear.
    """
    if not count:
        return config
    return replace(config, hearing=Hearing(observation_size - count * width, count, width))


def bind(
    config: AlgoConfig, networks: Sequence[Network], observation_size: int, state_size: int = 0
) -> AlgoConfig:
    """Adds the module that a config names to the config.

    Args:
      config: Names a network, or leaves the choice to the extension.
      networks: Networks of an extension.
      observation_size: O.
      state_size: P, how many numbers the critic sees in addition.

    Returns:
      The config with the module as its `torso`; unchanged for `mlp`.

    Raises:
      ConfigError: The network is missing, or does not return features.
    """
    name = resolve(config, networks)
    found = {piece.name: piece for piece in networks}
    if name == "mlp":
        return config
    bound = replace(config, network=name, torso=found[name].function)
    _check_torso(bound, observation_size)
    if state_size:
        _check_torso(bound, observation_size + state_size, " for a critic of the state")
    return bound


def _check_torso(config: AlgoConfig, observation_size: int, whose: str = "") -> None:
    """Refuses a network that fails, or does not turn [B, O] into [B, F]."""
    seen = jax.ShapeDtypeStruct((3, observation_size), jnp.float32)
    where = f"network {config.network}{whose}"
    with explained(f"{where} fails"):
        made = config.torso()
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
