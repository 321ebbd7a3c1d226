"""Tests friction of hulls: both bodies and all solvers, against MuJoCo C and Coulomb's law."""

import dataclasses
import math
from typing import Literal

import jax.numpy as jnp
import numpy as np
import pytest
from engines import (
    ARENAS,
    AWAY,
    FULL,
    ROBOTS,
    STEP,
    Engine,
    Path,
    alone,
    drive_all,
    drive_in_c,
    load_as,
    settings,
    wheels_of,
)
from hypothesis import given
from hypothesis import strategies as st

from swarmjax.config import ConfigError
from swarmjax.sim import gaps
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.fast import rubbing_jax

Impl = Literal["jax", "warp"]
Solver = Literal["auto", "mjx", "swarm"]
SIDE, RADIUS = 0.6, 0.037
# A doorway between two boxes, 0.13 m wide and 0.04 m deep. The arena's corners lie behind the
# boxes.
DOORWAY = np.array([[0.0, 0.215, 0.0, 0.02, 0.15], [0.0, -0.215, 0.0, 0.02, 0.15]], np.float32)


def _engine(impl: Impl, robot: RobotConfig, solver: Solver = "auto") -> Engine:
    config = settings(impl, robot.body)
    sim = dataclasses.replace(config.sim, solver=solver)
    return load_as(dataclasses.replace(config, robot=robot, sim=sim))


def _jams() -> tuple[np.ndarray, np.ndarray]:
    """Returns poses [A, R, 3] and commands [A, R, 2] of robots that press against something.

    In arenas 0 and 1 three robots press into the doorway abreast. In arenas 2 and 3 the robots
    press into a corner, one behind another. In arenas 4 and 5 they press into a box and the walls.
    In the other arenas they press into each other.
    """
    pose = np.zeros((ARENAS, ROBOTS, 3), np.float32)
    pose[:2] = [(-0.06, 0.0, 0.0), (-0.075, 0.078, -0.5), (-0.075, -0.08, 0.4)]
    pose[2:4] = [(0.24, 0.24, 0.8), (0.18, 0.19, 0.7), (0.25, 0.15, 1.2)]
    pose[4:6] = [(-0.065, 0.25, 0.3), (-0.25, 0.0, 2.6), (-0.25, -0.2, -2.4)]
    pose[6:] = [(-0.2, 0.05, 0.2), (-0.11, 0.07, 3.0), (-0.16, -0.02, 1.4)]
    pose[1::2, :, 2] += [0.15, -0.2, 0.1]
    command = np.array([(0.12, 0.3), (0.1, -0.8), (0.11, 0.6)])
    return pose, np.broadcast_to(command, (ARENAS, ROBOTS, 2))


def _jams_in_c(robot: RobotConfig, pose: np.ndarray, wheels: np.ndarray) -> Path:
    paths = [drive_in_c(robot, pose[a], wheels[:, a], DOORWAY, side=SIDE) for a in range(ARENAS)]
    return Path(*(np.concatenate(parts, axis=1) for parts in zip(*paths, strict=True)))


def _check_jammed(path: Path) -> None:
    """Checks that every arena has one contact per control step or more on average.

    In the doorway there must be contacts between robots and contacts with obstacles.
    """
    found = np.zeros((ARENAS, 3), int)
    for now in path.pose:
        for a, each in enumerate(now):
            found[a] += np.sum(gaps.gaps(each, np.float64(SIDE), DOORWAY, RADIUS, np) < 0.0, axis=0)
    assert (found.sum(axis=1) >= len(path.pose)).all(), found
    assert (found[:2, [gaps.KINDS.index("robot"), gaps.KINDS.index("obstacle")]] > 0).all(), found


# The largest errors of float32 were 4.3e-7 m and 7.4e-6 rad, for all three engines and both
# frictions, over 60 control steps, with 3 x 60 robot steps in contact in most arenas. The bounds
# are twice these errors, rounded up.
CLOSE, CLOSE_YAW = 9e-7, 1.5e-5


