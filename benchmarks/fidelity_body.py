"""Measures the robot at rest: masses, sizes and positions, read from the compiled model."""

import math
from collections.abc import Sequence
from functools import partial

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from benchmarks import rig
from benchmarks.fidelity_row import (
    ARGOS,
    ENKI,
    GCTRONIC,
    GUIDE,
    LARAL,
    PROTO,
    RIGID,
    ROS,
    WORLD,
    Row,
    beside,
)
from benchmarks.rig import Rig

BODY = "robot0"
_FAR = 0.2  # m; distance from which rays start
_beside = partial(beside, "Body")


def mass(bench: Rig) -> float:
    """Returns the mass of the whole robot, kg."""
    return float(bench.model.body(BODY).subtreemass[0])


def yaw_inertia(bench: Rig) -> float:
    """Returns the robot's moment of inertia about the vertical axis through its middle, kg m^2."""
    matrix = np.zeros((bench.model.nv, bench.model.nv))
    mujoco.mj_fullM(bench.model, rig.place(bench), matrix)
    turn = 2 if bench.robot.body == "planar" else 5
    return float(matrix[turn, turn])


def centre(bench: Rig) -> np.ndarray:
    """Returns the centre of mass [3] of the whole robot, m."""
    return rig.place(bench).body(BODY).subtree_com.copy()


def cast(bench: Rig, origin: ArrayLike, direction: ArrayLike) -> float:
    """Casts a ray, which may hit the robot itself; returns its length, m, or -1 without a hit."""
    start, toward = np.array(origin, float), np.array(direction, float)
    met = np.zeros(1, np.int32)
    return mujoco.mj_ray(bench.model, rig.place(bench), start, toward, rig.SEEN, True, -1, met)


def contact_radius(bench: Rig) -> float:
    """Returns the radius at which the hull touches a wall, m.

    The robot is placed about 1 mm too deep in the wall. The engine reports the contact's depth.
    """
    face, asked = 0.5 * rig.SIDE, 0.037 - 0.001
    data = rig.place(bench, x=face - asked)
    hull = bench.model.geom(f"{BODY}_hull").id
    depth = [c.dist for c in data.contact if hull in c.geom]
    return asked - min(depth)


def lowest(bench: Rig, names: Sequence[str]) -> float:
    """Returns the height of the lowest point of the named spheres, with the robot put down, m."""
    data, model = rig.place(bench), bench.model
    geoms = [(data.geom(f"{BODY}_{n}").xpos[2], model.geom(f"{BODY}_{n}").size[0]) for n in names]
    return float(min(height - radius for height, radius in geoms))


def across(bench: Rig) -> float:
    """Returns the distance between the wheels' centres of mass, m."""
    data = rig.place(bench)
    left, right = (data.body(f"{BODY}_{side}").xipos for side in ("left", "right"))
    return float(np.linalg.norm(left - right))


def rows(planar: Rig, wheeled: Rig, planar_v2: Rig, wheeled_v2: Rig) -> list[Row]:
    """Measures all rows."""
    both = planar, wheeled
    return [
        *_masses(both, (planar_v2, wheeled_v2)),
        *_inertia(both),
        *_hull(both),
        *_wheels(wheeled),
        *_world(both),
    ]


def _masses(first: Sequence[Rig], second: Sequence[Rig]) -> list[Row]:
    whole, model = [mass(each) for each in first], first[1].model
    chassis, wheel = (model.body(name).mass[0] for name in (BODY, f"{BODY}_left"))
    version_1 = {GUIDE: 0.16, LARAL: 0.15, ENKI: 0.152}
    return [
        *_beside("mass, version 1", "kg", version_1, whole),
        *_beside("mass, version 2", "kg", {PROTO: 0.14}, [mass(each) for each in second]),
        *_beside("mass without wheels", "kg", {PROTO: 0.15}, (None, chassis)),
        *_beside("mass of a wheel", "kg", {PROTO: 0.005}, (None, wheel)),
    ]


