"""How the sensors answer, and what differs from robot to robot and from step to step."""

import math
from dataclasses import dataclass, field
from typing import Literal

from swarmjax import epuck
from swarmjax.config import ConfigError, Section, about, show
from swarmjax.sim.config import (
    FASTEST_WHEEL,
    FRICTION_REASON,
    HULL_FRICTION_REASON,
    LARGEST_HULL,
    LEAST,
    LEAST_HULL_FRICTION,
    MOST_FRICTION,
    MOST_HULL_FRICTION,
)

_LONGEST = 3600.0  # s; an episode of training takes 16 s, and no pause in it may be longer
_MOST_LATENCY = 1000  # control steps; real robots have 1 to 10
_LATENCY_REASON = (
    "each control step of latency is a command or an observation that every arena keeps"
)
# What is counted has no meaning for sensors that report metres.
COUNTED = (
    "infrared_noise",
    "infrared_gain",
    "infrared_offset",
    "reflectance_wall",
    "reflectance_obstacle",
    "reflectance_robot",
)


@dataclass(frozen=True, kw_only=True)
class RealismConfig(Section):
    """How the sensors answer, and what differs from robot to robot and from step to step.

    A range is (low, high), drawn from uniformly; null switches a factor off, alone. The numbers of
    a real robot stand in configs/realism/real.yaml, with their sources.
    """

    name: Literal["ideal", "webots", "real"] = field(
        default="ideal",
        metadata=about("preset that the numbers started from", derived=True),
    )
    infrared: Literal["ideal", "webots", "real"] = field(
        default="ideal",
        metadata=about("response: m up to the range, Webots' table, or fitted to real robots"),
    )
    infrared_noise: tuple[float, float] | None = field(
        default=None,
        metadata=about("times the response's own noise; a sensor and episode", 0.0, 1000.0),
    )
    infrared_gain: tuple[float, float] | None = field(
        default=None,
        metadata=about("times what a reflection adds; a sensor and episode", above=0.0, high=10.0),
    )
    infrared_offset: float | None = field(
        default=None,
        metadata=about("deviation left after zeroing, counts; a sensor and episode", 0.0, 4095.0),
    )
    infrared_yaw: float | None = field(
        default=None, metadata=about("deviation, rad; a sensor and episode", 0.0, math.pi)
    )
    infrared_position: float | None = field(
        default=None, metadata=about("deviation on each axis, m; a sensor and episode", 0.0, 0.01)
    )
    infrared_period: tuple[float, float] | None = field(
        default=None,
        metadata=about(
            "between samples, s; a robot and episode; null: every control step",
            above=0.0,
            high=_LONGEST,
        ),
    )
    reflectance_wall: tuple[float, float] | None = field(
        default=None, metadata=about("of all walls; an episode; null: 1", above=0.0, high=1.0)
    )
    reflectance_obstacle: tuple[float, float] | None = field(
        default=None, metadata=about("of each obstacle; an episode; null: 1", above=0.0, high=1.0)
    )
    reflectance_robot: tuple[float, float] | None = field(
        default=None, metadata=about("of each robot; an episode; null: 1", above=0.0, high=1.0)
    )
    dead_sensor: float | None = field(
        default=None,
        metadata=about("probability of never seeing anything; a sensor and episode", 0.0, 1.0),
    )
    wheel_radius: tuple[float, float] | None = field(
        default=None, metadata=about("m; a robot and episode", LEAST, below=0.03)
    )
    wheel_mismatch: float | None = field(
        default=None,
        metadata=about(
            "deviation of the relative left/right difference; a robot and episode", 0.0, 0.1
        ),
    )
    track: tuple[float, float] | None = field(
        default=None,
        metadata=about("effective track, m; a robot and episode", LEAST, 2 * LARGEST_HULL),
    )
    max_wheel_speed: tuple[float, float] | None = field(
        default=None, metadata=about("rad/s; a robot and episode", LEAST, FASTEST_WHEEL)
    )
    mass: tuple[float, float] | None = field(
        default=None,
        metadata=about("kg; a robot and episode", above=2 * epuck.WHEEL_MASS, high=100.0),
    )
    friction: tuple[float, float] | None = field(
        default=None,
        metadata=about(
            "of wheel on floor; a robot and episode", LEAST, MOST_FRICTION, reason=FRICTION_REASON
        ),
    )
    hull_friction: tuple[float, float] | None = field(
        default=None,
        metadata=about(
            "of all hulls on hulls, boxes and walls; an episode",
            LEAST_HULL_FRICTION,
            MOST_HULL_FRICTION,
            reason=HULL_FRICTION_REASON,
        ),
    )
    speed_noise: float | None = field(
        default=None, metadata=about("relative deviation; a wheel and control step", 0.0, 1.0)
    )
    speed_quantisation: Literal["epuck1", "epuck2"] | None = field(
        default=None, metadata=about("wheel speeds that this firmware can make")
    )
    action_latency: tuple[int, int] | None = field(
        default=None,
        metadata=about(
            "control steps; a robot and episode", 0, _MOST_LATENCY, reason=_LATENCY_REASON
        ),
    )
    stall: float | None = field(
        default=None,
        metadata=about("probability that commands stop coming; a control step", 0.0, 1.0),
    )
    stall_time: tuple[float, float] = field(
        default=(0.1, 0.3), metadata=about("for how long, s; a stall", above=0.0, high=_LONGEST)
    )
    observation_latency: tuple[int, int] | None = field(
        default=None,
        metadata=about(
            "control steps; a robot and episode", 0, _MOST_LATENCY, reason=_LATENCY_REASON
        ),
    )
    target_distance_noise: float | None = field(
        default=None, metadata=about("deviation, m; a robot and control step", 0.0, 10.0)
    )
    target_bearing_noise: float | None = field(
        default=None, metadata=about("deviation, rad; a robot and control step", 0.0, math.pi)
    )
    packet_loss: float | None = field(
        default=None,
        metadata=about(
            "probability that a robot does not hear a neighbour; a pair and control step", 0.0, 1.0
        ),
    )
    neighbour_distance_noise: float | None = field(
        default=None, metadata=about("deviation, m; a pair and control step", 0.0, 10.0)
    )
    neighbour_bearing_noise: float | None = field(
        default=None, metadata=about("deviation, rad; a pair and control step", 0.0, math.pi)
    )

    def _check(self) -> None:
        if self.infrared != "ideal":
            return
        for key in COUNTED:
            value = getattr(self, key)
            if value is not None:
                raise ConfigError(
                    f"{key} is {show(value)}, but infrared is ideal and has no counts: give null, "
                    "or infrared=webots or infrared=real."
                )
