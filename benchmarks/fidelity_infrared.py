"""Measures the infrared sensors: their directions, their counts, and the fit to measurements."""

import math
from collections.abc import Callable, Sequence
from functools import partial

import mujoco
import numpy as np

from benchmarks import fidelity_rig as rig
from benchmarks.fidelity_rig import (
    ARGOS,
    CLOSED,
    MEASURED,
    SENSOR,
    XPUCK,
    Rig,
    Row,
    beside,
    cast,
)
from swarmjax import epuck
from swarmjax.sim import infrared, noise, response
from swarmjax.sim.infrared import Reflectance
from swarmjax.sim.noise import Stream
from swarmjax.sim.response import Response, Wear

HULL = 0.037  # m
FREE = 67.19  # counts of Webots' sensor with nothing in sight
# For each sensor ps0 to ps7: x (m), y (m), yaw (degrees), and the distance to the hull along the
# ray (mm). Source: Webots E-puck, computed from its axis-angle rotations.
POSES = (
    (0.030, -0.010, -17.235, 5.38),
    (0.022, -0.025, -45.883, 3.70),
    (0.000, -0.031, -90.000, 6.00),
    (-0.030, -0.015, -151.489, 3.46),
    (-0.030, 0.015, 151.215, 3.46),
    (0.000, 0.031, 90.000, 6.00),
    (0.022, 0.025, 45.791, 3.70),
    (0.030, 0.010, 17.143, 5.38),
)
# Length of a ray (m), counts, and the counts' standard deviation as a share of the counts. Source:
# Webots E-puckDistanceSensor.
TABLE = (
    (0.000, 4095.00, 0.00200),
    (0.005, 2133.33, 0.00300),
    (0.010, 1465.73, 0.00700),
    (0.015, 601.46, 0.04060),
    (0.020, 383.84, 0.01472),
    (0.030, 234.93, 0.02410),
    (0.040, 158.03, 0.02870),
    (0.050, 120.00, 0.04225),
    (0.060, 104.09, 0.03065),
    (0.070, 67.19, 0.04897),
)
INVERSE = (
    (80.0, 66.5),
    (100.0, 61.1),
    (158.03, 40.0),
    (200.0, 34.5),
    (350.0, 22.3),
    (500.0, 17.3),
    (1000.0, 12.7),
    (1023.0, 12.6),
)  # counts, length of a ray (mm)
# Gap between the hull and a wall ahead (mm), counts of ps0, counts of ps1. The counts are computed
# from `POSES` and `TABLE`.
BEFORE_A_WALL = (
    (0, 1809.7, 356.6),
    (5, 994.4, 248.3),
    (10, 469.6, 185.9),
    (15, 334.2, 144.1),
    (20, 255.3, 118.5),
    (25, 204.6, 106.9),
    (30, 163.9, 83.9),
    (35, 140.8, 67.2),
    (40, 120.6, 67.2),
    (50, 102.4, 67.2),
)
SIMULATORS: tuple[str, ...] = ("Webots", "GCtronic", "Enki", "ARGoS")
# Distance (mm), then the counts of each simulator. The simulators measure the distance from points
# that are 3 to 6 mm apart.
CURVES = (
    (5, 2133, 4095, 3501, 3706),
    (10, 1466, 2500, 2069, 3043),
    (20, 384, 625, 650, 1899),
    (30, 235, 278, 288, 1000),
    (40, 158, 156, 159, 345),
    (50, 120, 100, 100, 0),
    (70, 67, 51, 50, 0),
)
# Gap (cm), then the counts minus the counts at 7 cm, as a mean over the eight measured sensors.
NET = ((1, 957), (2, 292), (3, 115), (4, 48), (5, 23), (6, 9))
SAMPLES = 100_000
_RISE = math.cos(0.16)  # horizontal length of a ray divided by its length
_WALL = 0.5 * rig.SIDE
_NO_BOX = np.zeros((0, 5))


