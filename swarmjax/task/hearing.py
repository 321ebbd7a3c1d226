"""Range and bearing of neighbours.

A robot receives a neighbour's distance and its bearing. The model
follows the e-puck's infrared board for local communication (Gutiérrez et al. 2009, "Open E-puck
Range & Bearing miniaturized board for local communication in swarm robotics") and AutoMoDe's
reference models. Inner walls and boxes block reception; other robots do not. The code runs on NumPy
or JAX.
"""

from typing import Any, NamedTuple

import numpy as np

from swarmjax.sim import infrared, noise
from swarmjax.sim.noise import Stream
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task.config import NEIGHBOUR_SIZE, NeighboursConfig
from swarmjax.task.nearest import nearest

Array = Any


class Heard(NamedTuple):
    """Neighbours within reach.

    Attributes:
      distance: [..., R, R] distance from the receiver (first axis of the two) to the sender, m; inf
        without reception.
      bearing: [..., R, R] bearing of the sender, from the receiver's x axis, rad.
    """

    distance: Array
    bearing: Array


def reachable(
    pose: Array,
    present: Array,
    hidden: Array,
    settings: NeighboursConfig,
    xp: Any,
) -> Heard:
    """Determines which robots can receive which others.

    Args:
      pose: [..., R, 3] x (m), y (m), yaw (rad).
      present: [..., R] whether the robot is present.
      hidden: [..., R, R] whether a wall or a box lies between two robots.
      settings: range.
      xp: `numpy` or `jax.numpy`.

    Returns:
      The neighbours within reach.
    """
    x, y, distance = _apart(pose, xp)
    bearing = xp.arctan2(y, x) - pose[..., :, None, 2]
    other = ~np.eye(pose.shape[-2], dtype=bool)
    hears = (
        present[..., :, None]
        & present[..., None, :]
        & other
        & ~hidden
        & (distance <= settings.range)
    )
    return Heard(xp.where(hears, distance, xp.inf), bearing)


def hidden(pose: Array, obstacle: Array, xp: Any) -> Array:
    """Returns whether a wall or a box crosses the line between two robots' centres.

    Args:
      pose: [..., R, 3] x (m), y (m), yaw (rad).
      obstacle: [..., M, 5] x (m), y (m), yaw (rad), half edges (m).
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., R, R] bool.
    """
    x, y, distance = _apart(pose, xp)
    pace = 1.0 / xp.maximum(distance, 1e-9)
    shape = distance.shape
    here = (xp.broadcast_to(pose[..., :, None, axis], shape) for axis in range(2))
    ray = infrared.Ray(*(part[..., None] for part in (*here, x * pace, y * pace)))
    box = infrared.turned(obstacle, xp).at((..., None, None, slice(None)))
    return (infrared.ray_box(ray, box, xp) < distance[..., None]).any(axis=-1)


def _apart(pose: Array, xp: Any) -> tuple[Array, Array, Array]:
    """Returns offsets x and y [..., R, R] from each robot to all others, and the distances (m)."""
    x, y = (pose[..., None, :, axis] - pose[..., :, None, axis] for axis in range(2))
    return x, y, xp.sqrt(x * x + y * y)


def listen(
    heard: Heard,
    settings: NeighboursConfig,
    realism: RealismConfig,
    seed: Array | None,
    clock: Array,
    xp: Any,
) -> Array:
    """Lists each robot's nearest neighbours, counting only those whose packets arrive.

    Args:
      heard: the neighbours within reach.
      settings: number of neighbours to list.
      realism: packet loss and noise.
      seed: [...] uint32 of the episode; None without randomness.
      clock: [...] or [] control steps since the start.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., R, 4 K], nearest first. The numbers of a neighbour are a presence flag of 1, its
      distance (m), and cosine and sine of its bearing. Missing neighbours are 0.
    """
    distance, bearing = heard
    robots = distance.shape[-1]
    lost = _draw(realism.packet_loss, noise.uniform, seed, clock, Stream.PACKET, robots, xp)
    if lost is not None:
        distance = xp.where(lost < realism.packet_loss, xp.inf, distance)
    kept = min(settings.count, robots)
    order = nearest(distance, kept, xp)
    is_there = xp.isfinite(xp.take_along_axis(distance, order, axis=-1))
    parts = [distance, xp.cos(bearing), xp.sin(bearing)]
    rows = [is_there, *(xp.take_along_axis(part, order, axis=-1) for part in parts)]
    found = xp.stack([xp.where(is_there, row, 0.0) for row in rows], axis=-1)
    found = found.reshape((*found.shape[:-2], kept * NEIGHBOUR_SIZE))
    lacking = (settings.count - kept) * NEIGHBOUR_SIZE
    missing = xp.zeros((*found.shape[:-1], lacking), found.dtype)
    return xp.concatenate([found, missing], axis=-1) if lacking else found


def _draw(
    size: float | None,
    draw: Any,
    seed: Array | None,
    clock: Array,
    stream: Stream,
    robots: int,
    xp: Any,
) -> Array | None:
    """Draws numbers [..., R, R] if their factor is on; the first axis is the receiver.

    The numbers of a pair do not depend on the number of robots.
    """
    if size is None:
        return None
    receiver = noise.bits(seed, clock, stream, (robots,), xp)
    return draw(receiver, 0, stream, (robots,), xp)
