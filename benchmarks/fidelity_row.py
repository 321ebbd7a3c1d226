"""One row of the table of `benchmarks.fidelity`, and whose the figures beside ours are."""

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
    """A figure of theirs beside ours.

    Attributes:
      section: of the table.
      quantity: what it is.
      unit: of all three numbers.
      theirs: the real or Webots robot's, or what a closed form says; None where there is none.
      source: of that.
      planar: ours, as measured; None where the body has no such thing.
      wheeled: likewise.
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
        """Largest relative error of our bodies; None where nothing, or zero, is to be met."""
        ours = [value for value in (self.planar, self.wheeled) if value is not None]
        if not self.theirs or not ours:
            return None
        return max(abs(value - self.theirs) for value in ours) / abs(self.theirs)

    def line(self) -> dict[str, Any]:
        """Returns the row for JSON."""
        return self._asdict() | {"error": self.error}


def beside(
    section: str,
    quantity: str,
    unit: str,
    theirs: Mapping[str, float | None],
    ours: Iterable[float | None],
) -> list[Row]:
    """Puts a figure of ours beside those that several sources have.

    Args:
      section: of the table.
      quantity: what it is.
      unit: of all the numbers.
      theirs: by source.
      ours: [2] of the planar and the wheeled body.

    Returns:
      A row for each source.
    """
    planar, wheeled = (None if value is None else float(value) for value in ours)
    return [
        Row(section, quantity, unit, number, source, planar, wheeled)
        for source, number in theirs.items()
    ]
