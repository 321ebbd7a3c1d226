"""Every setting of swarmjax: frozen dataclasses, their defaults and their checks; no JAX.

A command line of `key=value` words becomes one of `TrainConfig`, `EvaluateConfig` and
`ExportConfig`. `compose` only puts the YAML files of configs/ and those words together. Whatever
comes out goes through `settings.build`, the one strict converter, and every mistake ends as one
`ConfigError` sentence that names the key as the user types it, the value, and what is allowed. The
files hold what tells robots, realism, algorithms and stages apart; each default stands here.
"""

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from swarmjax import compose, epuck, settings
from swarmjax.settings import ConfigError, Section, about, build, show, to_dict

MAX_COUNT = 2**31 - 1  # counts and seeds are int32 on the device

# The room that a random level asks for. A start and a target each take a square of 0.15 m (two
# hulls of 0.074 m side by side); an obstacle takes the square about its circumscribed circle,
# widened by a passage through which one robot fits with 13 mm to spare on either side; along the
# walls a border of half a passage stays free.
DISC = 0.15  # m, edge of the square about the disc of a start or a target
PASSAGE = 0.10  # m; between obstacles, and between an obstacle and a wall
FILLING = 0.4  # boxes per square of a grid that random placing surely reaches

# What may change when a run goes on; everything else fixes what it has computed so far.
_RESUME_KEYS = ("budget", "resume", "run.*")
# The options of a curriculum that not all modes take: those that do, and what null stands for.
_STEPWISE = ("sequential", "mixed")
_MODE_OPTIONS: dict[str, tuple[tuple[str, ...], float | str | None]] = {
    "threshold": (_STEPWISE, 0.8),
    "demotion": (_STEPWISE, None),
    "budget_share": (_STEPWISE, 0.5),
    "earlier_share": (("mixed",), 0.2),
    "score": (("adaptive",), "learnability"),
    "floor": (("adaptive",), 0.1),
    "optimizer": (_STEPWISE, "keep"),
    "normalizer": (_STEPWISE, "keep"),
    "exploration": (_STEPWISE, "keep"),
    "newcomers": (_STEPWISE, "copy"),
}
# What is counted has no meaning for sensors that report metres.
COUNTED = (
    "infrared_noise",
    "infrared_gain",
    "infrared_offset",
    "reflectance_wall",
    "reflectance_obstacle",
    "reflectance_robot",
)


_Cell = tuple[int, int, float | tuple[float, float]]  # robots, obstacles, side


@dataclass(frozen=True, kw_only=True)
class StageConfig(Section):
    """One stage: how many robots, how large an arena, which obstacles."""

    name: str = field(metadata=about("name of the stage, that of its file"))
    robots: int = field(metadata=about("active robots", 1, 100))
    side: float | tuple[float, float] = field(
        metadata=about("side of the square arena, m; a range: drawn anew for each level", 0.4, 4.0)
    )
    obstacles: int = field(default=0, metadata=about("obstacles", 0, 32))
    obstacle_size: float = field(
        default=0.10, metadata=about("edge of the square boxes of a random level, m", 0.02, 0.3)
    )
    level: Literal["random", "fixed"] = field(
        default="random", metadata=about("a new level every episode, or always the same one")
    )
    layout: Literal["boxes", "fence"] = field(
        default="boxes", metadata=about("obstacles of a fixed level")
    )

    def _check(self) -> None:
        if not re.fullmatch(r"[\w-]+", self.name):
            raise ConfigError(f"name is {show(self.name)}: give letters, digits, _ and - only.")
        if self.layout == "fence" and self.level != "fixed":
            raise ConfigError(f"layout is fence, but level is {self.level}: give level=fixed.")
        if self.layout == "fence" and self.obstacles < 1:
            raise ConfigError("obstacles is 0, but layout is fence: give 1 or more.")
        if self.level == "fixed" and isinstance(self.side, tuple):
            raise ConfigError(f"side is {show(self.side)}, but level is fixed: give one number.")
        least = smallest_side(self)
        if self.sides[0] < least:
            raise ConfigError(
                f"side is {show(self.side)}, too small for robots={self.robots}, "
                f"obstacles={self.obstacles}, obstacle_size={show(self.obstacle_size)}: "
                f"give at least {math.ceil(100 * least) / 100}."
            )

    @property
    def sides(self) -> tuple[float, float]:
        """The smallest and the largest side of the arena, m."""
        return _ends(self.side)