@pytest.mark.parametrize(
    ("impl", "solver"),
    [("jax", "swarm"), ("warp", "swarm"), pytest.param("warp", "mjx", marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("friction", [0.3, pytest.param(1.0, marks=pytest.mark.slow)])
def test_jams_of_planar_robots_as_in_c(impl: Impl, solver: Solver, friction: float) -> None:
    robot = RobotConfig(hull_friction=friction)
    pose, command = _jams()
    wheels = np.broadcast_to(wheels_of(command), (60, ARENAS, ROBOTS, 2))
    expected = _jams_in_c(robot, pose, wheels)
    _check_jammed(expected)
    found = drive_all(_engine(impl, robot, solver), pose, wheels, DOORWAY, side=SIDE)
    apart = np.abs(found.pose - expected.pose).max(axis=(0, 1, 2))
    assert apart[:2].max() <= CLOSE
    assert apart[2] <= CLOSE_YAW


@pytest.mark.slow
def test_jams_of_wheeled_robots_as_in_c() -> None:
    robot = RobotConfig(body="wheeled", hull_friction=0.5)
    pose, command = _jams()
    wheels = np.broadcast_to(wheels_of(command), (20, ARENAS, ROBOTS, 2))
    expected = _jams_in_c(robot, pose, wheels)
    found = drive_all(_engine("warp", robot), pose, wheels, DOORWAY, side=SIDE)
    apart = np.abs(found.pose - expected.pose)
    # The largest errors of float32 were 2.0e-6 m and 4.8e-5 rad. The bounds are twice these errors.
    assert apart[..., :2].max() <= 4e-6
    assert apart[..., 2].max() <= 1e-4
    smooth = _jams_in_c(dataclasses.replace(robot, hull_friction=0.0), pose, wheels)
    assert np.abs(smooth.pose - expected.pose)[..., :2].max() > 1e-3


# Coulomb's law by hand. A planar robot drives at an angle against the wall east of it. The robot
# hardly turns, since its moment of inertia is 1e5 times an e-puck's. With g = m / dt, its servos
# pull it with g (v - u) along its heading, where u is its speed along its heading, and with -g w
# across its heading, where w is its speed across. With a speed s along the wall and v commanded at
# the angle a to the wall's normal, the servos' force is
#   along the wall  g (v sin a - s),   into the wall  g v cos a.
# The robot slides if the first exceeds friction times the second: s = v (sin a - friction cos a).
# Below that the robot creeps, as MuJoCo's friction is soft: R F = b s, with b = 2 / (0.95 * 2 dt),
# R = (1 - d) / d * 2 / (3 m), so that s = v sin a * R g / (b + R g). R has the mean inverse mass
# of three axes, of which one has no joint. Beyond tan a = friction + (1 + friction^2) R g /
# (b friction), 0.55 here, sliding opens the contact, and there is no steady speed.
FRICTION, HEAVY = 0.3, 10.0
SLIDES = {0.1: False, 0.2: False, 0.28: False, 0.35: True, 0.4: True, 0.5: True}  # tan a


def _impedance(angle: float) -> float:
    """Returns the impedance d of a robot that rests against the wall.

    The impedance solves k d depth = R F, with k = 1 / (0.95 * 2 dt)^2.
    """
    depth, d = 0.0, 0.9
    for _ in range(50):
        depth = _give(d) * FULL * math.cos(angle) * (0.95 * 2.0 * STEP) ** 2 / d
        share = min(depth / 1e-3, 1.0)
        d = 0.9 + 0.05 * (2.0 * share**2 if share < 0.5 else 1.0 - 2.0 * (1.0 - share) ** 2)
    return d


def _give(d: float) -> float:
    """Returns R g in 1/s, by the equations above `FRICTION`."""
    return (1.0 - d) / d * 2.0 / 3.0 / STEP


def _along_wall(angle: float) -> float:
    """Returns the speed along the wall in m/s, by the equations above `FRICTION`."""
    if math.tan(angle) > FRICTION:
        return FULL * (math.sin(angle) - FRICTION * math.cos(angle))
    give, damping = _give(_impedance(angle)), 2.0 / (0.95 * 2.0 * STEP)
    return FULL * math.sin(angle) * give / (damping + give)


@pytest.fixture(scope="module")
def pressed() -> dict[str, np.ndarray]:
    """Returns each engine's speeds along the wall [angles] in m/s, after 40 control steps."""
    robot = RobotConfig(yaw_inertia=HEAVY, hull_friction=FRICTION)
    wheels = np.broadcast_to(wheels_of(np.array([FULL, 0.0])), (40, ROBOTS, 2))
    poses = np.stack([alone(0.5 * SIDE - RADIUS - 1e-4, -0.1, math.atan(t)) for t in SLIDES])
    fill = np.concatenate([poses, poses[:1].repeat(ARENAS - len(poses), axis=0)])
    found = {}
    for impl in ("jax", "warp"):
        path = drive_all(_engine(impl, robot), fill, wheels[:, None], AWAY, side=SIDE)
        found[impl] = path.rate[-1, : len(poses), 0, 1]
    found["c"] = np.array(
        [drive_in_c(robot, p, wheels, AWAY, side=SIDE).rate[-1, 0, 0, 1] for p in poses]
    )
    return found


@pytest.mark.parametrize("engine", [pytest.param("jax", marks=pytest.mark.slow), "warp", "c"])
@pytest.mark.parametrize("row", range(len(SLIDES)), ids=[f"tan={t}" for t in SLIDES])
def test_a_robot_slides_along_a_wall_by_coulombs_law(
    pressed: dict[str, np.ndarray], engine: str, row: int
) -> None:
    angle, slides = list(map(math.atan, SLIDES))[row], list(SLIDES.values())[row]
    assert (_along_wall(angle) > 0.06 * FULL * math.sin(angle)) == slides
    # After 1.28 s the speed is 0.03 % off its steady value, and the heading has crept by 1e-5 rad.
    assert pressed[engine][row] == pytest.approx(_along_wall(angle), rel=1e-3)


@given(
    wanted=st.tuples(*[st.floats(-10.0, 10.0)] * 2),
    cost=st.tuples(*[st.floats(0.1, 10.0)] * 2),
    friction=st.floats(0.0, 2.0),
)
def test_no_other_force_in_the_cone_is_nearer(
    wanted: tuple[float, float], cost: tuple[float, float], friction: float
) -> None:
    best = rubbing_jax.project(rubbing_jax.Force(*map(jnp.float32, wanted)), *cost, friction)
    push, rub = float(best.push), float(best.rub)
    assert abs(rub) <= friction * push + 1e-5  # float32 for numbers up to 40
    far = np.linspace(0.0, 50.0, 501)
    rubs = np.linspace(-1.0, 1.0, 41)[:, None] * friction * far
    total = cost[0] * (far - wanted[0]) ** 2 + cost[1] * (rubs - wanted[1]) ** 2
    found = cost[0] * (push - wanted[0]) ** 2 + cost[1] * (rub - wanted[1]) ** 2
    assert found <= total.min() + 1e-3 * (1.0 + found)


@pytest.mark.parametrize("given_", [0.05, -0.1, 2.5])
def test_a_friction_that_no_contact_bears_is_refused(given_: float) -> None:
    with pytest.raises(ConfigError, match=r"^hull_friction is -?\d.*: give 0"):
        RobotConfig(hull_friction=given_)