def _inertia(both: Sequence[Rig]) -> list[Row]:
    model, unit = both[1].model, "kg m²"
    chassis, wheel = model.body(BODY), model.body(f"{BODY}_left").inertia
    about, whole = chassis.inertia, centre(both[1])
    # The moment about z is the sum of the body's moment and the moments of two wheels. Each wheel
    # has 5 g, is 0.026 m off the axis, and adds its own moment of 5.1e-7 kg m².
    yaw = {PROTO: 9.78585e-5 + 2 * (0.005 * 0.026**2 + 5.1e-7)}
    height = {PROTO: (0.15 * 0.015 + 0.01 * 0.020) / 0.16}
    lying = "centre of mass without wheels, height"
    return [
        *_beside("inertia without wheels about x", unit, {PROTO: 8.64333e-5}, (None, about[0])),
        *_beside("inertia without wheels about y", unit, {PROTO: 8.74869e-5}, (None, about[1])),
        *_beside("inertia without wheels about z", unit, {PROTO: 9.78585e-5}, (None, about[2])),
        *_beside("inertia about z", unit, yaw, [yaw_inertia(each) for each in both]),
        *_beside("inertia of a wheel about its axle", unit, {PROTO: 1e-6}, (None, wheel[1])),
        *_beside("inertia of a wheel across it", unit, {PROTO: 5.1e-7}, (None, wheel[0])),
        *_beside(lying, "m", {PROTO: 0.015}, (None, chassis.ipos[2])),
        *_beside("centre of mass, height", "m", height, (None, whole[2])),
        *_beside("centre of mass, ahead of the axle", "m", {PROTO: 0.0}, (None, whole[0])),
        *_beside("centre of mass, left of the middle", "m", {PROTO: 0.0}, (None, whole[1])),
    ]


def _hull(both: Sequence[Rig]) -> list[Row]:
    seen = [_FAR - cast(each, (_FAR, 0.0, 0.033), (-1, 0, 0)) for each in both]
    felt = [contact_radius(each) for each in both]
    bottom = [cast(each, (0.0, 0.01, -_FAR), (0, 0, 1)) - _FAR for each in both]
    top = [_FAR - cast(each, (0.0, 0.01, _FAR), (0, 0, -1)) for each in both]
    others = {PROTO: 0.037, GUIDE: 0.0355, LARAL: 0.035, ARGOS: 0.035}
    return [
        *_beside("radius, as rays meet it", "m", {PROTO: 0.037}, seen),
        *_beside("radius, as walls meet it", "m", others, felt),
        *_beside("hull, lower end", "m", {PROTO: 0.0025}, bottom),
        *_beside("hull, upper end", "m", {PROTO: 0.0475}, top),
    ]


def _wheels(wheeled: Rig) -> list[Row]:
    size, apart = wheeled.model.geom(f"{BODY}_left").size[0], across(wheeled)
    floor = lowest(wheeled, ("left", "right"))
    clearance = lowest(wheeled, ("front", "back")) - floor
    reach = rig.place(wheeled).geom(f"{BODY}_front").xpos[0]
    play = math.degrees(math.atan(clearance / reach))
    radii = {PROTO: 0.020, GUIDE: 0.0205, LARAL: 0.0205, ARGOS: 0.0205}
    tracks = {PROTO: 0.052, LARAL: 0.053, GCTRONIC: 0.053, ARGOS: 0.053, ENKI: 0.051}
    return [
        *_beside("wheel radius", "m", radii, (None, size)),
        *_beside("distance between the wheels", "m", tracks, (None, apart)),
        *_beside("skids, ahead of the axle", "m", {PROTO: 0.025}, (None, reach)),
        *_beside("skids, above the wheels' lowest point", "m", {PROTO: 1e-4}, (None, clearance)),
        *_beside("pitch before a skid touches, by its place", "°", {PROTO: 0.23}, (None, play)),
        *_beside("wheels at rest, depth in the floor", "m", {RIGID: 0.0}, (None, -floor)),
    ]


def _world(both: Sequence[Rig]) -> list[Row]:
    steps = [each.model.opt.timestep * each.substeps for each in both]
    gravity = [-each.model.opt.gravity[2] for each in both]
    within = 0.5 * rig.SIDE + 0.005  # m, 5 mm behind the face of a wall
    wall = [0.3 - cast(each, (within, 0.0, 0.3), (0, 0, -1)) for each in both]
    return [
        *_beside("control step", "s", {WORLD: 0.032, ROS: 0.064}, steps),
        *_beside("gravity", "m/s²", {WORLD: 9.81}, gravity),
        *_beside("height of the walls", "m", {"Webots RectangleArena": 0.1}, wall),
    ]
