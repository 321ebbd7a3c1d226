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
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from swarmjax import compose, epuck, settings
from swarmjax.settings import ConfigError, Section, about, build, show, to_dict

MAX_COUNT = 2**31 - 1  # counts and seeds are int32 on the device
# Seeds of a suite's levels begin here, so that none is drawn by hand, or by a benchmark, which
# take small ones. Training draws from another generator altogether, JAX's.
SUITE_SEED = 1_000_000

# The room that a random level asks for. A start and a target each take a square of 0.15 m (two
# hulls of 0.074 m side by side); an obstacle takes the square about its circumscribed circle,
# widened by a passage through which one robot fits with 13 mm to spare on either side; along the
# walls a border of half a passage stays free.
DISC = 0.15  # m, edge of the square about the disc of a start or a target
PASSAGE = 0.10  # m; between obstacles, and between an obstacle and a wall
FILLING = 0.4  # boxes per square of a grid that random placing surely reaches
# Arenas of all seeds whose episodes are written down one by one: more end thousands a second.
MOST_LOGGED = 8192

# What may change when a run goes on; everything else fixes what it has computed so far.
_RESUME_KEYS = ("budget", "resume", "run.*")
_REPRODUCE_RESUME_KEYS = ("resume", "minutes", "device", "arms", "episodes", "workers")
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
# The options of the algorithm that belong to one choice: whose, which, and what null stands for.
_ALGO_OPTIONS: dict[str, tuple[str, str, float | int]] = {
    "gae_lambda": ("returns", "gae", 0.95),
    "std_decrement": ("exploration", "scheduled", 0.05),
    "std_interval": ("exploration", "scheduled", 250_000),
    "std_floor": ("exploration", "scheduled", 0.1),
}
# What the step limit may be to a return, the default first.
_TIME_OUTS = {"gae": ("bootstrap", "terminal"), "monte_carlo": ("terminal", "leak")}
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
# What obstacles of a random level may look like where a policy is judged; training knows boxes.
Shape = Literal["box", "bar", "cross", "ell", "pillar"]


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
    """Weights of the named terms of the reward: equation 3 of the paper, and prices."""

    progress: float = field(default=1.0, metadata=about("per metre nearer to the target"))
    proximity: float = field(
        default=0.0, metadata=about("per control step with something in infrared range")
    )
    arrival: float = field(default=0.0, metadata=about("once, on arrival"))
    contact: float = field(default=-0.2, metadata=about("per contact event, of whatever kind"))
    robot_contact: float = field(
        default=0.0, metadata=about("besides, per contact event with another robot")
    )
    time: float = field(default=-0.002, metadata=about("per control step until arrival"))


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
    """PPO; what stands in Table 1 of the paper has its name from there in quotes.

    An option of one choice only, as its meaning says, is null with the others and may be null with
    its own, where it then takes its default.
    """

    name: Literal["ppo", "paper"] = field(
        default="ppo", metadata=about("preset that the numbers started from", derived=True)
    )
    policy: Literal["shared", "independent"] = field(
        default="shared", metadata=about("one policy for all robots, or one for each")
    )
    hidden: tuple[int, ...] = field(
        default=(64, 64), metadata=about("widths of the hidden layers", 1, 4096)
    )
    activation: Literal["tanh", "relu", "swish"] = field(
        default="tanh", metadata=about("activation of the hidden layers")
    )
    output: Literal["linear", "tanh"] = field(
        default="linear", metadata=about("of the mean action; tanh: within the range of commands")
    )
    initialization: Literal["orthogonal", "uniform"] = field(
        default="orthogonal",
        metadata=about("of the layers; uniform: within 1 / sqrt(inputs), biases too, as PyTorch's"),
    )
    normalize_observations: bool = field(
        default=True,
        metadata=about("by running mean and deviation; false: as they are, within +-10"),
    )
    rollout: int = field(default=32, metadata=about("control steps per update", 1, MAX_COUNT))
    epochs: int = field(
        default=4, metadata=about("passes over each rollout: 'PPO K epochs'", 1, MAX_COUNT)
    )
    minibatches: int = field(
        default=8, metadata=about("gradient steps per pass; divides arenas", 1, MAX_COUNT)
    )
    discount: float = field(
        default=0.99, metadata=about("per control step: 'discount factor (gamma)'", 0.0, 1.0)
    )
    returns: Literal["gae", "monte_carlo"] = field(
        default="gae",
        metadata=about(
            "gae: bootstrapped, advantages normalised; monte_carlo: summed to the end of episode "
            "or rollout and normalised, for the critic and for advantages"
        ),
    )
    gae_lambda: float | None = field(
        default=None, metadata=about("of the advantages; null: 0.95 [returns=gae]", 0.0, 1.0)
    )
    time_out: Literal["bootstrap", "terminal", "leak"] | None = field(
        default=None,
        metadata=about(
            "a return at the step limit; bootstrap: goes on with the value [gae], terminal: ends, "
            "leak: goes on into the next episode [monte_carlo]; null: the first that is possible"
        ),
    )
    clip: float = field(
        default=0.2, metadata=about("of the probability ratio: 'PPO epsilon clip'", above=0.0)
    )
    actor_learning_rate: float = field(
        default=3e-4,
        metadata=about("of the policy: 'optimizer learning rate actor'", above=0.0, high=1.0),
    )
    critic_learning_rate: float = field(
        default=1e-3,
        metadata=about("of the value: 'optimizer learning rate critic'", above=0.0, high=1.0),
    )
    learning_rate_schedule: Literal["constant", "linear"] = field(
        default="linear", metadata=about("linear falls to 0 at the end of the budget")
    )
    adam_epsilon: float = field(
        default=1e-5, metadata=about("added to the root of Adam's second moment", above=0.0)
    )
    max_grad_norm: float | None = field(
        default=0.5,
        metadata=about("norm at which gradients are clipped; null: they are not", above=0.0),
    )
    value_cost: float = field(
        default=0.5, metadata=about("weight of the value loss, half the mean squared error", 0.0)
    )
    entropy_cost: float = field(default=0.0, metadata=about("weight of the entropy", 0.0))
    bound_cost: float = field(
        default=1.0,
        metadata=about("weight of the squared distance of the mean action from -1..1", 0.0),
    )
    gradient: Literal["auto", "autodiff", "fused"] = field(
        default="auto",
        metadata=about(
            "how gradients are computed; fused: also, minibatches of tiles of valid samples; "
            "auto: fused on an NVIDIA GPU where the layers fit it"
        ),
    )
    contact_limit: float | None = field(
        default=None,
        metadata=about(
            "contacts with other robots, per robot and episode, that a price on them is to lead "
            "to, besides task.reward; null: no such price",
            above=0.0,
        ),
    )
    contact_price_rate: float = field(
        default=2e-5,
        metadata=about("by which that price rises or falls in a control step, at most, m", 0.0),
    )
    contact_price_arrivals: float = field(
        default=0.97,
        metadata=about("share of the robots below whose arrival that price falls", 0.0, 1.0),
    )
    exploration: Literal["learned", "scheduled"] = field(
        default="learned",
        metadata=about("deviation of the action: learned, or falling in steps whatever is learned"),
    )
    initial_std: float = field(
        default=0.6,
        metadata=about("at first: 'starting std of action distribution'", above=0.0),
    )
    std_decrement: float | None = field(
        default=None,
        metadata=about(
            "what a step takes off: 'the decay rate of std of action distribution'; null: 0.05 "
            "[exploration=scheduled]",
            above=0.0,
        ),
    )
    std_interval: int | None = field(
        default=None,
        metadata=about(
            "control steps of all arenas together between two: 'decay frequency of std of action "
            "distribution'; null: 250000 [exploration=scheduled]",
            1,
            MAX_COUNT,
        ),
    )
    std_floor: float | None = field(
        default=None,
        metadata=about(
            "where it stops: 'minimum std of action distribution'; null: 0.1 "
            "[exploration=scheduled]",
            above=0.0,
        ),
    )

    def _check(self) -> None:
        if not self.hidden:
            raise ConfigError("hidden is []: give at least one layer, as in [64,64].")
        for key, (selector, choice, default) in _ALGO_OPTIONS.items():
            value, chosen = getattr(self, key), getattr(self, selector)
            if chosen != choice and value is not None:
                raise ConfigError(
                    f"{key} is {show(value)}, but {selector} is {chosen}: {key} is an option of "
                    f"{choice}, so give null or {selector}={choice}."
                )
            if chosen == choice and value is None:
                object.__setattr__(self, key, default)
        self._check_time_out()
        if self.std_floor is not None and self.std_floor > self.initial_std:
            raise ConfigError(
                f"std_floor is {show(self.std_floor)}, but initial_std is "
                f"{show(self.initial_std)}: give at most {show(self.initial_std)}."
            )
        if self.output == "tanh" and self.activation != "tanh":
            raise ConfigError(
                f"output is tanh, but activation is {self.activation}, and a policy's file has one "
                "for all layers: give activation=tanh or output=linear."
            )

    def _check_time_out(self) -> None:
        allowed = _TIME_OUTS[self.returns]
        if self.time_out is None:
            object.__setattr__(self, "time_out", allowed[0])
        elif self.time_out not in allowed:
            raise ConfigError(
                f"time_out is {self.time_out}, but returns is {self.returns}: "
                f"give {' or '.join(allowed)}."
            )


