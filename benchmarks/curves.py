"""Figures of learning curves: the area under them, and the steps to a threshold."""

import math

import numpy as np
from numpy.typing import ArrayLike

from swarmjax.evaluate.statistics import checked


def area_under(steps: ArrayLike, values: ArrayLike) -> np.ndarray:
    """Computes the mean height of learning curves: area (by trapezoids) divided by width.

    Args:
      steps: [points] the steps at which the curves have their points, rising.
      values: [..., points] finite values of the curves, in any unit.

    Returns:
      [...] in the unit of values.

    Raises:
      ValueError: There are fewer than two points, steps do not rise, or a number is not finite.
    """
    at, curves = _curves(steps, values)
    return np.asarray(np.trapezoid(curves, at, axis=-1) / (at[-1] - at[0]))


def steps_to(steps: ArrayLike, values: ArrayLike, threshold: float) -> np.ndarray:
    """Computes the steps until learning curves first reach a threshold, even if they fall again.

    Curves are straight between their points. A noisy curve touches a threshold early, so its values
    should be means over enough episodes.

    Args:
      steps: [points] the steps at which the curves have their points, rising.
      values: [..., points] finite values of the curves, in any unit.
      threshold: threshold to reach from below, in the same unit.

    Returns:
      [...] in the unit of steps: the first step if a curve begins at the threshold, inf if a curve
      never reaches the threshold. `iqm`, `np.median` and `probability_of_improvement` accept inf.

    Raises:
      ValueError: There are fewer than two points, steps do not rise, or a number is not finite.
    """
    if not math.isfinite(threshold):
        raise ValueError(f"threshold is {threshold}: give a finite number.")
    at, curves = _curves(steps, values)
    reached = curves >= threshold
    after = reached.argmax(axis=-1)
    before = np.maximum(after - 1, 0)
    low, high = (np.take_along_axis(curves, i[..., None], -1)[..., 0] for i in (before, after))
    share = (threshold - low) / np.where(high > low, high - low, 1.0)
    return np.where(reached.any(axis=-1), at[before] + share * (at[after] - at[before]), np.inf)


def _curves(steps: ArrayLike, values: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Converts the points of curves; refuses unequal lengths and numbers that are not finite."""
    at, curves = checked("steps", steps), checked("values", values)
    if at.ndim != 1 or len(at) < 2 or not (np.diff(at) > 0).all():
        raise ValueError(f"steps of shape {at.shape} must be two or more numbers that rise.")
    if curves.shape[-1:] != at.shape:
        raise ValueError(
            f"values has shape {curves.shape}: give [..., {len(at)}], one value for each step."
        )
    for name, numbers in (("steps", at), ("values", curves)):
        if np.isinf(numbers).any():
            raise ValueError(f"{name} holds inf: the points of a curve are finite.")
    return at, curves
