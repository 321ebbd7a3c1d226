"""Loads and checks an extension's network, which replaces the hidden layers."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from swarmjax.config import ConfigError
from swarmjax.config.foreign_code import explained
from swarmjax.extension import Network
from swarmjax.ppo.config import AlgoConfig, resolve


def load(config: AlgoConfig, networks: Sequence[Network], observation: int, state: int) -> Any:
    """Returns the class of the network that a config selects; None means hidden layers.

    Args:
      config: as for `resolve`.
      networks: as for `resolve`.
      observation: O, the size of an observation.
      state: P, how many numbers the critic sees in addition to an observation.

    Raises:
      ConfigError: the network is missing, fails or does not return features.
    """
    name = resolve(config, networks)
    torso = {piece.name: piece.function for piece in networks}.get(name)
    for size in {observation, observation + state} if torso else ():
        _check(torso, name, size)
    return torso


def _check(torso: Any, name: str, observation_size: int) -> None:
    """Refuses a network that fails, or does not turn [B, O] into [B, F]."""
    seen = jax.ShapeDtypeStruct((3, observation_size), jnp.float32)
    where = f"network {name}"
    with explained(f"{where} fails"):
        made = torso()
        found, variables = jax.eval_shape(made.init_with_output, jax.random.key(0), seen)
    other = sorted(set(variables) - {"params"})
    if other:
        raise ConfigError(f"{where} has {', '.join(other)}: give a network that has only params.")
    shape = getattr(found, "shape", ())
    if len(shape) != 2 or shape[0] != 3 or found.dtype != jnp.float32:
        kind = getattr(found, "dtype", type(found).__name__)
        raise ConfigError(
            f"{where} returns {kind} {list(shape)} for float32 [3, {observation_size}]: return "
            "float32 [3, F], where F is the number of features."
        )
