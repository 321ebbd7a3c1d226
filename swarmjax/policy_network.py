"""A policy's network whose code is in an extension file; its weights are in the policy file.

The network imports JAX when it is first called, so that other policies run without JAX.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from swarmjax import extension


class PolicyNetwork:
    """The part of a policy that turns normalised observations into the inputs of its last layers.

    It takes [..., R, O] and returns features [..., R, F]. The network can be sent to another
    process, which then loads the extension again.
    """

    def __init__(self, source: str, name: str, arrays: Mapping[str, np.ndarray]) -> None:
        """Stores the weights.

        Args:
          source: value of the key `extensions`.
          name: name of the network.
          arrays: the network's parameters [L, ...], by their paths in the Flax module.
        """
        self._source, self._name, self._arrays = source, name, dict(arrays)
        self._apply: Callable[[np.ndarray], Any] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_apply": None}

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Computes features [..., R, F] of normalised observations [..., R, O]."""
        if self._apply is None:
            self._apply = self._compile()
        flat = x.reshape(-1, *x.shape[-2:])
        features = np.asarray(self._apply(flat))
        return features.reshape(*x.shape[:-1], features.shape[-1])

    @property
    def params(self) -> dict[str, Any]:
        """Parameters [L, ...], nested as in the Flax module."""
        nested: dict[str, Any] = {}
        for path, array in self._arrays.items():
            *parts, last = path.split("/")
            inner = nested
            for part in parts:
                inner = inner.setdefault(part, {})
            inner[last] = array
        return nested

    @property
    def module(self) -> Any:
        """The Flax module."""
        networks = extension.load(self._source).networks
        return next(piece for piece in networks if piece.name == self._name).function()

    def _compile(self) -> Callable[[np.ndarray], Any]:
        import jax

        return jax.jit(partial(features, self.module, self.params))


def features(module: Any, params: Any, x: Any) -> Any:
    """Applies a network to several arenas at once, with JAX.

    Args:
      module: Flax module.
      params: [L, ...] the module's parameters. L is 1 if all robots share one learner; otherwise
        robot i uses learner i.
      x: [B, R, O] normalised observations.

    Returns:
      [B, R, F] features.
    """
    import jax

    def one(mine: Any, seen: Any) -> Any:
        return module.apply({"params": mine}, seen)

    if jax.tree.leaves(params)[0].shape[0] == 1:
        return one(jax.tree.map(lambda leaf: leaf[0], params), x)
    mine = jax.tree.map(lambda leaf: leaf[: x.shape[-2]], params)
    return jax.vmap(one, in_axes=(0, 1), out_axes=1)(mine, x)
