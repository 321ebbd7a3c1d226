"""Settings of the robot and of the compiled simulation."""

from dataclasses import dataclass
from typing import Literal

from swarmjax import epuck
from swarmjax.config import ConfigError, Section, setting, show
from swarmjax.sim import sensors

# m; wider hulls make wider passages (`passage` in task/stage_config.py). A passage for this hull is
# 0.41 m wide, a tenth of the side of a 4 m arena.
LARGEST_HULL = 0.15
_HULL_REASON = "passages are 2.7 hull radii wide, and an arena of 4 m would hold few of them"
# Within these limits, MuJoCo's geometry and float32 work in arenas of 0.4 to 4 m. For comparison,
# an e-puck drives at 0.13 m/s.
LEAST = 0.001  # m, m/s, rad/s or friction; lower limit of all settings that code divides by
_FASTEST = 5.0  # m/s
_SPEED_REASON = "a faster robot crosses an arena of 4 m in less than a second"
_FASTEST_TURN = 50.0  # rad/s
_TURN_REASON = "a faster turn makes more than one rotation in a control step of 0.128 s"
FASTEST_WHEEL = 1000.0  # rad/s
MOST_FRICTION = 10.0
_ROUNDING = 1e-6  # relative rounding error allowed in a product of decimal numbers
FRICTION_REASON = "rubber on rubber has less than 2"
# With less friction, MuJoCo's pyramidal cone makes a wheeled robot's contact too stiff for float32.
# The results for the crowds of tests/sim/test_rubbing.py were wrong by 1e-4 with friction 0.1 and
# by 1e-3 with friction 0.05; with friction 0.001, they were not finite.
LEAST_HULL_FRICTION = 0.1
MOST_HULL_FRICTION = 2.0
HULL_FRICTION_REASON = "rubber on rubber has less than 2, and plastic has less than that"