def smallest_side(stage: StageConfig) -> float:
    """Side of the smallest arena in which a level of the stage can be laid out.

    The free square (side - 0.10)^2 must hold two squares of 0.15^2 for each robot and one of
    (obstacle_size * sqrt(2) + 0.10)^2 for each obstacle, which leaves more than a passage on
    either side of any one obstacle. Those of a random level, placed one after the other, may fill
    FILLING of it: discs that are placed so jam at 0.547 of the area (Feder 1980), which is 0.70 of
    a square grid of them, and the walls cut some off.

    Args:
        stage: the stage; its `side` is not read.

    Returns:
        The side, m.
    """
    random = stage.level == "random"
    return _smallest_side(stage.robots, stage.obstacles, stage.obstacle_size, random=random)


def _smallest_side(robots: int, obstacles: int, obstacle_size: float, *, random: bool) -> float:
    pitch = obstacle_size * math.sqrt(2) + PASSAGE
    area = robots * 2 * DISC**2 + obstacles * pitch**2
    if random:
        area = max(area, obstacles * pitch**2 / FILLING)
    return PASSAGE + math.sqrt(area)


def _ends(side: float | tuple[float, float]) -> tuple[float, float]:
    return side if isinstance(side, tuple) else (side, side)


@dataclass(frozen=True, kw_only=True)
class GridConfig(Section):
    """Stages: every number of robots with every number of obstacles in every arena."""

    robots: tuple[int, ...] = field(metadata=about("active robots", 1, 100))
    obstacles: tuple[int, ...] = field(default=(0,), metadata=about("obstacles", 0, 32))
    side: tuple[float | tuple[float, float], ...] = field(
        metadata=about("sides of the square arena, m, or ranges that they are drawn from", 0.4, 4.0)
    )
    obstacle_size: float = field(
        default=0.10, metadata=about("edge of the square boxes, m", 0.02, 0.3)
    )

    def _check(self) -> None:
        for key in ("robots", "obstacles", "side"):
            if not getattr(self, key):
                raise ConfigError(f"{key} is []: give at least one number.")
        if not self.stages():
            least = min(self._least(cell) for cell in self._cells())
            raise ConfigError(
                f"side is {show(self.side)}, which leaves no cell: the smallest swarm with the "
                f"fewest obstacles needs {math.ceil(100 * least) / 100}."
            )

    def stages(self) -> tuple[StageConfig, ...]:
        """Make the stages, the side changing fastest and the robots slowest.

        Cells whose arena is too small for what is in them are left out.
        """
        cells = [cell for cell in self._cells() if _ends(cell[2])[0] >= self._least(cell)]
        return tuple(
            StageConfig(
                name=_cell_name(*cell),
                robots=cell[0],
                obstacles=cell[1],
                side=cell[2],
                obstacle_size=self.obstacle_size,
            )
            for cell in cells
        )

    def _cells(self) -> Iterator[_Cell]:
        return itertools.product(self.robots, self.obstacles, self.side)

    def _least(self, cell: _Cell) -> float:
        return _smallest_side(cell[0], cell[1], self.obstacle_size, random=True)


def _cell_name(robots: int, obstacles: int, side: float | tuple[float, float]) -> str:
    """Name a cell of a grid by its numbers, lengths in cm, as r5-o3-s120 or r5-o3-s50-120."""
    ends = side if isinstance(side, tuple) else (side,)
    lengths = "-".join(f"{100 * length:.6g}".replace(".", "_") for length in ends)
    return f"r{robots}-o{obstacles}-s{lengths}"


