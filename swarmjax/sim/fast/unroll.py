"""Going through a short axis of things, so that XLA makes one kernel of what follows.

On a GPU the minimum over four obstacles is a kernel of its own, which reads what leads to it from
memory. Taken one thing after the other all is elementwise, and XLA keeps it in registers.
"""

from typing import Any

import numpy as np

Array = Any
MOST = 16  # things that are taken one by one; a program grows with their number


def pieces(count: int, xp: Any) -> list[slice]:
    """Cuts an axis of things up.

    Args:
      count: how many things there are.
      xp: `numpy` or `jax.numpy`.

    Returns:
      Slices that cover the axis: of one thing each, or one of all where there are many or none,
      and for NumPy, which pays for every call.
    """
    if xp is np or not 0 < count <= MOST:
        return [slice(None)]
    return [slice(i, i + 1) for i in range(count)]
