"""The robot and the compiled simulation: their settings."""

from dataclasses import dataclass, field
from typing import Literal

from swarmjax import epuck
from swarmjax.config import ConfigError, Section, about, show

# m; a level leaves a passage of 0.10 m (task/stage_config.py), through which a robot of this radius
# fits with a tenth of it to spare.
LARGEST_HULL = 0.045
_HULL_REASON = (
    "levels leave passages of 0.10 m, and a larger robot would not fit through them. To train "
    "larger ones, raise PASSAGE in swarmjax/task/stage_config.py and LARGEST_HULL in "
    "swarmjax/sim/config.py together"
)
# What MuJoCo's geometry, float32 and an arena of 0.4 to 4 m can bear; an e-puck drives 0.13 m/s.
LEAST = 0.001  # m, m/s, rad/s or of friction, of what is divided by
_FASTEST = 5.0  # m/s
_SPEED_REASON = "a faster robot crosses the largest arena, of 4 m, in less than a second"
_FASTEST_TURN = 50.0  # rad/s
_TURN_REASON = "a robot that turns faster is round more than once in a control step of 0.128 s"
FASTEST_WHEEL = 1000.0  # rad/s
MOST_FRICTION = 10.0
FRICTION_REASON = "rubber on rubber has less than 2"
# Below this MuJoCo's pyramid makes a wheeled robot's contact stiffer than float32 bears: crowds of
# tests/sim/test_rubbing.py are off by 1e-4 at 0.1, by 1e-3 at 0.05, and not finite at 0.001.
LEAST_HULL_FRICTION = 0.1
MOST_HULL_FRICTION = 2.0
HULL_FRICTION_REASON = "rubber on rubber has less than 2, and plastic rubs less"


@dataclass(frozen=True, kw_only=True)
class RobotConfig(Section):
    """The robot; the numbers are those of the e-puck, with their sources in epuck.py."""

    body: Literal["planar", "wheeled"] = field(
        default="planar",
        metadata=about("planar: 3 degrees of freedom and servos; wheeled: a free body on wheels"),
    )
    hull_radius: float = field(
        default=epuck.HULL_RADIUS,
        metadata=about("radius of the hull, m", above=0.0, high=LARGEST_HULL, reason=_HULL_REASON),
    )
    mass: float = field(
        default=epuck.MASS,
        metadata=about("mass with its wheels, kg", above=2 * epuck.WHEEL_MASS, high=100.0),
    )
    yaw_inertia: float = field(
        default=epuck.YAW_INERTIA,
        metadata=about("moment of inertia about the vertical axis, kg m^2", 1e-8, 10.0),
    )
    wheel_radius: float = field(
        default=epuck.WHEEL_RADIUS,
        metadata=about("radius of the wheels, m", LEAST, LARGEST_HULL),
    )
    track: float = field(
        default=epuck.TRACK,
        metadata=about(
            "distance between the wheels that commands are computed with, m",
            LEAST,
            2 * LARGEST_HULL,
        ),
    )
    effective_track: float = field(
        default=epuck.TRACK,
        metadata=about(
            "distance between the points where the wheels grip, m", LEAST, 2 * LARGEST_HULL
        ),
    )
    motor_lag: float = field(
        default=0.0,
        metadata=about("time constant of the wheel servos, s; 0: one physics step", 0.0, 1.0),
    )
    max_wheel_speed: float = field(
        default=epuck.MAX_WHEEL_SPEED,
        metadata=about("limit of each wheel, rad/s", LEAST, FASTEST_WHEEL),
    )
    friction: float = field(
        default=epuck.FRICTION,
        metadata=about("friction of wheel on floor", LEAST, MOST_FRICTION, reason=FRICTION_REASON),
    )
    hull_friction: float = field(
        default=0.0,
        metadata=about(
            "friction of the hull on hulls, boxes and walls; 0: they slide, Webots has 1",
            0.0,
            MOST_HULL_FRICTION,
            reason=HULL_FRICTION_REASON,
        ),
    )
    max_speed: float = field(
        default=epuck.MAX_SPEED,
        metadata=about(
            "upper end of the speed command, m/s; the lower is 0",
            LEAST,
            _FASTEST,
            reason=_SPEED_REASON,
        ),
    )
    max_turn_rate: float = field(
        default=epuck.MAX_TURN_RATE,
        metadata=about(
            "both ends of the turn command, rad/s",
            LEAST,
            _FASTEST_TURN,
            reason=_TURN_REASON,
        ),
    )

    def _check(self) -> None:
        if 0.0 < self.hull_friction < LEAST_HULL_FRICTION:
            raise ConfigError(
                f"hull_friction is {show(self.hull_friction)}, and so little makes contacts too "
                f"stiff for float32: give 0, or {show(LEAST_HULL_FRICTION)} to "
                f"{show(MOST_HULL_FRICTION)}."
            )
        hull = self.hull_radius
        for key, most in (("track", 2), ("effective_track", 2), ("wheel_radius", 1)):
            value = getattr(self, key)
            if value >= most * hull:
                raise ConfigError(
                    f"{key} is {show(value)}, but hull_radius is {show(hull)} and the wheels lie "
                    f"inside the hull: give less than {show(most * hull)}."
                )
        # Each wheel about its own upright axis, and as a point on the axle.
        wheels = 2 * (epuck.WHEEL_INERTIA[2] + epuck.WHEEL_MASS * epuck.AXLE_Y**2)
        if self.body == "wheeled" and self.yaw_inertia <= wheels:
            raise ConfigError(
                f"yaw_inertia is {show(self.yaw_inertia)}, but body is wheeled and its wheels "
                f"alone have {show(wheels)}: give more than {show(wheels)}."
            )


@dataclass(frozen=True, kw_only=True)
class SimConfig(Section):
    """The compiled simulation."""

    impl: Literal["auto", "jax", "warp"] = field(
        default="auto", metadata=about("who steps the physics; auto: warp on an NVIDIA GPU")
    )
    solver: Literal["auto", "mjx", "swarm"] = field(
        default="auto",
        metadata=about(
            "of contacts; mjx: MJX's own step, unpatched; swarm: made for the body, of wheels by "
            "warp; auto: swarm where there is one",
            renamed={"newton": "mjx"},
        ),
    )
    max_robots: int | None = field(
        default=None,
        metadata=about("robots compiled in; null: 5, or as many as the stages need", 1, 100),
    )
    max_obstacles: int | None = field(
        default=None,
        metadata=about("obstacles compiled in; null: 4, or as many as the stages need", 0, 64),
    )
    substeps: int | None = field(
        default=None,
        metadata=about("physics steps per control step; null: those of the body", 1, 1000),
    )
    iterations: int | None = field(
        default=None,
        metadata=about("of the solver, at most; on wheels by swarm 20; null: as measured", 1, 1000),
    )
    ls_iterations: int | None = field(
        default=None,
        metadata=about("line-search iterations of mjx; null: as measured", 1, 1000),
    )

    @property
    def robots(self) -> int:
        """Robots compiled in."""
        return 5 if self.max_robots is None else self.max_robots

    @property
    def obstacles(self) -> int:
        """Obstacles compiled in."""
        return 4 if self.max_obstacles is None else self.max_obstacles


def physics_substeps(robot: RobotConfig, given: int | None) -> int:
    """Return the physics steps per control step: those given, else those that the body needs."""
    return {"planar": 1, "wheeled": 2}[robot.body] if given is None else given
