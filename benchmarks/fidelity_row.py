"""Defines a row of the table of `benchmarks.fidelity`, and the sources of its numbers."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

PROTO = "Webots E-puck"
SENSOR = "Webots E-puckDistanceSensor"
GUIDE = "Webots e-puck guide"
WORLD = "Webots WorldInfo"
LARAL = "SALSA/FARSA phyepuck.cpp"
ENKI = "Enki EPuck.cpp"
ARGOS = "argos3-epuck"
GCTRONIC = "GCtronic epuck_driver"
ROS = "epuck_ros2"
FIRMWARE = "e-puck2_main-processor"
MEASURED = "Particle-Filter-for-e-puck"
XPUCK = "Xpuck, PMC7805610 table 3"
TOFFI = "toffi_real_epuck"
LIBRARY = "e-puck-library e_motors.c"
CLOSED = "closed form"
RIGID = "rigid bodies"


class Row(NamedTuple):
    """A reference number and our numbers for the same quantity.

    Attributes:
      section: section of the table.
      quantity: name of the quantity.
      unit: unit of all three numbers.
      theirs: reference number, for example of the real robot, of Webots or of a closed form; None
        if there is no reference number.
      source: source of `theirs`.
      planar: measured number of our planar body; None if the quantity does not apply.
      wheeled: measured number of our wheeled body; None if the quantity does not apply.
    """

    section: str
    quantity: str
    unit: str
    theirs: float | None
    source: str
    planar: float | None
    wheeled: float | None

    @property
    def error(self) -> float | None:
        """The largest relative error of our bodies; None if `theirs` is missing or zero."""
        ours = [value for value in (self.planar, self.wheeled) if value is not None]
        if not self.theirs or not ours:
            return None
        return max(abs(value - self.theirs) for value in ours) / abs(self.theirs)

    def line(self) -> dict[str, Any]:
        """Returns the row as plain data for JSON."""
        return self._asdict() | {"error": self.error}


def beside(
    section: str,
    quantity: str,
    unit: str,
    theirs: Mapping[str, float | None],
    ours: Iterable[float | None],
) -> list[Row]:
    """Makes rows that compare our numbers with the numbers of several sources.

    Args:
      section: section of the table.
      quantity: name of the quantity.
      unit: unit of all numbers.
      theirs: reference numbers by source.
      ours: [2] our numbers for the planar and for the wheeled body.

    Returns:
      A row for each source.
    """
    planar, wheeled = (None if value is None else float(value) for value in ours)
    return [
        Row(section, quantity, unit, number, source, planar, wheeled)
        for source, number in theirs.items()
    ]
