"""Signed gaps between hulls and what they may touch, and contacts counted from them."""

from typing import Any

import numpy as np

from swarmjax.sim.infrared import to_box_frame

Array = Any
KINDS = ("robot", "obstacle", "wall")  # the last axis of gaps and contacts
CONTACT_PAUSE = 0.1  # s; shorter separations are one contact that bounces


def gaps(pose: Array, side: Array, obstacle: Array, hull_radius: float, xp: Any) -> Array:
    """Gap from each hull to the nearest thing of each kind; below 0 they overlap.

    Args:
      pose: [R, 3] x (m), y (m), yaw (rad); absent robots are parked far away.
      side: [] of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      hull_radius: m.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [R, 3] m, in the order of `KINDS`; `inf` where there is nothing of the kind.
    """
    place = pose[:, :2]
    apart = xp.sqrt(xp.sum((place[:, None] - place[None, :]) ** 2, axis=-1)) - 2.0 * hull_radius
    apart = xp.where(np.eye(place.shape[0], dtype=bool), xp.inf, apart)
    robot = xp.min(apart, axis=-1, initial=xp.inf)
    box = xp.min(_box_distance(place[:, None], obstacle[None], xp), axis=-1, initial=xp.inf)
    wall = 0.5 * side - xp.max(xp.abs(place), axis=-1)
    return xp.stack([robot, box - hull_radius, wall - hull_radius], axis=-1)


def _box_distance(place: Array, box: Array, xp: Any) -> Array:
    """Signed distance [...] from points [..., 2] to turned rectangles [..., 5], m."""
    local = to_box_frame(place - box[..., :2], box[..., 2], xp)
    beyond = xp.abs(local) - box[..., 3:]
    outside = xp.sqrt(xp.sum(xp.maximum(beyond, 0.0) ** 2, axis=-1))
    return outside + xp.minimum(xp.max(beyond, axis=-1), 0.0)


def count_contacts(gap: Array, apart: Array, control_step: float, xp: Any) -> tuple[Array, Array]:
    """Counts contacts: a gap that closes after the robot was free of the kind for a while.

    Args:
      gap: [..., R, 3] now, m.
      apart: [..., R, 3] for how long the gap has been open, s.
      control_step: s.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., R, 3] whether a contact begins, and the new `apart`.
    """
    touching = gap <= 0.0
    # Half a step of slack: sums of control steps do not meet the pause to the last bit.
    begins = touching & (apart > CONTACT_PAUSE - 0.5 * control_step)
    return begins, xp.where(touching, 0.0, apart + control_step)