@dataclass(frozen=True, kw_only=True)
class RobotConfig(Section):
    """The robot; the numbers are those of the e-puck, with their sources in epuck.py."""

    body: Literal["planar", "wheeled"] = field(
        default="planar",
        metadata=about("planar: 3 degrees of freedom and servos; wheeled: a free body on wheels"),
    )
    hull_radius: float = field(
        default=epuck.HULL_RADIUS,
        metadata=about("radius of the hull, m", above=0.0, high=0.45 * PASSAGE),
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
        default=epuck.WHEEL_RADIUS, metadata=about("radius of the wheels, m", above=0.0)
    )
    track: float = field(
        default=epuck.TRACK,
        metadata=about("distance between the wheels that commands are computed with, m", above=0),
    )
    effective_track: float = field(
        default=epuck.TRACK,
        metadata=about("distance between the points where the wheels grip, m", above=0.0),
    )
    motor_lag: float = field(
        default=0.0,
        metadata=about("time constant of the wheel servos, s; 0: one physics step", 0.0, 1.0),
    )
    max_wheel_speed: float = field(
        default=epuck.MAX_WHEEL_SPEED, metadata=about("limit of each wheel, rad/s", above=0.0)
    )
    friction: float = field(
        default=epuck.FRICTION, metadata=about("friction of wheel on floor", above=0.0)
    )
    max_speed: float = field(
        default=epuck.MAX_SPEED,
        metadata=about("upper end of the speed command, m/s; the lower is 0", above=0.0),
    )
    max_turn_rate: float = field(
        default=epuck.MAX_TURN_RATE,
        metadata=about("both ends of the turn command, rad/s", above=0.0),
    )

    def _check(self) -> None:
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
class RewardConfig(Section):
    """Weights of the named terms of the reward; the defaults are equation 3 of the paper."""

    progress: float = field(default=1.0, metadata=about("per metre nearer to the target"))
    proximity: float = field(
        default=-0.001, metadata=about("per control step with something in infrared range")
    )
    arrival: float = field(default=0.0, metadata=about("once, on arrival"))
    contact: float = field(default=0.0, metadata=about("per contact event"))
    time: float = field(default=0.0, metadata=about("per control step"))


@dataclass(frozen=True, kw_only=True)
class TaskConfig(Section):
    """What a robot is asked to do, and what it senses."""

    control_step: float = field(
        default=0.032, metadata=about("control step, s; Webots basicTimeStep", 0.001, 0.2)
    )
    step_limit: int = field(
        default=500, metadata=about("control steps of a training episode", 1, MAX_COUNT)
    )
    target_radius: float = field(
        default=0.05,
        metadata=about("distance of the centres that counts as arrival, m", above=0.0, high=0.1),
    )
    sensor_range: float = field(
        default=epuck.SENSOR_RANGE, metadata=about("infrared range, m", above=0.0, high=1.0)
    )
    encoding: Literal["auto", "metric", "webots"] = field(
        default="auto",
        metadata=about("what is observed: m and rad, or as in Webots; auto: as realism.infrared"),
    )
    reward: RewardConfig = field(default_factory=RewardConfig)


@dataclass(frozen=True, kw_only=True)
class AlgoConfig(Section):
    """PPO; clip, learning rates, discount and initial deviation are Table 1 of the paper."""

    name: Literal["ppo"] = field(default="ppo", metadata=about("algorithm"))
    policy: Literal["shared", "independent"] = field(
        default="shared", metadata=about("one policy for all robots, or one for each")
    )
    hidden: tuple[int, ...] = field(
        default=(64, 64), metadata=about("widths of the hidden layers", 1, 4096)
    )
    activation: Literal["tanh", "relu", "swish"] = field(
        default="tanh", metadata=about("activation of the hidden layers")
    )
    rollout: int = field(default=32, metadata=about("control steps per update", 1, MAX_COUNT))
    epochs: int = field(default=4, metadata=about("passes over each rollout", 1, MAX_COUNT))
    minibatches: int = field(
        default=8, metadata=about("gradient steps per pass; divides arenas", 1, MAX_COUNT)
    )
    discount: float = field(default=0.99, metadata=about("per control step", 0.0, 1.0))
    gae_lambda: float = field(default=0.95, metadata=about("of the advantages", 0.0, 1.0))
    clip: float = field(default=0.2, metadata=about("of the probability ratio", above=0.0))
    actor_learning_rate: float = field(
        default=3e-4, metadata=about("of the policy", above=0.0, high=1.0)
    )
    critic_learning_rate: float = field(
        default=1e-3, metadata=about("of the value", above=0.0, high=1.0)
    )
    learning_rate_schedule: Literal["constant", "linear"] = field(
        default="linear", metadata=about("linear falls to 0 at the end of the budget")
    )
    max_grad_norm: float = field(
        default=0.5, metadata=about("norm at which gradients are clipped", above=0.0)
    )
    value_cost: float = field(default=0.5, metadata=about("weight of the value loss", 0.0))
    entropy_cost: float = field(default=0.0, metadata=about("weight of the entropy", 0.0))
    initial_std: float = field(
        default=0.6, metadata=about("initial deviation of the action", above=0.0)
    )

    def _check(self) -> None:
        if not self.hidden:
            raise ConfigError("hidden is []: give at least one layer, as in [64,64].")


