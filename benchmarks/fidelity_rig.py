"""Test rig of `benchmarks.fidelity`, class of its rows, and the rows about the robot at rest.

The rig is one robot in a square arena of MuJoCo's C engine, at given wheel speeds. The rig measures
the robot's motion and the forces of walls on it, with the model that training and the judge share.
No function of the rig uses the expected results.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from swarmjax.sim import drive as sim_drive
from swarmjax.sim import model as sim_model
from swarmjax.sim.body import AS_BUILT, Body
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.geometry import FLOOR_GROUP, HULL_GROUP

CONTROL_STEP = 0.032  # s; Webots basicTimeStep
# Physics steps per control step, as in swarmjax.evaluate.
SUBSTEPS = {"planar": 1, "wheeled": 4}
SIDE = 2.0  # m; side of the arena; the walls are far away unless a test needs them
# Geom groups that rays can hit. Rays ignore contact spheres, wheels, skids and the floor.
SEEN = np.array([group not in (HULL_GROUP, FLOOR_GROUP) for group in range(6)], np.uint8)
BODY = "robot0"
_FAR = 0.2  # m; distance from which rays start
# The sources of reference numbers.
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """A robot to measure.

    Attributes:
      robot: the robot's settings.
      model: the compiled model.
      control_step: time for which a command holds, s.
      substeps: physics steps per control step.
    """

    robot: RobotConfig
    model: mujoco.MjModel
    control_step: float
    substeps: int

    @property
    def body(self) -> Body:
        """The kind of the robot's body."""
        return sim_model.BODIES[self.robot.body]


class Track(NamedTuple):
    """The motion of a robot: its state before the first control step and after each control step.

    Attributes:
      pose: [T + 1, 3] x (m), y (m), yaw (rad, unwrapped).
      qpos: [T + 1, Q] MuJoCo's generalised positions.
      qvel: [T + 1, V] MuJoCo's generalised velocities.
      force: [T + 1] normal force of the walls on the hull, N, as the mean over the physics steps of
        a control step.
    """

    pose: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    force: np.ndarray


def load(robot: RobotConfig, timestep: float | None = None) -> Rig:
    """Builds a rig.

    Args:
      robot: settings of the robot.
      timestep: physics step, s; a control step is then a single physics step. None: the judge's
        control step and number of physics steps.

    Returns:
      The rig.
    """
    control_step = CONTROL_STEP if timestep is None else timestep
    substeps = SUBSTEPS[robot.body] if timestep is None else 1
    size = sim_model.ArenaSize(robots=1, obstacles=0, largest_half=0.05)
    spec = sim_model.build(robot, size, control_step / substeps, ray_geoms=True)
    return Rig(robot=robot, model=spec.compile(), control_step=control_step, substeps=substeps)


def place(rig: Rig, x: float = 0.0, yaw: float = 0.0) -> mujoco.MjData:
    """Places the robot in the arena, at rest.

    Args:
      rig: the rig.
      x: position, m; y is 0.
      yaw: heading, rad.

    Returns:
      MuJoCo's data of the arena, with up-to-date positions.
    """
    data = mujoco.MjData(rig.model)
    ids = sim_model.ids(rig.model, sim_model.ArenaSize(1, 0, 0.05))
    where, turn = sim_model.fixture_poses(np.float64(SIDE), np.zeros((0, 5)), np)
    data.mocap_pos[ids.fixture_mocap], data.mocap_quat[ids.fixture_mocap] = where, turn
    data.qpos = rig.body.qpos(np.array([[x, 0.0, yaw]]), np)
    mujoco.mj_forward(rig.model, data)
    return data


def run(rig: Rig, data: mujoco.MjData, wheels: np.ndarray, steps: int) -> Track:
    """Turns the wheels at constant speeds, and records the motion.

    Args:
      rig: the rig.
      data: MuJoCo's data of the arena, which is changed.
      wheels: [2] speeds of the left and the right wheel, rad/s.
      steps: number of control steps.

    Returns:
      The robot's motion.
    """
    data.ctrl = rig.body.ctrl(np.asarray(wheels, np.float64)[None], AS_BUILT, rig.robot, np)
    qpos, qvel, force = [data.qpos.copy()], [data.qvel.copy()], [0.0]
    for _ in range(steps):
        pushes = []
        for _ in range(rig.substeps):
            mujoco.mj_step(rig.model, data)
            pushes.append(_push(rig, data))
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        force.append(float(np.mean(pushes)))
    pose = rig.body.pose(np.array(qpos), np)[:, 0]
    pose[:, 2] = np.unwrap(pose[:, 2])
    return Track(pose, np.array(qpos), np.array(qvel), np.array(force))