def rows(planar: Rig, wheeled: Rig) -> list[Row]:
    """Measures all rows."""
    both = planar, wheeled
    return [
        *_poses(both),
        *_table(),
        *_before_a_wall(both),
        *_reflectance(),
        *_noise(),
        *_measured(),
        *_elsewhere(),
    ]


# Rays and counts of a sensor


def see(bench: Rig, gap: float) -> np.ndarray:
    """Casts the sensors' rays with MuJoCo, from a robot that faces a wall.

    Args:
      bench: the rig.
      gap: gap between hull and wall, m.

    Returns:
      Horizontal distances [K] from the sensors to what their rays hit, m; `inf` without a hit.
    """
    place = _WALL - HULL - gap
    data = rig.place(bench, x=place)
    origin, direction = infrared.rays(np.array([place, 0.0, 0.0]), np)
    flat = np.zeros((epuck.SENSORS, 1))
    # The sensors' height includes the robot's current height above the floor.
    height = flat + epuck.SENSOR_HEIGHT + data.body("robot0").xpos[2]
    toward = np.concatenate([direction, flat], axis=-1)
    reach, met = np.zeros(epuck.SENSORS), np.zeros(epuck.SENSORS, np.int32)
    for i, start in enumerate(np.concatenate([origin, height], axis=-1)):
        hull = bench.model.body("robot0").id
        reach[i] = mujoco.mj_ray(
            bench.model, data, start, toward[i], rig.SEEN, True, hull, met[i : i + 1]
        )
    return np.where(reach < 0.0, np.inf, reach)


def counts(name: Response, ray: np.ndarray | float, sensor: int = 0) -> np.ndarray:
    """Returns the counts [...] that a sensor reports for rays [...] (m), without noise."""
    rays = np.asarray(ray, float)[..., None] * np.ones(epuck.SENSORS)
    return response.expected(name, rays, np)[..., sensor]


def at_gap(gap: np.ndarray) -> np.ndarray:
    """Returns the counts [..., K] of the sensors, each with an object ahead at gaps [...] (m)."""
    to_hull = np.array([way for *_, way in POSES]) * 1e-3
    return response.expected("real", np.asarray(gap)[..., None] + to_hull, np)


def falls_to(reading: Callable[[float], float], level: float) -> float:
    """Finds the largest distance, at most 0.1 m, at which a falling reading exceeds a level."""
    low, high = 0.0, 0.1
    while high - low > 1e-7:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if reading(middle) > level else (low, middle)
    return low


def other_robot(length: float, reflectance: float) -> float:
    """Returns the counts of ps0 with another robot's hull in front of it.

    Args:
      length: length of the tilted ray, m.
      reflectance: reflectance of the other robot.

    Returns:
      Counts.
    """
    x, y, yaw, _ = POSES[0]
    away = length * _RISE + HULL
    bearing = math.radians(yaw)
    pose = np.array(
        [[0.0, 0.0, 0.0], [x + away * math.cos(bearing), y + away * math.sin(bearing), 0.0]]
    )
    shade = Reflectance(robot=np.array([1.0, reflectance]))
    side, reach = np.array(rig.SIDE), response.REACH["webots"]
    ray, bright = infrared.sights(pose, side, _NO_BOX, HULL, reach, shade, infrared.EPUCK)
    return float(response.read("webots", ray, bright, Wear(), None, np)[0, 0])


def analytic_error(benches: Sequence[Rig]) -> list[float]:
    """Returns each rig's largest difference between training's and MuJoCo's rays at a wall, m."""
    found = []
    for bench in benches:
        worst = 0.0
        for gap, *_ in BEFORE_A_WALL:
            pose, side = np.array([[_WALL - HULL - 1e-3 * gap, 0.0, 0.0]]), np.array(rig.SIDE)
            ray = infrared.distances(pose, side, _NO_BOX, HULL, 0.1, np)[0]
            worst = max(worst, float(np.abs(ray - np.minimum(see(bench, 1e-3 * gap), 0.1)).max()))
        found.append(worst)
    return found


