"""Settings of the sensor models, and of random differences between robots and between steps."""

import math
from dataclasses import dataclass
from typing import Literal

from swarmjax import epuck
from swarmjax.config import ConfigError, Section, setting, show
from swarmjax.sim.config import (
    FASTEST_WHEEL,
    FRICTION_REASON,
    LARGEST_HULL,
    LEAST,
    MOST_FRICTION,
)

_LONGEST = 3600.0  # s; a training episode takes 16 s
_MOST_LATENCY = 1000  # control steps; real robots have 1 to 10
_LATENCY_REASON = "every arena stores one command or observation for each control step of latency"
# Settings that act on sensor counts. `ideal` sensors report metres, so they have no such settings.
COUNTED = ("infrared_noise", "infrared_gain", "reflectance", "reflectance_robot")


@dataclass(frozen=True, kw_only=True)
class RealismConfig(Section):
    """Settings of the sensor models, and of random differences between robots and between steps.

    A pair of numbers is the range (low, high) of a uniform distribution. Null switches off the
    effect of one setting. configs/realism/real.yaml holds the numbers of a real robot, with their
    sources.
    """

    name: Literal["ideal", "webots", "real"] = setting(
        "ideal", "preset that the settings are based on", derived=True
    )
    infrared: Literal["ideal", "webots", "real"] = setting(
        "ideal", "sensor model: exact distance, Webots' table, or a fit to real robots"
    )
    infrared_noise: tuple[float, float] | None = setting(
        None, "factor on the sensor model's noise; drawn per sensor and episode", 0.0, 1000.0
    )
    infrared_gain: tuple[float, float] | None = setting(
        None, "factor on counts from reflection; drawn per sensor and episode", above=0.0, high=10.0
    )
    infrared_yaw: float | None = setting(
        None, "SD of the sensor's yaw error, rad; drawn per sensor and episode", 0.0, math.pi
    )
    infrared_period: tuple[float, float] | None = setting(
        None,
        "time between infrared samples, s; drawn per robot and episode; null: every control step",
        above=0.0,
        high=_LONGEST,
    )
    reflectance: tuple[float, float] | None = setting(
        None,
        "reflectance of each obstacle, and one for all walls; drawn per episode; null: 1",
        above=0.0,
        high=1.0,
    )
    reflectance_robot: tuple[float, float] | None = setting(
        None, "reflectance of each robot; drawn per episode; null: 1", above=0.0, high=1.0
    )
    dead_sensor: float | None = setting(
        None, "probability that a sensor detects nothing; drawn per sensor and episode", 0.0, 1.0
    )
    wheel_radius: tuple[float, float] | None = setting(
        None, "radius of the wheels, m; drawn per robot and episode", LEAST, below=0.03
    )
    track: tuple[float, float] | None = setting(
        None,
        "replaces robot.effective_track, m; drawn per robot and episode",
        LEAST,
        2 * LARGEST_HULL,
    )
    max_wheel_speed: tuple[float, float] | None = setting(
        None, "speed limit of each wheel, rad/s; drawn per robot and episode", LEAST, FASTEST_WHEEL
    )
    mass: tuple[float, float] | None = setting(
        None, "mass, kg; drawn per robot and episode", above=2 * epuck.WHEEL_MASS, high=100.0
    )
    friction: tuple[float, float] | None = setting(
        None,
        "friction of wheels on floor; drawn per robot and episode",
        LEAST,
        MOST_FRICTION,
        reason=FRICTION_REASON,
    )
    speed_noise: float | None = setting(
        None, "relative SD of the wheel speed; drawn per wheel and control step", 0.0, 1.0
    )
    speed_quantisation: Literal["epuck1", "epuck2"] | None = setting(
        None, "round wheel speeds to those that this robot's firmware can set"
    )
    action_latency: tuple[int, int] | None = setting(
        None,
        "latency of commands, control steps; drawn per robot and episode",
        0,
        _MOST_LATENCY,
        reason=_LATENCY_REASON,
    )
    observation_latency: tuple[int, int] | None = setting(
        None,
        "latency of observations, control steps; drawn per robot and episode",
        0,
        _MOST_LATENCY,
        reason=_LATENCY_REASON,
    )
    target_distance_noise: float | None = setting(
        None, "SD of the observed target distance, m; drawn per robot and control step", 0.0, 10.0
    )
    target_bearing_noise: float | None = setting(
        None,
        "SD of the observed target bearing, rad; drawn per robot and control step",
        0.0,
        math.pi,
    )

    def _check(self) -> None:
        if self.infrared != "ideal":
            return
        for key in COUNTED:
            value = getattr(self, key)
            if value is not None:
                raise ConfigError(
                    f"{key} is {show(value)}, but infrared is ideal and has no sensor counts: give "
                    f"null for {key}, or give infrared=webots or real."
                )
