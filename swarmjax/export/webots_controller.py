"""Drives a Webots e-puck to its target with a trained policy. Needs only NumPy.

In every control step the controller reads infrared, GPS and compass, and sets the speeds of the
wheels. The controller needs `policy.npz` and `sensors.json` in the same folder. `sensors.json` says
which distances the counts of the infrared sensors stand for.

Give the target as `target=x,y` (m) in the robot's controllerArgs, or in its customData, which you
may change while the robot drives. A policy that is not shared also needs `robot=i`, the robot's
number from 0. The robot samples its actions from the policy. With `action=mean` it takes the most
likely action.
"""

import importlib
import json
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmjax import policy
from swarmjax.policy import Policy

INFRARED = tuple(f"ps{i}" for i in range(8))
# Quantities that the controller can measure; an observation may have them in any order.
QUANTITIES = (*(f"infrared_{i}" for i in range(8)), "target_distance", "target_bearing")
MOTORS = ("left wheel motor", "right wheel motor")


class Orders(NamedTuple):
    """A robot's target, the robot's number from 0, and whether its actions are sampled."""

    target: tuple[float, float] | None = None
    robot: int = 0
    sampled: bool = True


def parse(words: Iterable[str]) -> Orders:
    """Reads `target=x,y`, `robot=i` and `action=mean` or `action=sampled`.

    Args:
      words: words of controllerArgs or of customData.

    Returns:
      The orders.

    Raises:
      ValueError: if a word is anything else.
    """
    orders = Orders()
    for word in words:
        key, _, value = word.partition("=")
        try:
            if key == "target":
                x, y = (float(part) for part in value.split(","))
                if not math.isfinite(x + y):
                    raise ValueError
                orders = orders._replace(target=(x, y))
            elif key == "robot" and value.isdecimal():
                orders = orders._replace(robot=int(value))
            elif key == "action" and value in ("mean", "sampled"):
                orders = orders._replace(sampled=value == "sampled")
            else:
                raise ValueError
        except ValueError:
            raise ValueError(
                f"{word!r} cannot be read: give target=x,y, robot=i or action=mean."
            ) from None
    return orders


def observe(
    trained: Policy,
    sensors: dict[str, Any],
    counts: Sequence[float],
    distance: float,
    bearing: float,
) -> np.ndarray:
    """Assembles an observation.

    Args:
      trained: the policy.
      sensors: contents of `sensors.json`.
      counts: [K] counts of the infrared sensors.
      distance: distance to the target, m.
      bearing: direction of the target from the robot's x axis, rad, left positive.

    Returns:
      [O] float32, scaled by the policy's layout.
    """
    layout = trained.meta["observation"]
    seen = np.asarray(counts, float)
    if trained.encoding == "metric":
        seen = np.interp(seen, sensors["counts"][::-1], sensors["distance"][::-1])
        seen = np.minimum(seen, trained.meta["sensors"]["range"])
    measured = dict(zip(QUANTITIES, [*seen, distance, bearing], strict=True))
    quantity = np.array([measured[name] for name in layout["names"]], np.float32)
    offset, scale = (np.array(layout[key], np.float32) for key in ("offset", "scale"))
    return (quantity - offset) / scale


def to_target(
    position: Sequence[float], north: Sequence[float], target: tuple[float, float]
) -> tuple[float, float]:
    """Computes the distance and the bearing of a target from a robot.

    Args:
      position: position of the robot from its GPS, x and y first, m.
      north: direction of north in the robot's frame from its compass, x and y first. The world
        is ENU, so north is its y axis.
      target: x and y, m.

    Returns:
      Distance, m, and bearing from the robot's x axis, rad, -pi to pi, left positive.
    """
    x, y = target[0] - position[0], target[1] - position[1]
    yaw = math.atan2(north[0], north[1])
    turn = math.atan2(y, x) - yaw
    return math.hypot(x, y), math.atan2(math.sin(turn), math.cos(turn))