@dataclass(frozen=True, kw_only=True)
class CurriculumConfig(Section):
    """Who trains on which stage, when that changes, and what a promotion does to the learners.

    An option of some modes only, as its meaning says, is null in the others and may be null in
    its own, where it then takes its default.
    """

    mode: Literal["sequential", "mixed", "adaptive"] = field(
        default="sequential",
        metadata=about(
            "sequential: all on the newest stage; mixed: some on earlier ones; adaptive: on all "
            "stages, most where most is learned"
        ),
    )
    success: Literal["targets", "all"] = field(
        default="targets",
        metadata=about("what decides: share of targets, or of episodes in which all arrived"),
    )
    threshold: float | None = field(
        default=None,
        metadata=about("success that promotes; null: 0.8 [sequential, mixed]", 0.0, 1.0),
    )
    demotion: float | None = field(
        default=None,
        metadata=about(
            "success below which the stage before returns; null: never [sequential, mixed]",
            0.0,
            1.0,
        ),
    )
    budget_share: float | None = field(
        default=None,
        metadata=about(
            "share of the budget for all stages before the last, in equal parts; null: 0.5 "
            "[sequential, mixed]",
            above=0.0,
            below=1.0,
        ),
    )
    earlier_share: float | None = field(
        default=None,
        metadata=about(
            "share of the arenas on earlier stages; null: 0.2 [mixed]", above=0.0, below=1.0
        ),
    )
    score: Literal["learnability", "progress"] | None = field(
        default=None,
        metadata=about(
            "learnability: p (1 - p) of success p; progress: how fast it changes; null: "
            "learnability [adaptive]"
        ),
    )
    floor: float | None = field(
        default=None,
        metadata=about(
            "share of the arenas spread evenly over all stages; null: 0.1 [adaptive]",
            above=0.0,
            high=1.0,
        ),
    )
    optimizer: Literal["keep", "reset"] = field(
        default="keep",
        metadata=about("moments of Adam at a promotion; reset: to 0 [sequential, mixed]"),
    )
    normalizer: Literal["keep", "relearn"] = field(
        default="keep",
        metadata=about(
            "at a promotion; relearn: from the next batch, without the past [sequential, mixed]"
        ),
    )
    exploration: Literal["keep", "reset"] = field(
        default="keep",
        metadata=about("at a promotion; reset: to algo.initial_std [sequential, mixed]"),
    )
    newcomers: Literal["copy", "fresh"] = field(
        default="copy",
        metadata=about(
            "independent policies of robots that a promotion adds; copy: of those that trained, "
            "in turn [sequential, mixed]"
        ),
    )

    def _check(self) -> None:
        for key, (modes, default) in _MODE_OPTIONS.items():
            value = getattr(self, key)
            plain = getattr(CurriculumConfig, key)
            if self.mode not in modes and value != plain:
                raise ConfigError(
                    f"{key} is {show(value, quote='')}, but mode is {self.mode}: {key} is an "
                    f"option of {' and '.join(modes)}, so give {show(plain, quote='')} or "
                    f"mode={modes[0]}."
                )
            if self.mode in modes and value is None:
                object.__setattr__(self, key, default)
        if self.demotion is None or self.threshold is None:
            return
        if self.demotion >= self.threshold:
            raise ConfigError(
                f"demotion is {show(self.demotion)}, but threshold is {show(self.threshold)}: "
                f"give less than {show(self.threshold)}."
            )