# Rows


def _poses(both: Sequence[Rig]) -> list[Row]:
    row, found = partial(beside, "Infrared: where it looks"), []
    origin, direction = infrared.rays(np.zeros(3), np)
    yaw = np.degrees(np.arctan2(direction[:, 1], direction[:, 0]))
    for i, (x, y, bearing, way) in enumerate(POSES):
        hulls = [1e3 * _to_hull(each, origin[i], direction[i]) for each in both]
        found += [
            *row(f"ps{i}, x", "m", {SENSOR: x}, [origin[i, 0]] * 2),
            *row(f"ps{i}, y", "m", {SENSOR: y}, [origin[i, 1]] * 2),
            *row(f"ps{i}, yaw", "°", {SENSOR: bearing}, [yaw[i]] * 2),
            *row(f"ps{i}, way to the hull", "mm", {CLOSED: way}, hulls),
        ]
    tilt = math.acos(falls_to(lambda ray: float(counts("webots", ray)), 1465.73) / 0.010)
    found += row("tilt of the rays, by their length", "rad", {SENSOR: 0.16}, [tilt] * 2)
    for i, argos, xpuck in (
        (7, 17.0, 0.297),
        (6, 50.0, 0.855),
        (5, 90.0, 1.571),
        (4, 150.0, 2.618),
    ):
        theirs = {ARGOS: argos, XPUCK: math.degrees(xpuck)}
        found += row(f"ps{i}, yaw", "°", theirs, [yaw[i]] * 2)
    return found


def _to_hull(bench: Rig, origin: np.ndarray, direction: np.ndarray) -> float:
    """Returns the distance from a sensor to the hull along its ray, cast from outside, m."""
    outside = np.append(origin + 0.1 * direction, epuck.SENSOR_HEIGHT)
    return 0.1 - cast(bench, outside, np.append(-direction, 0.0))


def _table() -> list[Row]:
    row, found = partial(beside, "Infrared: Webots' response"), []
    for length, theirs, _ in TABLE:
        ours = float(counts("webots", length * _RISE))
        found += row(f"ray of {1e3 * length:g} mm", "counts", {SENSOR: theirs}, [ours] * 2)
    ours = float(counts("webots", np.inf))
    found += row("nothing in sight", "counts", {SENSOR: FREE}, [ours] * 2)
    for reading, theirs in INVERSE:
        rays = np.full(epuck.SENSORS, reading)
        ours = 1e3 * float(response.distance("webots", rays, np)[0]) / _RISE
        found += row(f"ray of {reading:g} counts", "mm", {CLOSED: theirs}, [ours] * 2)
    return found


def _before_a_wall(both: Sequence[Rig]) -> list[Row]:
    row, found = partial(beside, "Infrared: before a wall"), []
    for gap, *theirs in BEFORE_A_WALL:
        rays = [see(each, 1e-3 * gap) for each in both]
        for sensor, value in enumerate(theirs):
            ours = [float(counts("webots", ray[sensor])) for ray in rays]
            found += row(f"ps{sensor}, gap of {gap} mm", "counts", {CLOSED: value}, ours)
    ends = [
        1e3 * falls_to(lambda gap, bench=each: float(counts("webots", see(bench, gap)[0])), 158.03)
        for each in both
    ]
    rays = "training's rays against MuJoCo's, largest difference"
    return [
        *found,
        *row("ps0 is within 4 cm up to a gap of", "mm", {CLOSED: 30.7}, ends),
        *row(rays, "m", {CLOSED: 0.0}, analytic_error(both)),
    ]


