"""Which objects are nearest."""

from typing import Any

Array = Any


def nearest(distance: Array, count: int, xp: Any) -> Array:
    """Orders objects by distance.

    It counts how many objects are nearer than each one. On a CPU, this is faster than sorting rows
    this short (docs/performance.md).

    Args:
      distance: [..., N] of N objects, m; inf comes last. If any is NaN, the indices have no
        meaning, but lie within 0 to N - 1.
      count: how many objects to return, at most N.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., count] indices, nearest first. Of two objects at the same distance, the first one comes
      first.
    """
    index = xp.arange(distance.shape[-1])
    other, one = distance[..., None, :], distance[..., :, None]
    nearer = (other < one) | ((other == one) & (index < index[:, None]))
    rank = nearer.sum(axis=-1)
    return xp.argmax(rank[..., None, :] == xp.arange(count)[:, None], axis=-1)
