"""Actor and critic networks, and the diagonal Gaussian that the actor describes.

B stands for any number of leading axes, O for the observation and U for the action.
"""

import math
from typing import Any, cast

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn

from swarmjax.config import AlgoConfig

Params = dict[str, Any]

_ACTIVATIONS = {"tanh": nn.tanh, "relu": nn.relu, "swish": nn.swish}

# Gains of the orthogonal initialisation: Huang et al. 2022, "The 37 Implementation Details of
# Proximal Policy Optimization", core detail 2.
_HIDDEN_GAIN = math.sqrt(2.0)
_ACTOR_GAIN = 0.01
_CRITIC_GAIN = 1.0


class _Torso(nn.Module):
    """Hidden layers `hidden_0`, `hidden_1`, ...: [B, O] -> [B, hidden[-1]]."""

    hidden: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        for index, width in enumerate(self.hidden):
            features = nn.Dense(
                width, kernel_init=nn.initializers.orthogonal(_HIDDEN_GAIN), name=f"hidden_{index}"
            )(features)
            features = _ACTIVATIONS[self.activation](features)
        return features


class _Actor(nn.Module):
    """Mean (`mean`) and logarithm of the standard deviation (`log_std`) of the action."""

    hidden: tuple[int, ...]
    activation: str
    action_size: int
    initial_std: float

    @nn.compact
    def __call__(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        features = _Torso(self.hidden, self.activation, name="torso")(observation)
        mean = nn.Dense(
            self.action_size, kernel_init=nn.initializers.orthogonal(_ACTOR_GAIN), name="mean"
        )(features)
        log_std = self.param(
            "log_std",
            nn.initializers.constant(math.log(self.initial_std)),
            (self.action_size,),
            jnp.float32,
        )
        return mean, log_std


class _Critic(nn.Module):
    """Value (`value`) of an observation: [B, O] -> [B]."""

    hidden: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        features = _Torso(self.hidden, self.activation, name="torso")(observation)
        output = nn.Dense(1, kernel_init=nn.initializers.orthogonal(_CRITIC_GAIN), name="value")(
            features
        )
        return output[..., 0]


def _actor(config: AlgoConfig, action_size: int) -> _Actor:
    return _Actor(config.hidden, config.activation, action_size, config.initial_std)


def _critic(config: AlgoConfig) -> _Critic:
    return _Critic(config.hidden, config.activation)


def init_params(
    key: jax.Array, config: AlgoConfig, observation_size: int, action_size: int
) -> Params:
    """Draws the parameters of a new actor and a new critic.

    Args:
        key: Random key, consumed.
        config: Layer widths, activation and initial standard deviation.
        observation_size: O.
        action_size: U.

    Returns:
        `{"actor": {"torso": {"hidden_0": ..}, "mean": .., "log_std": [U]}, "critic": {"torso":
        {"hidden_0": ..}, "value": ..}}`, each layer a dict of `kernel` [in, out] and `bias` [out].
    """
    actor_key, critic_key = jax.random.split(key)
    observation = jnp.zeros((observation_size,), jnp.float32)
    return {
        "actor": _actor(config, action_size).init(actor_key, observation)["params"],
        "critic": _critic(config).init(critic_key, observation)["params"],
    }


def action_distribution(
    params: Params, config: AlgoConfig, observation: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Computes the diagonal Gaussian of the action.

    Args:
        params: What `init_params` returned.
        config: The config that made `params`.
        observation: [B, O], normalised.

    Returns:
        The mean [B, U], unbounded, and the standard deviation [U], which no observation changes.
    """
    chex.assert_axis_dimension(observation, -1, _input_size(params["actor"]))
    actor = _actor(config, params["actor"]["log_std"].shape[-1])
    output = actor.apply({"params": params["actor"]}, observation)
    mean, log_std = cast("tuple[jax.Array, jax.Array]", output)
    return mean, jnp.exp(log_std)


def value(params: Params, config: AlgoConfig, observation: jax.Array) -> jax.Array:
    """Computes the value of an observation.

    Args:
        params: What `init_params` returned.
        config: The config that made `params`.
        observation: [B, O], normalised.

    Returns:
        The expected discounted return, [B].
    """
    chex.assert_axis_dimension(observation, -1, _input_size(params["critic"]))
    return cast("jax.Array", _critic(config).apply({"params": params["critic"]}, observation))


def log_prob(mean: jax.Array, std: jax.Array, action: jax.Array) -> jax.Array:
    """Computes the log density of actions under a diagonal Gaussian.

    Args:
        mean: [B, U].
        std: [U], above 0.
        action: [B, U], as drawn: whoever bounds it does so afterwards.

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


def _input_size(network: Params) -> int:
    return network["torso"]["hidden_0"]["kernel"].shape[-2]