@dataclass(frozen=True, kw_only=True)
class CurriculumConfig(Section):
    """Who trains on which stage, when that changes, and what a promotion does to the learners.

    An option of some modes only, as its meaning says, is null in the others and may be null in
    its own, where it then takes its default.
    """

    mode: Literal["sequential", "mixed", "adaptive"] = field(
        default="mixed",
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
        default="auto", metadata=about("who steps the physics; auto: warp on an NVIDIA GPU")
    )
    solver: Literal["auto", "newton", "swarm"] = field(
        default="auto",
        metadata=about(
            "of contacts; swarm: made for the body, of wheels by warp; auto: swarm there"
        ),
    )
    max_robots: int = field(default=5, metadata=about("robots compiled in", 1, 100))
    max_obstacles: int = field(default=4, metadata=about("obstacles compiled in", 0, 32))
    substeps: int | None = field(
        default=None,
        metadata=about("physics steps per control step; null: those of the body", 1, 1000),
    )
    iterations: int | None = field(
        default=None,
        metadata=about("of the solver, at most; on wheels by swarm 20; null: measured", 1, 1000),
    )
    ls_iterations: int | None = field(
        default=None,
        metadata=about("line-search iterations of newton; null: measured", 1, 1000),
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
    episodes: bool = field(
        default=False, metadata=about("write episodes.jsonl: each episode, robot by robot")
    )
    dry: bool = field(default=False, metadata=about("check and describe the run, train nothing"))
    compile_cache: Literal["auto"] | str | None = field(
        default="auto",
        metadata=about("directory that keeps compiled programs; auto: the user's; null: none"),
    )
    memory_share: float = field(
        default=0.8,
        metadata=about("of the GPU's memory, what arenas=auto fills", above=0.0, high=1.0),
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
    seeds_by: Literal["vmap", "map", "cores"] = field(
        default="vmap",
        metadata=about(
            "vmap: side by side; map: in turn, each as it would be alone, bit for bit; cores: "
            "vmap, in a group for each core of a CPU"
        ),
    )
    arenas: int = field(
        default=128,
        metadata=about("arenas simulated at once; auto: by run.memory_share", 1, 2**20),
    )
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
        self._check_algo()
        self._check_episodes()
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

    def _check_episodes(self) -> None:
        if self.run.episodes and self.arenas * self.seeds > MOST_LOGGED:
            raise ConfigError(
                f"run.episodes is true, but arenas is {self.arenas} and seeds is {self.seeds}: "
                f"give at most {MOST_LOGGED} arenas of all seeds together, or run.episodes=false."
            )

    def _check_algo(self) -> None:
        if self.algo.exploration == "scheduled" and self.budget > MAX_COUNT:
            raise ConfigError(
                f"budget is {self.budget}, but algo.exploration is scheduled by control steps that "
                f"are counted in 32 bits: give at most {MAX_COUNT}."
            )
        if self.curriculum.normalizer == "relearn" and not self.algo.normalize_observations:
            raise ConfigError(
                "curriculum.normalizer is relearn, but algo.normalize_observations is false: "
                "give keep or algo.normalize_observations=true."
            )

    def _check_budget(self) -> None:
        update = self.arenas * self.algo.rollout
        if self.updates < 1:
            raise ConfigError(
                f"budget is {self.budget}, but one update takes arenas x algo.rollout = {update} "
                f"control steps: give at least {update}."
            )
        most = MAX_COUNT // (self.algo.epochs * self.algo.minibatches)
        if self.updates > most:
            raise ConfigError(
                f"budget is {self.budget}, which is {self.updates} updates of {update} control "
                f"steps, and the gradient steps of no more than {most} are counted in 32 bits: "
                f"give at most {most * update}."
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
    """Everything that fixes an evaluation of policies."""

    policy: str | None = field(
        default=None,
        metadata=about("policy.npz, or several of one recipe: a.npz,b.npz or a pattern"),
    )
    compare: str | None = field(
        default=None,
        metadata=about("two instead, level by level: a.npz,b.npz; each may be a pattern"),
    )
    stage: StageConfig
    robot: RobotConfig = field(default_factory=lambda: RobotConfig(body="wheeled"))
    task: TaskConfig = field(default_factory=TaskConfig)
    suite: str | None = field(
        default=None,
        metadata=about("instead of a stage: a name of configs/suites/, or a file .yaml or .npz"),
    )
    shape: Shape = field(default="box", metadata=about("of the obstacles of a random level"))
    realism: RealismConfig = field(default_factory=RealismConfig)
    action: Literal["sampled", "mean"] = field(
        default="sampled",
        metadata=about(
            "of the robots; sampled: drawn from the policy, the same for the same level; mean: "
            "the most likely one"
        ),
    )
    engine: Literal["c", "mjx"] = field(
        default="c", metadata=about("c: MuJoCo's C engine; mjx: the one that trains")
    )
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
    out: str | None = field(
        default=None,
        metadata=about("folder for result.json, levels.csv and plots, or a file .json alone"),
    )

    def _check(self) -> None:
        if (self.policy is None) == (self.compare is None):
            raise ConfigError(
                f"policy is {show(self.policy)} and compare is {show(self.compare)}: give one of "
                "them, policy=FILE or compare=FILE,FILE."
            )
        if self.shape != "box" and self.stage.level == "fixed":
            raise ConfigError(
                f"shape is {self.shape}, but stage.level is fixed, with obstacles of its own: "
                "give shape=box."
            )
        _check_realism(self.realism, self.robot, self.task, self.steps)


@dataclass(frozen=True, kw_only=True)
class CellConfig(Section):
    """Levels of one kind that a suite judges policies on."""

    name: str = field(metadata=about("of the cell"))
    stage: StageConfig
    levels: int = field(default=1000, metadata=about("how many", 1, 1_000_000))
    seed: int = field(metadata=about("of the levels", SUITE_SEED, MAX_COUNT))
    episodes: tuple[int, ...] = field(
        default=(),
        metadata=about("numbers of the levels; none: from 0 on, as many as levels", 0, MAX_COUNT),
    )
    realism: Literal["ideal", "webots", "real"] | None = field(
        default=None, metadata=about("preset; null: that of the command")
    )
    shape: Shape = field(default="box", metadata=about("of the obstacles"))
    digest: str | None = field(
        default=None, metadata=about("SHA-256 of the levels; null: not drawn yet")
    )

    def _check(self) -> None:
        if not re.fullmatch(r"[\w-]+", self.name):
            raise ConfigError(f"name is {show(self.name)}: give letters, digits, _ and - only.")
        if self.episodes and len(self.episodes) != self.levels:
            raise ConfigError(
                f"levels is {self.levels}, but episodes are {len(self.episodes)}: give as many."
            )
        if len(set(self.episodes)) != len(self.episodes):
            raise ConfigError("episodes holds a number twice: give each once.")
        if self.digest is not None and not re.fullmatch(r"[0-9a-f]{64}", self.digest):
            raise ConfigError(f"digest is {show(self.digest)}: give 64 hexadecimal digits.")
        if self.shape != "box" and self.stage.level == "fixed":
            raise ConfigError(
                f"shape is {self.shape}, but the stage's level is fixed: give shape=box."
            )


@dataclass(frozen=True, kw_only=True)
class SuiteFileConfig(Section):
    """A suite: levels to judge policies on, never trained on."""

    name: str = field(metadata=about("of the suite, that of its file"))
    cells: tuple[CellConfig, ...]

    def _check(self) -> None:
        names = [cell.name for cell in self.cells]
        if not names:
            raise ConfigError("cells is []: give at least one cell.")
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f"cells names {name} more than once: give each name once.")


@dataclass(frozen=True, kw_only=True)
class SuiteConfig(Section):
    """Which suite is drawn, and what becomes of it."""

    suite: str = field(metadata=about("a name of configs/suites/, or a file .yaml"))
    out: str | None = field(default=None, metadata=about("file .npz for all of its levels"))
    write: bool = field(
        default=False,
        metadata=about("put digests, and episodes that were chosen, into the suite's file"),
    )
    policies: str | None = field(
        default=None,
        metadata=about("choose the levels that these fail most: a.npz,b.npz or a pattern"),
    )
    pool: int = field(default=20_000, metadata=about("levels drawn to choose from", 1, 1_000_000))
    steps: int = field(default=1500, metadata=about("control steps of an episode", 1, MAX_COUNT))
    workers: int | None = field(
        default=None, metadata=about("processes; null: one a core", 1, 1024)
    )


@dataclass(frozen=True, kw_only=True)
class ExportConfig(Section):
    """Which policy leaves in which form, and where to."""

    run: str | None = field(default=None, metadata=about("run directory; this or policy"))
    policy: str | None = field(default=None, metadata=about("path of a policy.npz; this or run"))
    format: Literal["npz", "onnx", "c", "webots"] = field(
        default="npz", metadata=about("of what is written: a file of npz or onnx, or a folder")
    )
    step: int | None = field(
        default=None,
        metadata=about("update of the run's checkpoint; null: the newest sound", 0, MAX_COUNT),
    )
    seed: int | None = field(
        default=None, metadata=about("of the run's policies; null: all of them", 0, MAX_COUNT)
    )
    out: str | None = field(
        default=None,
        metadata=about("file or folder; null: in run or beside policy, by format and step"),
    )
    sensors: Literal["webots", "real"] = field(
        default="webots",
        metadata=about("what answers the webots controller: simulated e-pucks, or real ones"),
    )

    def _check(self) -> None:
        if (self.run is None) == (self.policy is None):
            raise ConfigError(
                f"run is {show(self.run)} and policy is {show(self.policy)}: give one of them, "
                "as in run=runs/a or policy=policy.npz."
            )
        for key in ("step", "seed"):
            if self.run is None and getattr(self, key) is not None:
                raise ConfigError(
                    f"{key} is {getattr(self, key)}, but policy is one file: give {key} with run."
                )
        if self.sensors != "webots" and self.format != "webots":
            raise ConfigError(
                f"sensors is {self.sensors}, but format is {self.format}: give format=webots."
            )
        if self.out is None and self.run is None and self.format == "npz":
            raise ConfigError("out is null, but policy is given already: give out=FILE.")


@dataclass(frozen=True, kw_only=True)
class ReportConfig(Section):
    """Which run is drawn, and where to."""

    run: str = field(metadata=about("run directory"))
    out: str | None = field(default=None, metadata=about("directory; null: <run>/report"))


@dataclass(frozen=True, kw_only=True)
class ReplayConfig(Section):
    """Which episodes of which policies are shown, and where to."""

    policy: str = field(
        metadata=about("path of a policy.npz; of two for a comparison, as in a.npz,b.npz")
    )
    stage: StageConfig
    suite: str | None = field(
        default=None,
        metadata=about("instead of a stage: a name of configs/suites/, or a file .yaml or .npz"),
    )
    cell: str | None = field(
        default=None, metadata=about("of the suite; null: all of them, which only worst takes")
    )
    robot: RobotConfig = field(default_factory=lambda: RobotConfig(body="wheeled"))
    task: TaskConfig = field(default_factory=TaskConfig)
    realism: RealismConfig = field(default_factory=RealismConfig)
    shape: Shape = field(default="box", metadata=about("of the obstacles of a random level"))
    action: Literal["sampled", "mean"] = field(
        default="sampled",
        metadata=about(
            "of the robots; sampled: drawn from the policy, the same for the same level; mean: "
            "the most likely one"
        ),
    )
    level: str | None = field(
        default=None,
        metadata=about("numbers of the levels, as in 0,7,12; null: 0, unless worst is given"),
    )
    worst: int | None = field(
        default=None,
        metadata=about("replay this many of the episodes, those that went worst", 1, 100),
    )
    steps: int = field(default=1500, metadata=about("control steps of an episode", 1, MAX_COUNT))
    episodes: int = field(
        default=1000, metadata=about("how many levels there are to choose from", 1, MAX_COUNT)
    )
    seed: int = field(default=1, metadata=about("random seed of the levels", 0, MAX_COUNT))
    workers: int | None = field(
        default=None, metadata=about("processes that worst runs; null: one a core", 1, 1024)
    )
    substeps: int | None = field(
        default=None,
        metadata=about("physics steps per control step; null: those of the body", 1, 1000),
    )
    out: str = field(default="replay.html", metadata=about("HTML file of the replay"))
    video: str | None = field(default=None, metadata=about("MP4 file of the scene in 3-D"))
    video_speed: float = field(
        default=1.0,
        metadata=about("seconds of the episode in a second of the video", 0.05, 100.0),
    )

    def _check(self) -> None:
        _check_realism(self.realism, self.robot, self.task, self.steps)
        if not 1 <= len(self.policies) <= 2 or not all(self.policies):
            raise ConfigError(
                f"policy is {show(self.policy)}: give one file, or two with a comma between them."
            )
        if self.level is not None and self.worst is not None:
            raise ConfigError(
                f"level is {self.level}, but worst is {self.worst}: give one of the two."
            )
        if self.cell is not None and self.suite is None:
            raise ConfigError(f"cell is {show(self.cell)}, but suite is null: give suite=NAME.")
        if self.suite is None and self.worst is not None and self.worst > self.episodes:
            raise ConfigError(
                f"worst is {self.worst}, but episodes is {self.episodes}: "
                f"give 1 to {self.episodes}."
            )
        self._check_levels()

    def _check_levels(self) -> None:
        if self.level is not None and not re.fullmatch(r"\d{1,10}(,\d{1,10})*", self.level):
            raise ConfigError(
                f"level is {show(self.level)}: give whole numbers with commas between them, "
                "as in 0,7,12."
            )
        if len(set(self.levels)) < len(self.levels) or len(self.levels) > 100:
            raise ConfigError(f"level is {show(self.level)}: give each level once, 100 at most.")
        if self.suite is None and max(self.levels) >= self.episodes:
            raise ConfigError(
                f"level is {self.level}, but episodes is {self.episodes}: "
                f"give 0 to {self.episodes - 1}."
            )

    @property
    def policies(self) -> tuple[str, ...]:
        """The policies' paths."""
        return tuple(self.policy.split(","))

    @property
    def levels(self) -> tuple[int, ...]:
        """The numbers of the levels that are named."""
        return (0,) if self.level is None else tuple(int(each) for each in self.level.split(","))

    @property
    def evaluation(self) -> EvaluateConfig:
        """The evaluation that the episodes are part of."""
        return EvaluateConfig(
            policy=self.policy,
            stage=self.stage,
            suite=self.suite,
            robot=self.robot,
            task=self.task,
            realism=self.realism,
            shape=self.shape,
            action=self.action,
            steps=self.steps,
            # Of levels that are named no more are drawn than needed.
            episodes=max(self.levels) + 1 if self.worst is None else self.episodes,
            seed=self.seed,
            workers=self.workers,
            substeps=self.substeps,
        )


# The runs of a reproduction: docs/paper.md.
Arm = Literal[
    "curriculum",
    "baseline",
    "curriculum_expanded",
    "baseline_expanded",
    "modern_curriculum",
    "modern_baseline",
]
ARMS: tuple[Arm, ...] = typing.get_args(Arm)
LEAST_SEEDS = 3  # for an interval


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig(Section):
    """The published experiment, several times over.

    What is not said here is as in `algo=paper`.
    """

    seeds: int = field(default=10, metadata=about("of each arm; an interval takes 3", 1, 4096))
    seed: int = field(default=0, metadata=about("the first of them", 0, MAX_COUNT))
    seeds_by: Literal["vmap", "map", "cores"] = field(
        default="cores", metadata=about("as in training")
    )
    budget: int = field(
        default=1_000_000,
        metadata=about("control steps of a seed: 'max training timesteps'", 1, MAX_COUNT),
    )
    fine_tune: int = field(
        default=250_000, metadata=about("control steps of a seed in the 1.5 m arena", 1, MAX_COUNT)
    )
    arms: tuple[Arm, ...] = field(
        default=ARMS, metadata=about("which runs; *_expanded goes on with the one before it")
    )
    rollout: int = field(
        default=6000, metadata=about("control steps of an update of the paper's", 1, MAX_COUNT)
    )
    epochs: int = field(
        default=80, metadata=about("of an update of the paper's: 'PPO K epochs'", 1, MAX_COUNT)
    )
    step_limit: int = field(
        default=1500, metadata=about("'Max timesteps per episode'", 1, MAX_COUNT)
    )
    time_out: Literal["terminal", "leak"] = field(
        default="terminal", metadata=about("the paper's return at the step limit: algo.time_out")
    )
    threshold: float = field(
        default=0.8, metadata=about("share of the targets that promotes", 0.0, 1.0)
    )
    robot: Literal["paper", "planar"] = field(
        default="paper", metadata=about("range of the commands: printed, or of the hardware")
    )
    impl: Literal["auto", "jax", "warp"] = field(
        default="auto", metadata=about("who steps the physics, as sim.impl")
    )
    device: Literal["auto", "cpu", "gpu"] = field(
        default="auto", metadata=about("that trains; auto: a GPU if there is one")
    )
    minutes: float | None = field(
        default=None,
        metadata=about("after which it saves and stops, to go on with resume", above=0.0),
    )
    episodes: int = field(
        default=20, metadata=about("on which each policy is judged on each stage", 1, MAX_COUNT)
    )
    workers: int | None = field(
        default=None, metadata=about("processes that judge; null: one a core", 1, 1024)
    )
    out: str | None = field(
        default=None, metadata=about("directory; null: runs/<date>-<time>-reproduce")
    )
    resume: str | None = field(
        default=None, metadata=about("directory of a reproduction to go on with")
    )

    def _check(self) -> None:
        if self.seeds < LEAST_SEEDS:
            raise ConfigError(
                f"seeds is {self.seeds}, too few for an interval: give {LEAST_SEEDS} or more."
            )
        for key in ("budget", "fine_tune"):
            if getattr(self, key) < self.rollout:
                raise ConfigError(
                    f"{key} is {getattr(self, key)}, which ends before the first update: give at "
                    f"least {self.rollout}, the control steps of one."
                )
        if not self.arms:
            raise ConfigError(f"arms is []: give some of {', '.join(ARMS)}.")
        for arm in self.arms:
            if self.arms.count(arm) > 1:
                raise ConfigError(f"arms names {arm} more than once: give each once.")
            first = arm.removesuffix("_expanded")
            if first not in self.arms:
                raise ConfigError(f"arms names {arm}, but not {first}, which it goes on with.")


def load_train(overrides: Sequence[str], *, auto: bool = False) -> TrainConfig:
    """Make the configuration of `swarmjax.train` from its `key=value` words.

    Args:
        overrides: the words.
        auto: whether `arenas=auto` may be among them. It leaves the fewest arenas there can be,
            algo.minibatches; `memory.fill` chooses how many there will be.

    Raises:
        ConfigError: see the module.
    """
    mapping, chosen = compose.compose(TrainConfig, "train", overrides)
    if auto and mapping.get("arenas") == "auto":
        algo = build(AlgoConfig, mapping.get("algo", {}), "algo.")
        mapping["arenas"] = algo.minibatches
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
    _check_suite_alone(EvaluateConfig, mapping.get("suite"), overrides)
    stage = _one_stage(mapping.get("stage", {}), chosen["stage"])
    return build(EvaluateConfig, mapping | {"stage": stage})


def _one_stage(stage: dict[str, Any], choice: str) -> dict[str, Any]:
    """Return the stage that a choice of the group `stage` stands for, if it is one alone."""
    if compose.is_grid(choice):
        raise ConfigError(f"stage is {choice}, a grid: give one stage, as in stage=s6.")
    stages = compose.stages(stage, choice)
    if compose.is_sequence(choice):
        raise ConfigError(
            f"stage is {choice}, a curriculum: give one stage, as in stage={stages[-1]['name']}."
        )
    return stages[0]


def _check_suite_alone(cls: type[Section], suite: object, overrides: Sequence[str]) -> None:
    """Refuse what a suite's file says itself."""
    if suite is None:
        return
    for key in compose.split_words(cls, overrides):
        if key.partition(".")[0] in ("stage", "shape", "episodes", "seed"):
            raise ConfigError(
                f"{key} cannot be given with suite={suite}, which says what its levels are: "
                f"leave {key} or suite out."
            )


def load_suite(overrides: Sequence[str]) -> SuiteConfig:
    """Make the configuration of `swarmjax.suite` from its `key=value` words.

    Raises:
        ConfigError: see the module.
    """
    mapping, _ = compose.compose(SuiteConfig, "suite", overrides)
    return build(SuiteConfig, mapping)


def read_suite(choice: str) -> SuiteFileConfig:
    """Read the file of a suite.

    Args:
        choice: a name of configs/suites/, or the path of a .yaml file.

    Raises:
        ConfigError: there is no such file, or it is unsound.
    """
    path = compose.suite_path(choice)
    mapping = compose.read_yaml(path)
    cells = mapping.get("cells")
    if isinstance(cells, list):
        mapping = mapping | {"cells": [_cell(cell) for cell in cells]}
    try:
        return build(SuiteFileConfig, {"name": path.stem} | mapping)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _cell(cell: Any) -> Any:
    """Give a cell of a suite's file the numbers of the stage that it names."""
    stage = cell.get("stage") if isinstance(cell, Mapping) else None
    if isinstance(stage, str):
        return {**cell, "stage": compose.stages(compose.read_stage(stage), stage)[0]}
    if isinstance(stage, Mapping):
        return {**cell, "stage": {"name": cell.get("name"), **stage}}
    return cell


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


def load_replay(overrides: Sequence[str]) -> ReplayConfig:
    """Make the configuration of `swarmjax.replay` from its `key=value` words.

    Raises:
        ConfigError: see the module.
    """
    mapping, chosen = compose.compose(ReplayConfig, "replay", overrides)
    _check_suite_alone(ReplayConfig, mapping.get("suite"), overrides)
    stage = _one_stage(mapping.get("stage", {}), chosen["stage"])
    return build(ReplayConfig, mapping | {"stage": stage})


def load_reproduce(
    overrides: Sequence[str], stored: Mapping[str, Any] | None = None
) -> ReproduceConfig:
    """Make the configuration of `swarmjax.reproduce` from its `key=value` words.

    Args:
        overrides: the words.
        stored: configuration of the reproduction to go on with, as `to_dict` gave it, if any; only
            what does not change what has been computed may then be given.

    Raises:
        ConfigError: see the module.
    """
    if stored is None:
        mapping, _ = compose.compose(ReproduceConfig, "reproduce", overrides)
        return build(ReproduceConfig, mapping)
    words = compose.split_words(ReproduceConfig, overrides)
    for key, word in words.items():
        if key not in _REPRODUCE_RESUME_KEYS:
            raise ConfigError(
                f"{word} cannot be given: resume keeps the rest of the stored reproduction and "
                f"takes {', '.join(_REPRODUCE_RESUME_KEYS)} only."
            )
    kept = to_dict(build(ReproduceConfig, stored, "stored ")) | {"minutes": None}
    return build(ReproduceConfig, kept | compose.values(words))


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
    files: dict[type[Section], str] = {
        TrainConfig: "train",
        EvaluateConfig: "evaluate",
        ReplayConfig: "replay",
    }
    groups = compose.describe_groups(files[cls]) if cls in files else []
    if groups:
        lines += ["", "Groups, each a folder of configs/:", *groups]
    return "\n".join([*lines, "", "Keys, with their defaults:", *settings.describe_keys(cls)])