def wheel_speeds(
    trained: Policy,
    observation: np.ndarray,
    robot: int,
    normal: Any = 0.0,
    memory: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Computes the speeds of the wheels from an observation.

    Args:
      trained: the policy.
      observation: [O] the observation.
      robot: the robot's number, from 0.
      normal: [U] standard normal numbers that sample the action; 0 gives the most likely action.
      memory: memory that `policy.begin` or the previous call returned.

    Returns:
      [2] speeds of the left and the right wheel, rad/s, each limited on its own; and the memory for
      the next call.
    """
    # The rows of robots with lower numbers only ensure that this robot gets its own network.
    seen = np.broadcast_to(observation, (1 if trained.is_shared else robot + 1, observation.size))
    memory, action = policy.step(trained, memory, seen, normal)
    speed, turn_rate = policy.command(trained, action)[-1]
    body = trained.meta["robot"]
    turn = turn_rate * 0.5 * body["track"]
    wheels = np.array([speed - turn, speed + turn]) / body["wheel_radius"]
    return np.clip(wheels, -body["max_wheel_speed"], body["max_wheel_speed"]), memory


class Devices(NamedTuple):
    """The robot's devices that the controller uses."""

    infrared: list[Any]
    gps: Any
    compass: Any
    motors: list[Any]


def find_devices(robot: Any, period: int) -> Devices:
    """Finds a robot's devices and switches them on.

    Args:
      robot: the robot object of Webots.
      period: time between samples, ms.

    Returns:
      The devices: sensors that report every `period`, and motors at rest.

    Raises:
      ValueError: if a device is missing.
    """
    devices = {name: robot.getDevice(name) for name in (*INFRARED, "gps", "compass", *MOTORS)}
    for name, device in devices.items():
        if device is None:
            raise ValueError(
                f"the robot has no device {name!r}: use an E-puck with a GPS and a Compass in its "
                "turretSlot."
            )
    *sensors, left, right = devices.values()
    for sensor in sensors:
        sensor.enable(period)
    for motor in (left, right):
        motor.setPosition(math.inf)  # controlled by speed
        motor.setVelocity(0.0)
    *infrared, gps, compass = sensors
    return Devices(infrared, gps, compass, [left, right])


def control_period(trained: Policy, basic_step: float) -> int:
    """Finds how often the policy acts.

    Args:
      trained: the policy.
      basic_step: basic time step of the world, ms.

    Returns:
      The control step that the policy was trained with, ms.

    Raises:
      ValueError: if the control step is not a whole number of ms, or not a multiple of
        `basic_step`.
    """
    period = 1000 * trained.meta["task"]["control_step"]
    if abs(round(period) - period) > 1e-6 * period:
        raise ValueError(
            f"the control step of the policy is {period:g} ms, but Webots needs whole milliseconds."
        )
    steps = round(period / basic_step)
    if steps < 1 or abs(steps * basic_step - period) > 1e-6 * period:
        raise ValueError(
            f"basicTimeStep is {basic_step:g} ms: give {period:g} ms, which is the policy's "
            f"control step, or a divisor of {period:g} ms."
        )
    return round(period)


def drive(robot: Any, folder: Path, words: Sequence[str]) -> None:
    """Drives a robot until the simulation ends.

    Args:
      robot: the robot object of Webots.
      folder: folder with `policy.npz` and `sensors.json`.
      words: words of controllerArgs.

    Raises:
      ValueError: if the policy, the robot or the orders are invalid.
    """
    trained = policy.load(folder / "policy.npz")
    sensors = json.loads((folder / "sensors.json").read_text())
    period = control_period(trained, robot.getBasicTimeStep())
    devices = find_devices(robot, period)
    draw = np.random.default_rng()
    stops, parked_at = trained.meta["task"]["arrival"] == "latch", None
    memory, pursued = None, None
    while robot.step(period) != -1:  # the first step gives all sensors a value
        orders = parse([*robot.getCustomData().split(), *words])
        wheels = np.zeros(len(MOTORS))
        if (orders.target, orders.robot) != pursued:  # an episode begins
            rows = 1 if trained.is_shared else orders.robot + 1
            memory, pursued = policy.begin(trained, (rows,)), (orders.target, orders.robot)
        if orders.target is not None and orders.target != parked_at:
            distance, bearing = to_target(
                devices.gps.getValues(), devices.compass.getValues(), orders.target
            )
            counts = [sensor.getValue() for sensor in devices.infrared]
            # An arrived robot stays where it is, as in training.
            if stops and distance <= trained.meta["task"]["target_radius"]:
                parked_at = orders.target
            else:
                seen = observe(trained, sensors, counts, distance, bearing)
                normal = draw.standard_normal(len(MOTORS), np.float32) if orders.sampled else 0.0
                wheels, memory = wheel_speeds(trained, seen, orders.robot, normal, memory)
        for motor, speed in zip(devices.motors, wheels, strict=True):
            motor.setVelocity(float(speed))


def main() -> int:
    """Runs the controller in Webots; returns its exit code."""
    # Webots' package `controller` can be imported only in a controller that Webots has started.
    robot = importlib.import_module("controller").Robot()
    try:
        drive(robot, Path(__file__).resolve().parent, sys.argv[1:])
    except (OSError, ValueError) as error:
        sys.stderr.write(f"{Path(__file__).stem}: error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
