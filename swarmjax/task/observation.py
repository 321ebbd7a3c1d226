"""What a robot observes: eight infrared distances, and where its target is."""

from typing import Any

from swarmjax import epuck

Array = Any

# Name and unit of each entry, in order. The paper says ten and names nine; the tenth is the
# bearing, as in the published example that the task comes from.
NAMES = (*(f"infrared_{i}" for i in range(epuck.SENSORS)), "target_distance", "target_bearing")
UNITS = (*("m" for _ in range(epuck.SENSORS)), "m", "rad")
SIZE = len(NAMES)


def to_target(pose: Array, target: Array, xp: Any) -> tuple[Array, Array]:
    """Distance and bearing of each robot's own target.

    Args:
      pose: [..., 3] x (m), y (m), yaw (rad).
      target: [..., 2] x (m), y (m).
      xp: `numpy` or `jax.numpy`.

    Returns:
      Distance [...] (m), and bearing [...] from the robot's x axis (rad, -pi..pi, left positive).
    """
    offset = target - pose[..., :2]
    distance = xp.sqrt(xp.sum(offset * offset, axis=-1))
    cos, sin = xp.cos(pose[..., 2]), xp.sin(pose[..., 2])
    ahead = cos * offset[..., 0] + sin * offset[..., 1]
    left = cos * offset[..., 1] - sin * offset[..., 0]
    return distance, xp.arctan2(left, ahead)


def observe(infrared: Array, distance: Array, bearing: Array, xp: Any) -> Array:
    """Puts an observation together in the order of `NAMES`.

    Args:
      infrared: [..., K] m.
      distance: [...] to the target, m.
      bearing: [...] of the target, rad.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., O] float32, unscaled.
    """
    target = xp.stack([distance, bearing], axis=-1)
    return xp.concatenate([infrared, target], axis=-1).astype(xp.float32)
