"""What a robot observes: eight infrared distances, and where its target is."""

import math
from typing import Any, NamedTuple

import numpy as np

from swarmjax import epuck

Array = Any
SENSORS = epuck.SENSORS

# Name of each entry, in order. The paper says ten and names nine; the tenth is the bearing, as in
# the published example that the task comes from.
NAMES = (*(f"infrared_{i}" for i in range(SENSORS)), "target_distance", "target_bearing")
SIZE = len(NAMES)


class Layout(NamedTuple):
    """What the entries are: (quantity - offset) / scale.

    Attributes:
      units: [O] of the quantities.
      offset: [O] in these units.
      scale: [O] in these units.
    """

    units: tuple[str, ...]
    offset: tuple[float, ...]
    scale: tuple[float, ...]


LAYOUTS = {
    "metric": Layout((*["m"] * SENSORS, "m", "rad"), (0.0,) * SIZE, (1.0,) * SIZE),
    # deepworlds, find_and_avoid (commit 60b8fc4a): counts / 1023, not clipped; distance / 1.5 m;
    # (bearing + pi) / (2 pi), so that 0.5 is dead ahead.
    "webots": Layout(
        (*["counts"] * SENSORS, "m", "rad"),
        (*[0.0] * SENSORS, 0.0, -math.pi),
        (*[1023.0] * SENSORS, 1.5, 2.0 * math.pi),
    ),
}


def describe(encoding: str) -> dict[str, Any]:
    """Describes what a policy observes, as plain data for its file.

    Args:
      encoding: one of `LAYOUTS`.

    Returns:
      `names`, `encoding`, and the layout's `units`, `offset` and `scale`.
    """
    layout = {key: list(value) for key, value in LAYOUTS[encoding]._asdict().items()}
    return {"names": list(NAMES), "encoding": encoding, **layout}


def to_target(pose: Array, target: Array, xp: Any) -> tuple[Array, Array]:
    """Distance and bearing of each robot's own target.

    Args:
      pose: [..., 3] x (m), y (m), yaw (rad).
      target: [..., 2] x (m), y (m).
      xp: `numpy` or `jax.numpy`.

    Returns:
      Distance [...] (m), and bearing [...] from the robot's x axis (rad, -pi..pi, left positive).
    """
    x, y = target[..., 0] - pose[..., 0], target[..., 1] - pose[..., 1]
    cos, sin = xp.cos(pose[..., 2]), xp.sin(pose[..., 2])
    bearing = xp.arctan2(cos * y - sin * x, cos * x + sin * y)
    return xp.sqrt(x * x + y * y), bearing


def observe(infrared: Array, distance: Array, bearing: Array, layout: Layout, xp: Any) -> Array:
    """Puts an observation together in the order of `NAMES`.

    Args:
      infrared: [..., K] in the layout's unit.
      distance: [...] to the target, m.
      bearing: [...] of the target, rad.
      layout: what the entries are.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., O] float32, scaled as the layout says.
    """
    target = xp.stack([distance, bearing], axis=-1)
    entries = xp.concatenate([infrared, target], axis=-1).astype(xp.float32)
    if layout == LAYOUTS["metric"]:
        return entries
    offset, scale = (np.array(x, np.float32) for x in (layout.offset, layout.scale))
    return (entries - offset) / scale