def command(rig: Rig, speed: float, turn_rate: float) -> np.ndarray:
    """Converts a command (m/s, rad/s) to wheel speeds [2] (rad/s) with the robot's drive."""
    drive = sim_drive.from_config(rig.robot)
    return sim_drive.wheel_speeds(np.array([speed, turn_rate]), drive, np)


def velocity(rig: Rig, track: Track) -> tuple[float, float]:
    """Returns the mean speed along the arcs of a track (m/s) and its mean turn rate (rad/s)."""
    start, end = track.pose[:-1], track.pose[1:]
    half = 0.5 * (end[:, 2] - start[:, 2])
    middle = start[:, 2] + half
    chord = np.sum((end - start)[:, :2] * np.stack([np.cos(middle), np.sin(middle)], -1), -1)
    arc = chord / np.sinc(half / np.pi)
    return float(arc.mean() / rig.control_step), float(2.0 * half.mean() / rig.control_step)


def steady(rig: Rig, speed: float, turn_rate: float, steps: int = 50) -> tuple[float, float]:
    """Returns speed (m/s) and turn rate (rad/s) once a command has held for 10 control steps."""
    data, wheels = place(rig), command(rig, speed, turn_rate)
    run(rig, data, wheels, 10)
    return velocity(rig, run(rig, data, wheels, steps))


def _push(rig: Rig, data: mujoco.MjData) -> float:
    """Returns the sum of the normal forces of the walls on the hull, N."""
    hull, total, force = rig.model.geom("robot0_hull").id, 0.0, np.zeros(6)
    for i, pair in enumerate(data.contact.geom):
        if hull in pair:
            mujoco.mj_contactForce(rig.model, data, i, force)
            total += force[0]
    return total


# Rows of the table


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


# The robot at rest: masses, sizes and positions, read from the compiled model


_beside = partial(beside, "Body")


def mass(bench: Rig) -> float:
    """Returns the mass of the whole robot, kg."""
    return float(bench.model.body(BODY).subtreemass[0])


def yaw_inertia(bench: Rig) -> float:
    """Returns the robot's moment of inertia about the vertical axis through its middle, kg m^2."""
    matrix = np.zeros((bench.model.nv, bench.model.nv))
    mujoco.mj_fullM(bench.model, place(bench), matrix)
    turn = 2 if bench.robot.body == "planar" else 5
    return float(matrix[turn, turn])


def centre(bench: Rig) -> np.ndarray:
    """Returns the centre of mass [3] of the whole robot, m."""
    return place(bench).body(BODY).subtree_com.copy()


def cast(bench: Rig, origin: ArrayLike, direction: ArrayLike) -> float:
    """Casts a ray, which may hit the robot itself; returns its length, m, or -1 without a hit."""
    start, toward = np.array(origin, float), np.array(direction, float)
    met = np.zeros(1, np.int32)
    return mujoco.mj_ray(bench.model, place(bench), start, toward, SEEN, True, -1, met)


def contact_radius(bench: Rig) -> float:
    """Returns the radius at which the hull touches a wall, m.

    The robot is placed about 1 mm too deep in the wall. The engine reports the contact's depth.
    """
    face, asked = 0.5 * SIDE, 0.037 - 0.001
    data = place(bench, x=face - asked)
    hull = bench.model.geom(f"{BODY}_hull").id
    depth = [c.dist for c in data.contact if hull in c.geom]
    return asked - min(depth)


def lowest(bench: Rig, names: Sequence[str]) -> float:
    """Returns the height of the lowest point of the named spheres, with the robot at rest, m."""
    data, model = place(bench), bench.model
    geoms = [(data.geom(f"{BODY}_{n}").xpos[2], model.geom(f"{BODY}_{n}").size[0]) for n in names]
    return float(min(height - radius for height, radius in geoms))


def across(bench: Rig) -> float:
    """Returns the distance between the wheels' centres of mass, m."""
    data = place(bench)
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
    reach = place(wheeled).geom(f"{BODY}_front").xpos[0]
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
    within = 0.5 * SIDE + 0.005  # m, 5 mm behind the face of a wall
    wall = [0.3 - cast(each, (within, 0.0, 0.3), (0, 0, -1)) for each in both]
    return [
        *_beside("control step", "s", {WORLD: 0.032, ROS: 0.064}, steps),
        *_beside("gravity", "m/s²", {WORLD: 9.81}, gravity),
        *_beside("height of the walls", "m", {"Webots RectangleArena": 0.1}, wall),
    ]
