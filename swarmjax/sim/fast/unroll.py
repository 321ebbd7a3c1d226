"""Processes a short axis of objects in slices, so that XLA makes one kernel of the computation.

On a GPU, a minimum over four obstacles becomes its own kernel, which reads its inputs from memory.
If objects are processed one at a time, all operations are elementwise, and XLA keeps the values in
registers.
"""

from typing import Any

import numpy as np

Array = Any
MOST = 16  # objects processed one by one; the program grows with their number


def pieces(count: int, xp: Any) -> list[slice]:
    """Splits an axis of objects into slices.

    Args:
      count: number of objects.
      xp: `numpy` or `jax.numpy`.

    Returns:
      Slices that cover the axis, one per object. A single slice for many objects, for none, and for
      NumPy, where every call costs time.
    """
    if xp is np or not 0 < count <= MOST:
        return [slice(None)]
    return [slice(i, i + 1) for i in range(count)]
