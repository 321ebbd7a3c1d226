"""How far does a robot turn while a wall blocks it and its wheels slip?

`python -m benchmarks.blocked` presses one robot against a wall for `SECONDS` at constant wheel
speeds. It prints a JSON line for each start and body. The line has the angle by which the robot
turned, and the distance by which it slid.

The command simulates both bodies in MuJoCo C. It also integrates the motion of a reference robot,
without MuJoCo. The reference robot is a rigid disc on two wheels with Coulomb friction, pressed
against a frictionless wall. Both wheels of the reference use all their grip to push forward, at any
speed, so no grip is left to turn the robot. A body that turns freely while blocked is therefore
wrong.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from benchmarks import rig
from swarmjax import command, epuck, provenance
from swarmjax.config import ConfigError, Section
from swarmjax.sim.config import RobotConfig

SECONDS = 2.0
GAP = 0.001  # m; distance between hull and wall at the start
# For each start: left and right wheel speed (rad/s), and heading from the wall's normal (rad).
STARTS = (
    (6.28, 0.7, -0.49),
    (6.28, 0.7, 0.49),
    (6.28, 6.28, 0.3),
    (6.28, 3.0, 0.2),
    (6.28, 0.7, 0.0),
)
# Each body with a physics step (s): the steps of training and of the judge, and finer steps.
TIMESTEPS: tuple[tuple[Literal["planar", "wheeled"], float], ...] = (
    ("planar", 0.032),
    ("wheeled", 0.016),
    ("wheeled", 0.008),
    ("wheeled", 0.002),
    ("wheeled", 0.0005),
)
_STEP = 2e-5  # s; step of the reference; a step of 1e-5 changes the angles by less than 0.01 rad
_SHARP = 1e-3  # m/s; at a slower slip the reference's friction is proportional to the slip
_WALL = 4e3, 64.0  # N/m, N s/m; the robot's push moves the face of the wall by 0.4 mm


class _Rigid(NamedTuple):
    """The state of a disc: x, y (m) and yaw (rad), their rates, and wheel traction [2, 2] (N)."""

    pose: np.ndarray
    rate: np.ndarray
    traction: np.ndarray


def reference(wheels: Sequence[float], yaw: float, step: float = _STEP) -> np.ndarray:
    """Integrates the motion of a rigid robot with Coulomb friction against the east wall.

    Args:
      wheels: left and right speed, rad/s.
      yaw: heading at the start, rad.
      step: time step, s.

    Returns:
      x (m), y (m), yaw (rad) after `SECONDS`.
    """
    x = 0.5 * rig.SIDE - epuck.HULL_RADIUS - GAP
    state = _Rigid(np.array([x, 0.0, yaw]), np.zeros(3), np.zeros((2, 2)))
    rim = np.array(wheels) * epuck.WHEEL_RADIUS
    for _ in range(round(SECONDS / step)):
        state = _advance(state, rim, step)
    return state.pose


def _advance(state: _Rigid, rim: np.ndarray, step: float) -> _Rigid:
    """Advances the disc by one semi-implicit Euler step."""
    yaw, rate = state.pose[2], state.rate
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    left = np.array([-ahead[1], ahead[0]])
    place = 0.5 * epuck.TRACK * np.array([left, -left])
    ground = rate[:2] + rate[2] * np.stack([-place[:, 1], place[:, 0]], axis=-1)
    slip = ground - rim[:, None] * ahead
    speed = np.maximum(np.linalg.norm(slip, axis=-1), _SHARP)
    load = _loads(state.traction, ahead, left)
    traction = -(load / speed)[:, None] * slip * epuck.FRICTION
    sunk = max(state.pose[0] + epuck.HULL_RADIUS - 0.5 * rig.SIDE, 0.0)
    wall = max(_WALL[0] * sunk + _WALL[1] * rate[0], 0.0) if sunk else 0.0
    force = traction.sum(axis=0) - np.array([wall, 0.0])
    torque = np.sum(place[:, 0] * traction[:, 1] - place[:, 1] * traction[:, 0])
    rate = rate + step * np.array([*force / epuck.MASS, torque / epuck.YAW_INERTIA])
    return _Rigid(state.pose + step * rate, rate, traction)


def _loads(traction: np.ndarray, ahead: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Computes the load on each wheel [2], N.

    Traction shifts load from the wheels to a skid, and from one wheel to the other.
    """
    total, height = traction.sum(axis=0), epuck.COM_HEIGHT
    weight = epuck.MASS * epuck.GRAVITY
    skid = min(abs(total @ ahead) * height / epuck.SKID_X, weight)
    shift = total @ left * height / epuck.TRACK
    return np.maximum(0.5 * (weight - skid) + np.array([-shift, shift]), 0.0)


def simulate(mine: rig.Rig, wheels: Sequence[float], yaw: float) -> np.ndarray:
    """Simulates a robot that is pressed against the east wall, in MuJoCo C.

    Args:
      mine: the robot.
      wheels: left and right speed, rad/s.
      yaw: heading at the start, rad.

    Returns:
      x (m), y (m), yaw (rad, unwrapped) after `SECONDS`.
    """
    data = rig.place(mine, 0.5 * rig.SIDE - epuck.HULL_RADIUS - GAP, yaw)
    steps = round(SECONDS / mine.control_step)
    return rig.run(mine, data, np.array(wheels), steps).pose[-1]


def results() -> Iterator[dict[str, Any]]:
    """Runs all starts; yields a line for each start and body."""
    rigs = {
        f"{body}, {1e3 * step:g} ms": rig.load(RobotConfig(body=body), step)
        for body, step in TIMESTEPS
    }
    for *wheels, yaw in STARTS:
        ends = {name: simulate(mine, wheels, yaw) for name, mine in rigs.items()}
        for name, end in {"reference": reference(wheels, yaw), **ends}.items():
            yield {
                "benchmark": "blocked",
                "robot": name,
                "wheels": wheels,
                "yaw": yaw,
                "turned_rad": float(end[2] - yaw),
                "slid_m": float(end[1]),
                "seconds": SECONDS,
                "versions": provenance.versions(),
                "commit": provenance.commit(),
            }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    if arguments:
        raise ConfigError(f"'{arguments[0]}' is not a setting: blocked takes none.")
    for line in results():
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("blocked", main, Section))
