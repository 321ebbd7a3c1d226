"""Computes signed gaps between hulls and the objects around them, and counts contacts."""

from typing import Any

from swarmjax.sim.dispatch import least, pieces
from swarmjax.sim.infrared import Box, to_box_frame, turned
from swarmjax.sim.neighbours import Near, others

Array = Any
KINDS = ("robot", "obstacle", "wall")  # the last axis of gaps and contacts
CONTACT_PAUSE = 0.1  # s; a contact interrupted for less than this is still the same contact


def gaps(
    pose: Array,
    side: Array,
    obstacle: Array,
    hull_radius: float,
    xp: Any,
    near: Near | None = None,
) -> Array:
    """Computes the gap from each hull to the nearest object of each kind; overlap is negative.

    Args:
      pose: [R, 3] x (m), y (m), yaw (rad); absent robots are parked far away.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      hull_radius: m.
      xp: `numpy` or `jax.numpy`.
      near: the robots near each robot; None compares all pairs.

    Returns:
      [R, 3] m, in the order of `KINDS`; `inf` if there is no object of that kind. With `near`, a
      gap between robots is exact up to the `limit` that `near` was found with; a larger gap is
      returned as any number above that limit, or as `inf`. Contacts need no more, since their gaps
      are at most 0.
    """
    x, y = pose[:, :1], pose[:, 1:2]
    other_x, other_y, myself = others(pose, near, xp)

    def to_robots(i: slice) -> Array:
        across, along = x - other_x[:, i], y - other_y[:, i]
        return xp.where(myself[:, i], xp.inf, xp.sqrt(across * across + along * along))

    robots = (to_robots(i) for i in pieces(myself.shape[-1], xp))
    box = turned(obstacle, xp)
    boxes = (_box_distance(x, y, box.at((None, i)), xp) for i in pieces(len(obstacle), xp))
    found = (
        least(robots, xp.inf, xp) - 2.0 * hull_radius,
        least(boxes, xp.inf, xp) - hull_radius,
        0.5 * side - xp.maximum(xp.abs(x), xp.abs(y))[:, 0] - hull_radius,
    )
    return xp.stack(found, axis=-1)


def _box_distance(x: Array, y: Array, box: Box, xp: Any) -> Array:
    """Returns signed distances [...] from points to rotated rectangles, m."""
    x, y = to_box_frame(x - box.x, y - box.y, box)
    x, y = xp.abs(x) - box.half_x, xp.abs(y) - box.half_y
    outside = xp.sqrt(xp.maximum(x, 0.0) ** 2 + xp.maximum(y, 0.0) ** 2)
    return outside + xp.minimum(xp.maximum(x, y), 0.0)


def count_contacts(gap: Array, apart: Array, control_step: float, xp: Any) -> tuple[Array, Array]:
    """Counts contacts: a contact begins when a gap closes after it has been open for a while.

    Args:
      gap: [..., R, 3] current gaps, m.
      apart: [..., R, 3] for how long each gap had been open before now, s.
      control_step: s.
      xp: `numpy` or `jax.numpy`.

    Returns:
      Two arrays [..., R, 3]: whether a contact begins now, and the new `apart`.
    """
    touching = gap <= 0.0
    # Subtract half a control step, because rounded sums of control steps may just miss the pause.
    begins = touching & (apart > CONTACT_PAUSE - 0.5 * control_step)
    return begins, xp.where(touching, 0.0, apart + control_step)
