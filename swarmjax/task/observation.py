"""Observations: only this module defines which entries exist, and in which order.

`INPUTS` is the table of built-in entries. Other modules take names, units and sizes from `layout`.
To add an input, add one row to `INPUTS`, its names to `extension.TAKEN` and, if the input is a new
quantity, one field to `Readings`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from swarmjax import epuck
from swarmjax.extension import Observation

Array = Any
Encoding = Literal["metric", "webots"]


class Readings(NamedTuple):
    """Quantities that enter an observation, before scaling.

    Attributes:
      infrared: [..., K] m or counts, depending on the encoding.
      distance: [...] distance to the target, m.
      bearing: [...] bearing of the target, rad.
      own: [..., E] observations of an extension; None without any.
    """

    infrared: Array
    distance: Array
    bearing: Array
    own: Array | None = None


class Coding(NamedTuple):
    """How an encoding scales a quantity: (quantity - offset) / scale, all three in `unit`."""

    unit: str
    offset: float = 0.0
    scale: float = 1.0


class Input(NamedTuple):
    """One input of the policy, with one or more entries of the observation.

    Attributes:
      names: names of the entries.
      read: extracts the entries [..., len(names)] from the readings.
      codings: scaling for each encoding.
    """

    names: tuple[str, ...]
    read: Callable[[Readings], Array]
    codings: Mapping[Encoding, Coding]


# The paper speaks of ten inputs and names nine. We add the bearing, as in the published example
# that the task is based on. `webots` scales as find_and_avoid of deepworlds does (commit 60b8fc4a):
# counts / 1023 without clipping, distance / 1.5 m, and (bearing + pi) / (2 pi), so a scaled bearing
# of 0.5 is dead ahead.
INPUTS = (
    Input(
        ("infrared",),  # one entry for each sensor
        lambda readings: readings.infrared,
        {"metric": Coding("m"), "webots": Coding("counts", scale=1023.0)},
    ),
    Input(
        ("target_distance",),
        lambda readings: readings.distance[..., None],
        {"metric": Coding("m"), "webots": Coding("m", scale=1.5)},
    ),
    Input(
        ("target_bearing",),
        lambda readings: readings.bearing[..., None],
        {"metric": Coding("rad"), "webots": Coding("rad", -math.pi, 2.0 * math.pi)},
    ),
)


class Layout(NamedTuple):
    """Description of an observation's entries: each is (quantity - offset) / scale.

    Attributes:
      names: [O] names of the entries.
      units: [O] units of the quantities.
      offset: [O] offset of the quantities, in these units.
      scale: [O] scale of the quantities, in these units.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    offset: tuple[float, ...]
    scale: tuple[float, ...]

    @property
    def size(self) -> int:
        """Number of entries, O."""
        return len(self.names)


def names(sensors: int) -> list[tuple[str, Input]]:
    """Returns the names of the built-in entries, for a number of infrared sensors."""
    infrared, *others = INPUTS
    found = [(f"infrared_{i}", infrared) for i in range(sensors)]
    return found + [(name, each) for each in others for name in each.names]


def layout(
    encoding: Encoding, own: Sequence[Observation] = (), sensors: int = epuck.SENSORS
) -> Layout:
    """Lays out an observation: built-in inputs, then observations of an extension.

    Args:
      encoding: encoding of the built-in quantities.
      own: observations of an extension, in order.
      sensors: number of infrared sensors, K.

    Returns:
      The layout.
    """
    rows = [(name, *each.codings[encoding]) for name, each in names(sensors)]
    rows += [(name, each.unit, each.offset, each.scale) for each in own for name in each.names]
    return Layout(*zip(*rows, strict=True))


LAYOUTS = {encoding: layout(encoding) for encoding in get_args(Encoding)}
NAMES = LAYOUTS["metric"].names
SIZE = LAYOUTS["metric"].size


def describe(
    encoding: Encoding, own: Sequence[Observation] = (), sensors: int = epuck.SENSORS
) -> dict[str, Any]:
    """Describes the observation of a policy as plain data for its file.

    Args:
      encoding: encoding of the built-in quantities.
      own: observations of an extension.
      sensors: number of infrared sensors, K.

    Returns:
      `names`, `encoding`, and the layout's `units`, `offset` and `scale`.
    """
    parts = layout(encoding, own, sensors)._asdict()
    return {"encoding": encoding, **{key: list(values) for key, values in parts.items()}}


def to_target(pose: Array, target: Array, xp: Any) -> tuple[Array, Array]:
    """Computes distance and bearing of each robot's own target.

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


def observe(readings: Readings, layout: Layout, xp: Any) -> Array:
    """Assembles an observation in the order of the layout.

    Args:
      readings: the quantities.
      layout: names, units and scaling of the entries.
      xp: `numpy` or `jax.numpy`.

    Returns:
      [..., O] float32, scaled as in the layout.
    """
    parts = [each.read(readings) for each in INPUTS]
    parts += [] if readings.own is None else [readings.own]
    entries = xp.concatenate(parts, axis=-1).astype(xp.float32)
    offset, scale = (np.array(x, np.float32) for x in (layout.offset, layout.scale))
    if not offset.any() and (scale == 1.0).all():
        return entries
    return (entries - offset) / scale


class View(NamedTuple):
    """Exact state of one arena, the input of an extension's observations.

    Attributes:
      pose: [R, 3] x (m), y (m), yaw (rad).
      target: [R, 2] x (m), y (m).
      distance: [R] distance to the robot's own target, m.
      bearing: [R] bearing of the robot's own target, rad.
      infrared: [R, K] length of each ray, m.
      present: [R] whether the robot is present, bool.
      arrived: [R] whether the robot has arrived, bool; with `task.arrival=hold`, whether it is
        at its target now.
      side: [] side of the arena, m.
      obstacle: [M, 5] x (m), y (m), yaw (rad), half edges (m).
      obstacle_present: [M] bool.
      clock: [] control steps since the start, int32.
    """

    pose: Array
    target: Array
    distance: Array
    bearing: Array
    infrared: Array
    present: Array
    arrived: Array
    side: Array
    obstacle: Array
    obstacle_present: Array
    clock: Array