@dataclass(frozen=True, kw_only=True)
class RobotConfig(Section):
    """Settings of the robot. The defaults are the e-puck's; epuck.py gives their sources."""

    body: Literal["planar", "wheeled"] = setting(
        "planar", "planar: a disc with 3 degrees of freedom; wheeled: a free body on two wheels"
    )
    hull_radius: float = setting(
        epuck.HULL_RADIUS,
        "radius of the hull, m",
        above=0.0,
        high=LARGEST_HULL,
        reason=_HULL_REASON,
    )
    mass: float = setting(epuck.MASS, "mass including wheels, kg", above=0.0, high=100.0)
    wheel_mass: float = setting(epuck.WHEEL_MASS, "mass of each wheel, kg", 1e-6, 10.0)
    yaw_inertia: float = setting(
        epuck.YAW_INERTIA, "moment of inertia about the vertical axis, kg m^2", 1e-8, 10.0
    )
    wheel_radius: float = setting(
        epuck.WHEEL_RADIUS, "radius of the wheels, m", LEAST, LARGEST_HULL
    )
    track: float = setting(
        epuck.TRACK,
        "distance between the wheels, used to convert commands to wheel speeds, m",
        LEAST,
        2 * LARGEST_HULL,
    )
    effective_track: float | None = setting(
        None,
        "distance between the points where the wheels grip, m; null: as track",
        LEAST,
        2 * LARGEST_HULL,
    )
    motor_lag: float = setting(
        0.0, "time constant of the wheel servos, s; 0: one physics step", 0.0, 1.0
    )
    max_wheel_speed: float = setting(
        epuck.MAX_WHEEL_SPEED, "speed limit of each wheel, rad/s", LEAST, FASTEST_WHEEL
    )
    friction: float = setting(
        epuck.FRICTION, "friction of wheels on floor", LEAST, MOST_FRICTION, reason=FRICTION_REASON
    )
    hull_friction: float = setting(
        0.0,
        "friction of hulls on hulls, boxes and walls; 0: none; Webots has 1",
        0.0,
        MOST_HULL_FRICTION,
        reason=HULL_FRICTION_REASON,
    )
    max_speed: float = setting(
        epuck.MAX_SPEED,
        "upper limit of the speed command, m/s; the lower limit is 0",
        LEAST,
        _FASTEST,
        reason=_SPEED_REASON,
    )
    wheel_limit: Literal["refuse", "clip"] = setting(
        "refuse", "if the wheels cannot reach max_speed: refuse the settings, or clip the speed"
    )
    max_turn_rate: float = setting(
        epuck.MAX_TURN_RATE,
        "limit of the turn command in both directions, rad/s",
        LEAST,
        _FASTEST_TURN,
        reason=_TURN_REASON,
    )

    sensor_poses: tuple[sensors.Pose, ...] = setting(
        epuck.SENSOR_POSES,
        "x (m), y (m) and yaw (rad) of each infrared sensor, in order",
    )
    sensor_range: float = setting(epuck.SENSOR_RANGE, "infrared range, m", above=0.0, high=1.0)
    sensor_height: float = setting(
        epuck.SENSOR_HEIGHT,
        "height of the infrared sensors, between bottom and top of the hull, m",
        above=epuck.HULL_BOTTOM,
        below=epuck.HULL_TOP,
    )
    sensor_tilt: float = setting(
        epuck.SENSOR_TILT, "upward tilt of the infrared rays, rad", -1.0, 1.0
    )
    sensor_response: tuple[sensors.Point, ...] = setting(
        epuck.INFRARED_TABLE,
        "table of ray length (m), sensor count and relative SD, for realism.infrared=webots",
        0.0,
        sensors.MOST_VALUE,
    )

    @property
    def grip_track(self) -> float:
        """Distance between the points where the wheels grip, m."""
        return self.track if self.effective_track is None else self.effective_track

    @property
    def wheel_inertia(self) -> list[float]:
        """Moments of inertia of a wheel, kg m^2: those of the e-puck's wheel, scaled by the mass.

        The values do not depend on the wheel's radius. About the axle, the motor's inertia is far
        larger than the wheel's. About the upright axis, the body adds the rest of `yaw_inertia`.
        """
        return [self.wheel_mass / epuck.WHEEL_MASS * part for part in epuck.WHEEL_INERTIA]

    def _check(self) -> None:
        object.__setattr__(self, "effective_track", self.grip_track)
        if 0.0 < self.hull_friction < LEAST_HULL_FRICTION:
            raise ConfigError(
                f"hull_friction is {show(self.hull_friction)}, which makes contacts too stiff for "
                f"float32: give 0, or {show(LEAST_HULL_FRICTION)} to "
                f"{show(MOST_HULL_FRICTION)}."
            )
        hull = self.hull_radius
        for key, most in (("track", 2), ("effective_track", 2), ("wheel_radius", 1)):
            value = getattr(self, key)
            if value >= most * hull:
                raise ConfigError(
                    f"{key} is {show(value)}, but hull_radius is {show(hull)} and the wheels must "
                    f"lie inside the hull: give less than {show(most * hull)}."
                )
        reach = self.wheel_radius * self.max_wheel_speed
        if self.wheel_limit == "refuse" and self.max_speed > reach * (1 + _ROUNDING):
            raise ConfigError(
                f"max_speed is {show(self.max_speed)}, but wheels of {show(self.wheel_radius)} m "
                f"at {show(self.max_wheel_speed)} rad/s reach only {show(reach)} m/s: give at most "
                f"{show(reach)}, or wheel_limit=clip, which limits the speed to that."
            )
        sensors.check_poses(self.sensor_poses, hull, self.sensor_range)
        sensors.check_response(self.sensor_response)
        if self.mass <= 2 * self.wheel_mass:
            raise ConfigError(
                f"mass is {show(self.mass)}, but wheel_mass is {show(self.wheel_mass)} and mass "
                f"includes both wheels: give more than {show(2 * self.wheel_mass)}."
            )
        # Each wheel contributes its inertia about its own upright axis, plus the inertia of a point
        # mass at the end of the axle.
        wheels = 2 * (self.wheel_inertia[2] + self.wheel_mass * (0.5 * self.track) ** 2)
        if self.body == "wheeled" and self.yaw_inertia <= wheels:
            raise ConfigError(
                f"yaw_inertia is {show(self.yaw_inertia)}, but body is wheeled, and the wheels "
                f"alone have {show(wheels)}: give more than {show(wheels)}."
            )


@dataclass(frozen=True, kw_only=True)
class SimConfig(Section):
    """Settings of the compiled simulation."""

    impl: Literal["auto", "jax", "warp"] = setting(
        "auto", "physics implementation; auto: warp on an NVIDIA GPU, else jax"
    )
    solver: Literal["auto", "mjx", "swarm"] = setting(
        "auto",
        "contact solver; mjx: MJX's own, unpatched; swarm: swarmjax's own, for wheeled "
        "robots only with impl=warp; auto: swarm where available",
    )
    max_robots: int | None = setting(
        None, "robots to compile for; null: as many as the stages need, at least 5", 1, 1024
    )
    max_obstacles: int | None = setting(
        None, "obstacles to compile for; null: as many as the stages need, at least 4", 0, 256
    )
    substeps: int | None = setting(
        None, "physics steps per control step; null: 1 for planar, 2 for wheeled", 1, 1000
    )

    @property
    def robots(self) -> int:
        """Number of robots to compile for."""
        return 5 if self.max_robots is None else self.max_robots

    @property
    def obstacles(self) -> int:
        """Number of obstacles to compile for."""
        return 4 if self.max_obstacles is None else self.max_obstacles


def physics_substeps(robot: RobotConfig, given: int | None) -> int:
    """Returns the physics steps per control step: the given number, or else the body's default."""
    return {"planar": 1, "wheeled": 2}[robot.body] if given is None else given