@dataclass(frozen=True, kw_only=True)
class SimConfig(Section):
    """The compiled simulation."""

    impl: Literal["auto", "jax", "warp"] = field(
        default="auto", metadata=about("MJX implementation; auto: warp on an NVIDIA GPU")
    )
    max_robots: int = field(default=5, metadata=about("robots compiled in", 1, 100))
    max_obstacles: int = field(default=4, metadata=about("obstacles compiled in", 0, 32))
    substeps: int | None = field(
        default=None,
        metadata=about("physics steps per control step; null: those of the body", 1, 1000),
    )
    iterations: int | None = field(
        default=None,
        metadata=about("solver iterations; null: measured for the implementation", 1, 1000),
    )
    ls_iterations: int | None = field(
        default=None,
        metadata=about("line-search iterations; null: measured likewise", 1, 1000),
    )


@dataclass(frozen=True, kw_only=True)
class RunConfig(Section):
    """Where a run is written, and how often."""

    dir: str | None = field(
        default=None, metadata=about("run directory; null: runs/<date>-<time>-<stage name>")
    )
    chunk: int | Literal["all", "auto"] = field(
        default="auto", metadata=about("updates per call of the compiled program", 1, MAX_COUNT)
    )
    checkpoint_minutes: float = field(
        default=5.0, metadata=about("minutes between checkpoints; 0: after every chunk", 0.0)
    )
    keep_checkpoints: int = field(
        default=2, metadata=about("checkpoints that are kept", 1, MAX_COUNT)
    )
    stop_after: int | None = field(
        default=None,
        metadata=about("updates after which the run saves and stops", 0, MAX_COUNT),
    )
    tensorboard: bool = field(default=True, metadata=about("write TensorBoard events"))
    dry: bool = field(default=False, metadata=about("check and describe the run, train nothing"))


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
            "between samples, s; a robot and episode; null: every control step", above=0.0
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
        default=None, metadata=about("m; a robot and episode", above=0.0, below=0.03)
    )
    wheel_mismatch: float | None = field(
        default=None,
        metadata=about(
            "deviation of the relative left/right difference; a robot and episode", 0.0, 0.1
        ),
    )
    track: tuple[float, float] | None = field(
        default=None, metadata=about("effective track, m; a robot and episode", above=0.0)
    )
    max_wheel_speed: tuple[float, float] | None = field(
        default=None, metadata=about("rad/s; a robot and episode", above=0.0)
    )
    mass: tuple[float, float] | None = field(
        default=None,
        metadata=about("kg; a robot and episode", above=2 * epuck.WHEEL_MASS, high=100.0),
    )
    friction: tuple[float, float] | None = field(
        default=None, metadata=about("of wheel on floor; a robot and episode", above=0.0)
    )
    speed_noise: float | None = field(
        default=None, metadata=about("relative deviation; a wheel and control step", 0.0, 1.0)
    )
    speed_quantisation: Literal["epuck1", "epuck2"] | None = field(
        default=None, metadata=about("wheel speeds that this firmware can make")
    )
    action_latency: tuple[int, int] | None = field(
        default=None, metadata=about("control steps; a robot and episode", 0, MAX_COUNT)
    )
    stall: float | None = field(
        default=None,
        metadata=about("probability that commands stop coming; a control step", 0.0, 1.0),
    )
    stall_time: tuple[float, float] = field(
        default=(0.1, 0.3), metadata=about("for how long, s; a stall", above=0.0)
    )
    observation_latency: tuple[int, int] | None = field(
        default=None, metadata=about("control steps; a robot and episode", 0, MAX_COUNT)
    )
    target_distance_noise: float | None = field(
        default=None, metadata=about("deviation, m; a robot and control step", 0.0)
    )
    target_bearing_noise: float | None = field(
        default=None, metadata=about("deviation, rad; a robot and control step", 0.0, math.pi)
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


def _check_realism(
    realism: RealismConfig, robot: RobotConfig, task: TaskConfig, steps: int
) -> None:
    """Refuse realism that the robot or the length of an episode rules out.

    Args:
        realism: held to its own bounds already.
        robot: the robot it is for.
        task: read for the control step.
        steps: control steps of an episode.

    Raises:
        ConfigError: keys are named from the top.
    """
    hull, seconds = robot.hull_radius, steps * task.control_step
    for key, value, most in (
        ("track", realism.track, 2 * hull),
        ("wheel_radius", realism.wheel_radius, hull),
    ):
        if value is not None and value[1] >= most:
            raise ConfigError(
                f"realism.{key} is {show(value)}, but robot.hull_radius is {show(hull)} and the "
                f"wheels lie inside the hull: give less than {show(most)}."
            )
    stall_time = None if realism.stall is None else realism.stall_time
    for key, value, length, unit in (
        ("action_latency", realism.action_latency, steps, "control steps"),
        ("observation_latency", realism.observation_latency, steps, "control steps"),
        ("infrared_period", realism.infrared_period, seconds, "s"),
        ("stall_time", stall_time, seconds, "s"),
    ):
        if value is not None and value[1] >= length:
            raise ConfigError(
                f"realism.{key} is {show(value)}, but an episode takes {show(length)} {unit}: "
                f"give less than {show(length)}."
            )


def substeps(robot: RobotConfig, given: int | None) -> int:
    """Return the physics steps per control step: those given, else those that the body needs."""
    return {"planar": 1, "wheeled": 2}[robot.body] if given is None else given


def encoding(task: TaskConfig, realism: RealismConfig) -> Literal["metric", "webots"]:
    """Return what the policy observes.

    `metric` are metres and radians as they are. `webots` are counts / 1023, distance / 1.5 m and
    (bearing + pi) / (2 pi), as in deepworlds' find_and_avoid.
    """
    if task.encoding != "auto":
        return task.encoding
    return "webots" if realism.infrared == "webots" else "metric"


@dataclass(frozen=True, kw_only=True)
class TrainConfig(Section):
    """Everything that fixes a training run."""

    stage: tuple[StageConfig, ...]
    robot: RobotConfig = field(default_factory=RobotConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    algo: AlgoConfig = field(default_factory=AlgoConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    sim: SimConfig = field(default_factory=SimConfig)
    run: RunConfig = field(default_factory=RunConfig)
    seed: int = field(default=0, metadata=about("random seed", 0, MAX_COUNT))
    seeds: int = field(
        default=1, metadata=about("runs trained at once, of seed, seed + 1, ...", 1, 4096)
    )
    seeds_by: Literal["vmap", "map"] = field(
        default="vmap",
        metadata=about("vmap: side by side; map: in turn, each as it would be alone, bit for bit"),
    )
    arenas: int = field(default=128, metadata=about("arenas simulated at once", 1, 2**20))
    budget: int = field(
        default=3_000_000, metadata=about("control steps of all arenas together", 1, 10**15)
    )
    realism: RealismConfig = field(default_factory=RealismConfig)
    resume: str | None = field(default=None, metadata=about("run directory to go on with"))
    start: str | None = field(
        default=None,
        metadata=about("run directory whose networks and normaliser a new run begins with"),
    )
    start_std: Literal["keep", "reset"] = field(
        default="keep",
        metadata=about("exploration that start begins with: as learned, or algo.initial_std"),
    )
    stage_name: str = field(
        default="",
        metadata=about("the one stage, or what the curriculum is called", derived=True),
    )

    def _check(self) -> None:
        if self.seed + self.seeds - 1 > MAX_COUNT:
            raise ConfigError(
                f"seed is {self.seed}, but seeds is {self.seeds} and the last seed may be "
                f"{MAX_COUNT}: give at most {MAX_COUNT - self.seeds + 1}."
            )
        self._check_stages()
        if self.arenas % self.algo.minibatches:
            raise ConfigError(
                f"arenas is {self.arenas}, but algo.minibatches is {self.algo.minibatches}: "
                f"give a multiple of {self.algo.minibatches}."
            )
        self._check_budget()
        self._check_counts()
        _check_realism(self.realism, self.robot, self.task, self.task.step_limit)
        names = [stage.name for stage in self.stage]
        if len(names) == 1 or not self.stage_name:
            object.__setattr__(self, "stage_name", "-".join(names))

    def _check_stages(self) -> None:
        if not self.stage:
            raise ConfigError("stage is []: give at least one stage.")
        names = [stage.name for stage in self.stage]
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f"stage names {name} more than once: give each stage once.")
        for stage in self.stage:
            where = "stage." if len(names) == 1 else f"stage {stage.name}: "
            for key, least in (("robots", 1), ("obstacles", 0)):
                value, most = getattr(stage, key), getattr(self.sim, f"max_{key}")
                if value > most:
                    raise ConfigError(
                        f"{where}{key} is {value}, but sim.max_{key} is {most}: "
                        f"give {least} to {most}."
                    )

    def _check_counts(self) -> None:
        steps = max(self.task.step_limit, self.algo.rollout)
        most = MAX_COUNT // (self.sim.max_robots * steps)
        if self.arenas > most:
            raise ConfigError(
                f"arenas is {self.arenas}, but robot steps are counted in 32 bits, and "
                f"{self.sim.max_robots} robots for {steps} control steps leave room for {most}: "
                f"give at most {most}."
            )

    def _check_budget(self) -> None:
        update = self.arenas * self.algo.rollout
        if self.updates < 1:
            raise ConfigError(
                f"budget is {self.budget}, but one update takes arenas x algo.rollout = {update} "
                f"control steps: give at least {update}."
            )
        if self.updates > MAX_COUNT:
            raise ConfigError(
                f"budget is {self.budget}, which is {self.updates} updates of {update} control "
                f"steps, and updates are counted up to {MAX_COUNT}: give at most "
                f"{MAX_COUNT * update}."
            )

    @property
    def updates(self) -> int:
        """Updates that the budget pays for; what is left over is not spent."""
        return self.budget // (self.arenas * self.algo.rollout)

    @property
    def learners(self) -> int:
        """Actor-critics that are trained: one, or one for each robot."""
        return self.sim.max_robots if self.algo.policy == "independent" else 1


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(Section):
    """Everything that fixes an evaluation of a policy."""

    policy: str = field(metadata=about("path of a policy.npz"))
    stage: StageConfig
    robot: RobotConfig = field(default_factory=RobotConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    suite: None = field(default=None, metadata=about("a list of stages; not built yet"))
    realism: RealismConfig = field(default_factory=RealismConfig)
    engine: Literal["c"] = field(default="c", metadata=about("MuJoCo's C engine"))
    steps: int = field(
        default=1500, metadata=about("control steps of an episode; Table 1", 1, MAX_COUNT)
    )
    episodes: int = field(default=1000, metadata=about("episodes", 1, MAX_COUNT))
    seed: int = field(default=1, metadata=about("random seed of the levels", 0, MAX_COUNT))
    workers: int | None = field(
        default=None, metadata=about("processes; null: one a core", 1, 1024)
    )
    substeps: int | None = field(
        default=None,
        metadata=about("physics steps per control step; null: those of the body", 1, 1000),
    )
    out: str | None = field(default=None, metadata=about("JSON file of the result"))

    def _check(self) -> None:
        _check_realism(self.realism, self.robot, self.task, self.steps)


@dataclass(frozen=True, kw_only=True)
class ExportConfig(Section):
    """Which policy of which run leaves as one NumPy file."""

    run: str = field(metadata=about("run directory"))
    step: int | None = field(
        default=None,
        metadata=about("update of the checkpoint; null: the newest sound one", 0, MAX_COUNT),
    )
    seed: int | None = field(
        default=None, metadata=about("of the policy; null: all of the run", 0, MAX_COUNT)
    )
    out: str | None = field(default=None, metadata=about("file; null: <run>/policy.npz"))
    format: Literal["npz"] = field(default="npz", metadata=about("of the file"))


@dataclass(frozen=True, kw_only=True)
class ReportConfig(Section):
    """Which run is drawn, and where to."""

    run: str = field(metadata=about("run directory"))
    out: str | None = field(default=None, metadata=about("directory; null: <run>/report"))


def load_train(overrides: Sequence[str]) -> TrainConfig:
    """Make the configuration of `swarmjax.train` from its `key=value` words.

    Raises:
        ConfigError: see the module.
    """
    mapping, chosen = compose.compose(TrainConfig, "train", overrides)
    stages = _stages(mapping.get("stage", {}), chosen["stage"])
    made = build(TrainConfig, mapping | {"stage": stages, "stage_name": chosen["stage"]})
    if "start_std" in mapping and made.start is None:
        raise ConfigError(
            f"start_std is {made.start_std}, but there is no start: give start=DIR with it, "
            "the directory of a run."
        )
    return made


def _stages(stage: dict[str, Any], choice: str) -> list[dict[str, Any]]:
    """Return the stages that a choice of the group `stage` stands for, as plain data."""
    if not compose.is_grid(choice):
        return compose.stages(stage, choice)
    grid = build(GridConfig, compose.grid(stage, choice), "stage.grid.")
    return [to_dict(cell) for cell in grid.stages()]


def load_evaluate(overrides: Sequence[str]) -> EvaluateConfig:
    """Make the configuration of `swarmjax.evaluate` from its `key=value` words.

    Raises:
        ConfigError: see the module.
    """
    mapping, chosen = compose.compose(EvaluateConfig, "evaluate", overrides)
    stage = chosen["stage"]
    if compose.is_grid(stage):
        raise ConfigError(f"stage is {stage}, a grid: give one stage, as in stage=s6.")
    stages = compose.stages(mapping.get("stage", {}), stage)
    if compose.is_sequence(stage):
        raise ConfigError(
            f"stage is {stage}, a curriculum: give one stage, as in stage={stages[-1]['name']}."
        )
    return build(EvaluateConfig, mapping | {"stage": stages[0]})


def load_export(overrides: Sequence[str]) -> ExportConfig:
    """Make the configuration of `swarmjax.export` from its `key=value` words.

    Raises:
        ConfigError: see the module.
    """
    mapping, _ = compose.compose(ExportConfig, "export", overrides)
    return build(ExportConfig, mapping)


def load_report(overrides: Sequence[str]) -> ReportConfig:
    """Make the configuration of `swarmjax.report` from its `key=value` words.

    Raises:
        ConfigError: see the module.
    """
    mapping, _ = compose.compose(ReportConfig, "report", overrides)
    return build(ReportConfig, mapping)


def load_resume(stored: Mapping[str, Any], overrides: Sequence[str]) -> TrainConfig:
    """Make the configuration with which a stored run goes on.

    `run.stop_after` is not kept: it interrupted the stored run, and would stop this one at once.

    Args:
        stored: configuration of the run, as `to_dict` gave it.
        overrides: `key=value` words; only `budget`, `resume` and `run.*` may be given.

    Raises:
        ConfigError: another key is given, the stored configuration is unsound, or see the module.
    """
    words = compose.split_words(TrainConfig, overrides)
    for key, word in words.items():
        if key not in _RESUME_KEYS and not key.startswith("run."):
            allowed = ", ".join(_RESUME_KEYS)
            raise ConfigError(
                f"{word} cannot be given: resume keeps the rest of the stored run and takes "
                f"{allowed} only."
            )
    given = compose.values(words)
    kept = to_dict(build(TrainConfig, stored, "stored "))
    run = kept["run"] | {"stop_after": None} | given.get("run", {})
    return build(TrainConfig, kept | given | {"run": run})


def help_text(cls: type[Section], command: str) -> str:
    """Describe a command's settings: groups with their choices, then every key.

    Args:
        cls: the command's dataclass.
        command: its module, such as `swarmjax.train`.

    Returns:
        Lines for a terminal, without a newline at the end.
    """
    lines = [f"usage: python -m {command} key=value ..."]
    files: dict[type[Section], str] = {TrainConfig: "train", EvaluateConfig: "evaluate"}
    groups = compose.describe_groups(files[cls]) if cls in files else []
    if groups:
        lines += ["", "Groups, each a folder of configs/:", *groups]
    return "\n".join([*lines, "", "Keys, with their defaults:", *settings.describe_keys(cls)])
