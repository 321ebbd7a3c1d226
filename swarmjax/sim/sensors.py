"""Checks settings of the infrared sensors: their poses, their range and their response."""

import itertools
import math

from swarmjax.config import ConfigError, show

Pose = tuple[float, float, float]  # x (m), y (m), yaw (rad)
Point = tuple[float, float, float]  # ray length (m), value, relative deviation
MOST = 32  # most sensors of a robot; a lidar has more rays and needs other code
MOST_YAW = 6.2832  # rad; a full turn
MOST_VALUE = 1e6  # largest counts of a sensor
_ROUNDING = 1e-9  # m; rounding error allowed, as a sensor may sit exactly on the hull's surface


def way_to_hull(pose: Pose, hull_radius: float) -> float:
    """Returns the length of a ray, in m, from its sensor to the surface of its own robot's hull.

    Args:
      pose: place and direction of the sensor.
      hull_radius: m.
    """
    x, y, yaw = pose
    outward = x * math.cos(yaw) + y * math.sin(yaw)
    spare = max(0.0, hull_radius**2 - x**2 - y**2)
    return math.sqrt(outward**2 + spare) - outward


def check_poses(poses: tuple[Pose, ...], hull_radius: float, reach: float) -> None:
    """Refuses sensors outside the hull, and sensors that see nothing beyond it.

    Args:
      poses: place and direction of each sensor.
      hull_radius: m.
      reach: range of the sensors, m.

    Raises:
      ConfigError: there are too few or too many sensors, a sensor lies outside the hull, a yaw is
        too large, or a ray ends within its own hull.
    """
    if not 1 <= len(poses) <= MOST:
        raise ConfigError(f"sensor_poses has {len(poses)} sensors: give 1 to {MOST}.")
    for i, pose in enumerate(poses):
        away = math.hypot(*pose[:2])
        if away > hull_radius + _ROUNDING:
            raise ConfigError(
                f"sensor_poses puts sensor {i} at {show(pose)}, {away:.6f} m from the middle, but "
                f"hull_radius is {show(hull_radius)}: move the sensor to at most "
                f"{show(hull_radius)} m (round x and y towards 0), or give a larger hull."
            )
        if abs(pose[2]) > MOST_YAW:
            raise ConfigError(
                f"sensor_poses holds {show(pose)} for sensor {i}, whose last number is its yaw in "
                f"radians: give a yaw of {-MOST_YAW:.4f} to {MOST_YAW:.4f}."
            )
        within = way_to_hull(pose, hull_radius)
        if within >= reach:
            raise ConfigError(
                f"sensor_range is {show(reach)}, but the ray of sensor {i}, {show(pose)}, runs "
                f"{within:.4g} m within its own hull and would see nothing: give a larger range, "
                "or turn or move the sensor outwards."
            )


def check_response(points: tuple[Point, ...]) -> None:
    """Refuses a table that does not assign one value to each length and one length to each value.

    Args:
      points: rows of ray length (m), value and relative deviation; the shortest length comes first.

    Raises:
      ConfigError: there are fewer than two rows, lengths do not increase, or values do not
        decrease.
    """
    pairs = itertools.pairwise(points)
    if len(points) < 2 or any(a[0] >= b[0] or a[1] <= b[1] for a, b in pairs):
        raise ConfigError(
            f"sensor_response is {show(points)}: give two or more rows [distance, value, relative "
            "deviation], with rising distances and falling values."
        )