def _reflectance() -> list[Row]:
    found = []
    for quantity, level, theirs in (
        ("seen up to a ray of", FREE + 1e-3, 26.6),
        ("as near as 4 cm up to a ray of", 158.03, 15.2),
        ("80 counts or more up to a ray of", 80.0, 25.3),
    ):
        ours = 1e3 * falls_to(lambda length: other_robot(length, 0.38), level)
        section = "Infrared: another e-puck, reflectance 0.38"
        found += beside(section, quantity, "mm", {CLOSED: theirs}, [ours] * 2)
    return found


def noisy(name: Response, ray: float) -> np.ndarray:
    """Returns readings [SAMPLES, K] for a ray (m), with noise from the simulation's generator."""
    seeds = np.arange(SAMPLES, dtype=np.uint32)
    shape = (epuck.SENSORS,)
    normal = noise.normal(seeds, np.int32(1), Stream.INFRARED, shape, np).astype(float)
    rays = np.full((SAMPLES, epuck.SENSORS), ray)
    return response.read(name, rays, None, Wear(noise=np.ones(epuck.SENSORS)), normal, np)


def _noise() -> list[Row]:
    row, found = partial(beside, "Infrared: noise over 100,000 samples"), []
    for length, mean, share in TABLE:
        read = noisy("webots", length * _RISE)[:, 0]
        at = f"Webots, ray of {1e3 * length:g} mm"
        found += row(f"{at}, mean", "counts", {SENSOR: mean}, [read.mean()] * 2)
        found += row(f"{at}, sd", "counts", {SENSOR: mean * share}, [read.std()] * 2)
    read = noisy("real", 0.03)
    for i, sds in enumerate(epuck.MEASURED_INFRARED_SD):
        quantity = f"real, ps{i}, sd (theirs: median of 1 to 7 cm)"
        theirs = {MEASURED: float(np.median(sds[1:]))}
        found += row(quantity, "counts", theirs, [read[:, i].std()] * 2)
    return found


def residuals() -> np.ndarray:
    """Returns measured minus fitted counts, [K, 8].

    The simulated response is without the fit's counts in free space, so they are added here.
    """
    free = np.array(epuck.INFRARED_FIT)[:, 2]
    fitted = at_gap(np.array(epuck.MEASURED_GAPS)).T + free[:, None]
    return np.array(epuck.MEASURED_INFRARED) - fitted


def _measured() -> list[Row]:
    row, found = partial(beside, "Infrared: the fit to a measured e-puck"), []
    sds, left = np.array(epuck.MEASURED_INFRARED_SD), residuals()
    for i in range(epuck.SENSORS):
        rms = float(np.sqrt(np.mean((left[i, 1:] / sds[i, 1:]) ** 2)))
        worst, at_hull = np.abs(left[i, 1:]).max(), epuck.MEASURED_INFRARED[i][0]
        found += [
            *row(f"ps{i}, 1 to 7 cm, rms residual", "sd", {MEASURED: None}, [rms] * 2),
            *row(f"ps{i}, 1 to 7 cm, worst residual", "counts", {MEASURED: None}, [worst] * 2),
            *row(f"ps{i}, at the hull", "counts", {MEASURED: at_hull}, [at_hull - left[i, 0]] * 2),
        ]
    net = at_gap(1e-2 * np.arange(1, 8)).mean(axis=-1)
    for i, (gap, theirs) in enumerate(NET):
        quantity = f"mean of eight at {gap} cm, above 7 cm"
        found += row(quantity, "counts", {MEASURED: theirs}, [net[i] - net[-1]] * 2)
    return found


def _elsewhere() -> list[Row]:
    found = []
    for distance, *theirs in CURVES:
        ours = float(counts("webots", 1e-3 * distance * _RISE))
        numbers: dict[str, float | None] = dict(zip(SIMULATORS, map(float, theirs), strict=True))
        section = "Infrared: other simulators beside Webots' response"
        found += beside(section, f"at {distance} mm", "counts", numbers, [ours] * 2)
    return found
