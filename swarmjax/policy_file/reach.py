"""Checks that no action of a policy can leave float32, whatever the robot observes."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from swarmjax.policy import PolicyError

_LARGEST = float(np.finfo(np.float32).max)


def check_reach(arrays: Mapping[str, np.ndarray], depth: int, meta: Mapping[str, Any]) -> None:
    """Refuses weights with which a sum could overflow float32, and an action become NaN.

    The bound of a layer's output is the largest sum of its weights' magnitudes, times the bound of
    its input, plus the largest bias. The bound of an activation is that of its input, or 1
    for tanh. Nothing is known of a network that is code.

    Args:
      arrays: the arrays of a policy by name, with sound shapes.
      depth: number of hidden layers.
      meta: the description of the policy, with sound fields.

    Raises:
      PolicyError: if a bound is not a number of float32.
    """

    def out(layer: str, bound: float) -> float:
        kernel, bias = (arrays[f"actor/{layer}/{part}"] for part in ("kernel", "bias"))
        sums = np.abs(kernel).sum(axis=1, dtype=np.float64)
        most = bound * float(sums.max()) + float(np.abs(bias).max())
        if not most <= _LARGEST:
            raise PolicyError(
                f"actor/{layer} has weights up to {np.abs(kernel).max():.3g} and biases up to "
                f"{np.abs(bias).max():.3g}: expected smaller ones, since sums could reach "
                f"{most:.3g}, and float32 holds at most {_LARGEST:.3g}."
            )
        return most

    def active(bound: float) -> float:
        return 1.0 if meta["activation"] == "tanh" else bound

    if any(name.startswith("network/") for name in arrays):
        return
    bound = float(meta["observation"]["limit"])
    for i in range(depth):
        bound = active(out(f"hidden_{i}", bound))
    if "actor/memory/input/kernel" in arrays:
        out("memory/input", bound)
        out("memory/recurrent", 1.0)  # a memory is a mean of numbers within -1 and 1
        bound = max(bound, 1.0)
    out("mean", bound)
