"""Actor and critic networks, and the diagonal Gaussian that the actor describes.

B stands for any number of leading axes, O for the observation and U for the action.
"""

import functools
import math
from typing import Any, cast

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn

from swarmjax.ppo.config import AlgoConfig

Params = dict[str, Any]

_ACTIVATIONS = {"tanh": nn.tanh, "relu": nn.relu, "swish": nn.swish}
_OUTPUTS = {"linear": lambda mean: mean, "tanh": nn.tanh}

# Gains of the orthogonal initialisation: Huang et al. 2022, "The 37 Implementation Details of
# Proximal Policy Optimization", core detail 2. Theirs is 1 for the critic, whose rewards are scaled
# to a return of about 1. Ours are metres: a critic that begins between -1 and 1 is wrong by more
# than there is to earn, and the policy follows its errors (docs/results.md, "Why seeds were slow").
_HIDDEN_GAIN = math.sqrt(2.0)
_HEAD_GAIN = 0.01


class _Torso(nn.Module):
    """Hidden layers `hidden_0`, `hidden_1`, ...: [B, O] -> [B, hidden[-1]]."""

    config: AlgoConfig

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        for index, width in enumerate(self.config.hidden_sizes):
            layer = _layer(self.config, features, width, _HIDDEN_GAIN, f"hidden_{index}")
            features = _ACTIVATIONS[self.config.activation](layer(features))
        return features


class _Actor(nn.Module):
    """Mean (`mean`) and logarithm of the standard deviation (`log_std`) of the action."""

    config: AlgoConfig
    action_size: int

    @nn.compact
    def __call__(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        features = _Torso(self.config, name="torso")(observation)
        layer = _layer(self.config, features, self.action_size, _HEAD_GAIN, "mean")
        log_std = self.param(
            "log_std",
            nn.initializers.constant(math.log(self.config.initial_std)),
            (self.action_size,),
            jnp.float32,
        )
        return _OUTPUTS[self.config.mean_activation](layer(features)), log_std


class _Critic(nn.Module):
    """Value (`value`) of an observation: [B, O] -> [B]."""

    config: AlgoConfig

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        features = _Torso(self.config, name="torso")(observation)
        return _layer(self.config, features, 1, _HEAD_GAIN, "value")(features)[..., 0]


def _layer(config: AlgoConfig, features: jax.Array, width: int, gain: float, name: str) -> nn.Dense:
    """Makes a layer to apply to `features`; `gain` is that of an orthogonal kernel."""
    if config.initialization == "orthogonal":
        return nn.Dense(width, kernel_init=nn.initializers.orthogonal(gain), name=name)
    # What `torch.nn.Linear.reset_parameters` comes to: the bound of both is 1 / sqrt(inputs).
    uniform = functools.partial(_uniform, bound=1.0 / math.sqrt(features.shape[-1]))
    return nn.Dense(width, kernel_init=uniform, bias_init=uniform, name=name)


def _uniform(
    key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32, *, bound: float
) -> jax.Array:
    return jax.random.uniform(key, shape, dtype, -bound, bound)


def init_params(
    key: jax.Array, config: AlgoConfig, observation_size: int, action_size: int
) -> Params:
    """Draws the parameters of a new actor and a new critic.

    Args:
        key: Random key, consumed.
        config: Layers, how they begin, and the initial standard deviation.
        observation_size: O.
        action_size: U.

    Returns:
        `{"actor": {"torso": {"hidden_0": ..}, "mean": .., "log_std": [U]}, "critic": {"torso":
        {"hidden_0": ..}, "value": ..}}`, each layer a dict of `kernel` [in, out] and `bias` [out].
    """
    actor_key, critic_key = jax.random.split(key)
    observation = jnp.zeros((observation_size,), jnp.float32)
    return {
        "actor": _Actor(config, action_size).init(actor_key, observation)["params"],
        "critic": _Critic(config).init(critic_key, observation)["params"],
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
        The mean [B, U], within -1..1 if the output is tanh, otherwise unbounded, and the standard
        deviation [U], which no observation changes, nor any gradient if it is scheduled.
    """
    chex.assert_axis_dimension(observation, -1, _input_size(params["actor"]))
    actor = _Actor(config, params["actor"]["log_std"].shape[-1])
    output = actor.apply({"params": params["actor"]}, observation)
    mean, log_std = cast("tuple[jax.Array, jax.Array]", output)
    if config.exploration == "scheduled":
        log_std = jax.lax.stop_gradient(log_std)
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
    return cast("jax.Array", _Critic(config).apply({"params": params["critic"]}, observation))


def beyond_range(mean: jax.Array) -> jax.Array:
    """Computes how far a mean action lies beyond the range of commands.

    Args:
        mean: [B, U], -1..1 spans the commands.

    Returns:
        [B, U]: 0 within the range, below 0 under it, above 0 over it.
    """
    return mean - jnp.clip(mean, -1.0, 1.0)


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
