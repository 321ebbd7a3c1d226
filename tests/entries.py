"""Indices of the quantities in an observation, for tests that look into observations."""

import numpy as np

from swarmjax import epuck
from swarmjax.task import observation

_FIRST = observation.NAMES.index("infrared_0")
INFRARED = slice(_FIRST, _FIRST + epuck.SENSORS)  # entries of one input lie side by side
DISTANCE = observation.NAMES.index("target_distance")
BEARING = observation.NAMES.index("target_bearing")
TARGET = np.array([DISTANCE, BEARING])
KNOWN = np.array([*range(INFRARED.start, INFRARED.stop), *TARGET])


def by_name(
    names: tuple[str, ...], infrared: float, distance: float, bearing: float, other: float
) -> np.ndarray:
    """Returns a number for each entry [O]; `other` is the number of all entries not named here."""
    known = {f"infrared_{i}": infrared for i in range(epuck.SENSORS)}
    known |= {"target_distance": distance, "target_bearing": bearing}
    return np.array([known.get(name, other) for name in names])
