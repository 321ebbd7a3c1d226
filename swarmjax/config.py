"""Every setting of swarmjax: frozen dataclasses, their defaults and their checks; no JAX.

A command line of `key=value` words becomes one of `TrainConfig`, `EvaluateConfig` and
`ExportConfig`. Hydra only composes the YAML files of configs/ with those words. Whatever comes
out goes through `build`, the one strict converter, and every mistake ends as one `ConfigError`
sentence that names the key as the user types it, the value, and what is allowed. The files hold
what tells robots, algorithms and stages apart; each default stands here.
"""

import dataclasses
import difflib
import math
import re
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from swarmjax import epuck

if TYPE_CHECKING:
    from omegaconf import DictConfig

MAX_COUNT = 2**31 - 1  # counts and seeds are int32 on the device

# The room that a random level asks for. A start and a target each take a square of 0.15 m (two
# hulls of 0.074 m side by side); an obstacle takes the square about its circumscribed circle,
# widened by a passage through which one robot fits with 13 mm to spare on either side; along the
# walls a border of half a passage stays free.
DISC = 0.15  # m, edge of the square about the disc of a start or a target
PASSAGE = 0.10  # m; between obstacles, and between an obstacle and a wall
FILLING = 0.4  # boxes per square of a grid that random placing surely reaches

# Filled in by the loader, so no key of the command line.
_DERIVED = frozenset({"stage_name"})
# What may change when a run goes on; everything else fixes what it has computed so far.
_RESUME_KEYS = ("budget", "resume", "run.*")
_PACKAGE = Path(__file__).resolve().parent


class ConfigError(ValueError):
    """A setting that is refused, in one sentence for the person who typed it."""


@dataclass(frozen=True)
class _Bounds:
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    below: float = math.inf

    def hold(self, value: float) -> bool:
        return self.low <= value <= self.high and self.above < value < self.below

    def __str__(self) -> str:
        if math.isfinite(self.low) and math.isfinite(self.high):
            return f"{_show(self.low)} to {_show(self.high)}"
        ends = {
            "{} or more": self.low,
            "more than {}": self.above,
            "at most {}": self.high,
            "less than {}": self.below,
        }
        given = [text.format(_show(end)) for text, end in ends.items() if math.isfinite(end)]
        return ", ".join(given) or "any finite number"


def _about(
    meaning: str,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    above: float = -math.inf,
    below: float = math.inf,
) -> dict[str, Any]:
    """Metadata of a field: what it is, with its unit, and the numbers it takes."""
    return {"meaning": meaning, "bounds": _Bounds(low, high, above, below)}


@dataclass(frozen=True, kw_only=True)
class _Section:
    """A group of settings, whose numbers are held to their bounds when it is made."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            bounds = item.metadata.get("bounds", _Bounds())
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, int | float) and not bounds.hold(number):
                    raise ConfigError(f"{item.name} is {_show(value)}: give {bounds}.")
        self._check()

    def _check(self) -> None:
        """Refuse what no single bound can say; keys are named from this section on."""


@dataclass(frozen=True, kw_only=True)
class StageConfig(_Section):
    """One stage: how many robots, how large an arena, which obstacles."""

    name: str = field(metadata=_about("name of the stage, that of its file"))
    robots: int = field(metadata=_about("active robots", 1, 100))
    side: float = field(metadata=_about("side of the square arena, m", 0.4, 4.0))
    obstacles: int = field(default=0, metadata=_about("obstacles", 0, 32))
    obstacle_size: float = field(
        default=0.10, metadata=_about("edge of the square boxes of a random level, m", 0.02, 0.3)
    )
    level: Literal["random", "fixed"] = field(
        default="random", metadata=_about("a new level every episode, or always the same one")
    )
    layout: Literal["boxes", "fence"] = field(
        default="boxes", metadata=_about("obstacles of a fixed level")
    )

    def _check(self) -> None:
        if not re.fullmatch(r"[\w-]+", self.name):
            raise ConfigError(f"name is {_show(self.name)}: give letters, digits, _ and - only.")
        if self.layout == "fence" and self.level != "fixed":
            raise ConfigError(f"layout is fence, but level is {self.level}: give level=fixed.")
        if self.layout == "fence" and self.obstacles < 1:
            raise ConfigError("obstacles is 0, but layout is fence: give 1 or more.")
        least = smallest_side(self)
        if self.side < least:
            raise ConfigError(
                f"side is {_show(self.side)}, too small for robots={self.robots}, "
                f"obstacles={self.obstacles}, obstacle_size={_show(self.obstacle_size)}: "
                f"give at least {math.ceil(100 * least) / 100}."
            )


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
    pitch = stage.obstacle_size * math.sqrt(2) + PASSAGE
    area = stage.robots * 2 * DISC**2 + stage.obstacles * pitch**2
    if stage.level == "random":
        area = max(area, stage.obstacles * pitch**2 / FILLING)
    return PASSAGE + math.sqrt(area)


@dataclass(frozen=True, kw_only=True)
class RobotConfig(_Section):
    """The robot; the numbers are those of the e-puck, with their sources in epuck.py."""

    body: Literal["planar"] = field(
        default="planar", metadata=_about("body that is trained: 3 degrees of freedom, servo")
    )
    hull_radius: float = field(
        default=epuck.HULL_RADIUS,
        metadata=_about("radius of the hull, m", above=0.0, high=0.45 * PASSAGE),
    )
    mass: float = field(default=epuck.MASS, metadata=_about("mass, kg", 0.001, 100.0))
    yaw_inertia: float = field(
        default=epuck.YAW_INERTIA,
        metadata=_about("moment of inertia about the vertical axis, kg m^2", 1e-8, 10.0),
    )
    wheel_radius: float = field(
        default=epuck.WHEEL_RADIUS, metadata=_about("radius of the wheels, m", above=0.0)
    )
    track: float = field(
        default=epuck.TRACK, metadata=_about("distance between the wheels, m", above=0.0)
    )
    max_wheel_speed: float = field(
        default=epuck.MAX_WHEEL_SPEED, metadata=_about("limit of each wheel, rad/s", above=0.0)
    )
    friction: float = field(
        default=epuck.FRICTION, metadata=_about("friction of wheel on floor", above=0.0)
    )
    max_speed: float = field(
        default=epuck.MAX_SPEED,
        metadata=_about("upper end of the speed command, m/s; the lower is 0", above=0.0),
    )
    max_turn_rate: float = field(
        default=epuck.MAX_TURN_RATE,
        metadata=_about("both ends of the turn command, rad/s", above=0.0),
    )

    def _check(self) -> None:
        if self.track >= 2 * self.hull_radius:
            raise ConfigError(
                f"track is {self.track}, but hull_radius is {self.hull_radius} and the wheels "
                f"lie inside the hull: give less than {2 * self.hull_radius:g}."
            )


@dataclass(frozen=True, kw_only=True)
class RewardConfig(_Section):
    """Weights of the named terms of the reward; the defaults are equation 3 of the paper."""

    progress: float = field(default=1.0, metadata=_about("per metre nearer to the target"))
    proximity: float = field(
        default=-0.001, metadata=_about("per control step with something in infrared range")
    )
    arrival: float = field(default=0.0, metadata=_about("once, on arrival"))
    contact: float = field(default=0.0, metadata=_about("per contact event"))
    time: float = field(default=0.0, metadata=_about("per control step"))


@dataclass(frozen=True, kw_only=True)
class TaskConfig(_Section):
    """What a robot is asked to do, and what it senses."""

    control_step: float = field(
        default=0.032, metadata=_about("control step, s; Webots basicTimeStep", 0.001, 0.2)
    )
    step_limit: int = field(
        default=500, metadata=_about("control steps of a training episode", 1, MAX_COUNT)
    )
    target_radius: float = field(
        default=0.05,
        metadata=_about("distance of the centres that counts as arrival, m", above=0.0, high=0.1),
    )
    sensor_range: float = field(
        default=epuck.SENSOR_RANGE, metadata=_about("infrared range, m", above=0.0, high=1.0)
    )
    reward: RewardConfig = field(default_factory=RewardConfig)


@dataclass(frozen=True, kw_only=True)
class AlgoConfig(_Section):
    """PPO; clip, learning rates, discount and initial deviation are Table 1 of the paper."""

    name: Literal["ppo"] = field(default="ppo", metadata=_about("algorithm"))
    policy: Literal["shared", "independent"] = field(
        default="shared", metadata=_about("one policy for all robots, or one for each")
    )
    hidden: tuple[int, ...] = field(
        default=(64, 64), metadata=_about("widths of the hidden layers", 1, 4096)
    )
    activation: Literal["tanh", "relu", "swish"] = field(
        default="tanh", metadata=_about("activation of the hidden layers")
    )
    rollout: int = field(default=32, metadata=_about("control steps per update", 1, MAX_COUNT))
    epochs: int = field(default=4, metadata=_about("passes over each rollout", 1, MAX_COUNT))
    minibatches: int = field(
        default=8, metadata=_about("gradient steps per pass; divides arenas", 1, MAX_COUNT)
    )
    discount: float = field(default=0.99, metadata=_about("per control step", 0.0, 1.0))
    gae_lambda: float = field(default=0.95, metadata=_about("of the advantages", 0.0, 1.0))
    clip: float = field(default=0.2, metadata=_about("of the probability ratio", above=0.0))
    actor_learning_rate: float = field(
        default=3e-4, metadata=_about("of the policy", above=0.0, high=1.0)
    )
    critic_learning_rate: float = field(
        default=1e-3, metadata=_about("of the value", above=0.0, high=1.0)
    )
    learning_rate_schedule: Literal["constant", "linear"] = field(
        default="linear", metadata=_about("linear falls to 0 at the end of the budget")
    )
    max_grad_norm: float = field(
        default=0.5, metadata=_about("norm at which gradients are clipped", above=0.0)
    )
    value_cost: float = field(default=0.5, metadata=_about("weight of the value loss", 0.0))
    entropy_cost: float = field(default=0.0, metadata=_about("weight of the entropy", 0.0))
    initial_std: float = field(
        default=0.6, metadata=_about("initial deviation of the action", above=0.0)
    )

    def _check(self) -> None:
        if not self.hidden:
            raise ConfigError("hidden is []: give at least one layer, as in [64,64].")


@dataclass(frozen=True, kw_only=True)
class CurriculumConfig(_Section):
    """When the next stage begins."""

    threshold: float = field(
        default=0.8, metadata=_about("share of targets reached that promotes", 0.0, 1.0)
    )
    budget_share: float = field(
        default=0.5,
        metadata=_about(
            "share of the budget for all stages before the last, in equal parts",
            above=0.0,
            below=1.0,
        ),
    )


@dataclass(frozen=True, kw_only=True)
class SimConfig(_Section):
    """The compiled simulation."""

    impl: Literal["auto", "jax", "warp"] = field(
        default="auto", metadata=_about("MJX implementation; auto: warp on an NVIDIA GPU")
    )
    max_robots: int = field(default=5, metadata=_about("robots compiled in", 1, 100))
    max_obstacles: int = field(default=4, metadata=_about("obstacles compiled in", 0, 32))
    substeps: int = field(default=1, metadata=_about("physics steps per control step", 1, 1000))
    iterations: int | None = field(
        default=None,
        metadata=_about("solver iterations; null: measured for the implementation", 1, 1000),
    )
    ls_iterations: int | None = field(
        default=None,
        metadata=_about("line-search iterations; null: measured likewise", 1, 1000),
    )


@dataclass(frozen=True, kw_only=True)
class RunConfig(_Section):
    """Where a run is written, and how often."""

    dir: str | None = field(
        default=None, metadata=_about("run directory; null: runs/<date>-<time>-<stage name>")
    )
    chunk: int | Literal["all", "auto"] = field(
        default="auto", metadata=_about("updates per call of the compiled program", 1, MAX_COUNT)
    )
    checkpoint_minutes: float = field(
        default=5.0, metadata=_about("minutes between checkpoints; 0: after every chunk", 0.0)
    )
    keep_checkpoints: int = field(
        default=2, metadata=_about("checkpoints that are kept", 1, MAX_COUNT)
    )
    stop_after: int | None = field(
        default=None,
        metadata=_about("updates after which the run saves and stops", 0, MAX_COUNT),
    )
    tensorboard: bool = field(default=True, metadata=_about("write TensorBoard events"))
    dry: bool = field(default=False, metadata=_about("check and describe the run, train nothing"))


@dataclass(frozen=True, kw_only=True)
class TrainConfig(_Section):
    """Everything that fixes a training run."""

    stage: tuple[StageConfig, ...]
    robot: RobotConfig = field(default_factory=RobotConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    algo: AlgoConfig = field(default_factory=AlgoConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    sim: SimConfig = field(default_factory=SimConfig)
    run: RunConfig = field(default_factory=RunConfig)
    seed: int = field(default=0, metadata=_about("random seed", 0, MAX_COUNT))
    seeds: int = field(default=1, metadata=_about("runs trained at once", 1, MAX_COUNT))
    arenas: int = field(default=128, metadata=_about("arenas simulated at once", 1, 2**20))
    budget: int = field(
        default=3_000_000, metadata=_about("control steps of all arenas together", 1, 10**15)
    )
    realism: Literal["ideal"] = field(default="ideal", metadata=_about("sensor and motor model"))
    resume: str | None = field(default=None, metadata=_about("run directory to go on with"))
    stage_name: str = field(
        default="", metadata=_about("the one stage, or what the curriculum is called")
    )

    def _check(self) -> None:
        if self.seeds > 1:
            raise ConfigError(
                f"seeds is {self.seeds}, but several seeds in one run are not built yet: give 1."
            )
        self._check_stages()
        if self.arenas % self.algo.minibatches:
            raise ConfigError(
                f"arenas is {self.arenas}, but algo.minibatches is {self.algo.minibatches}: "
                f"give a multiple of {self.algo.minibatches}."
            )
        self._check_budget()
        self._check_counts()
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
class EvaluateConfig(_Section):
    """Everything that fixes an evaluation of a policy."""

    policy: str = field(metadata=_about("path of a policy.npz"))
    stage: StageConfig
    robot: RobotConfig = field(default_factory=RobotConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    suite: None = field(default=None, metadata=_about("a list of stages; not built yet"))
    realism: Literal["ideal"] = field(default="ideal", metadata=_about("sensor and motor model"))
    engine: Literal["c"] = field(default="c", metadata=_about("MuJoCo's C engine"))
    steps: int = field(
        default=1500, metadata=_about("control steps of an episode; Table 1", 1, MAX_COUNT)
    )
    episodes: int = field(default=1000, metadata=_about("episodes", 1, MAX_COUNT))
    seed: int = field(default=1, metadata=_about("random seed of the levels", 0, MAX_COUNT))
    workers: int | None = field(
        default=None, metadata=_about("processes; null: one a core", 1, 1024)
    )
    substeps: int = field(default=1, metadata=_about("physics steps per control step", 1, 1000))
    out: str | None = field(default=None, metadata=_about("JSON file of the result"))


@dataclass(frozen=True, kw_only=True)
class ExportConfig(_Section):
    """Which policy of which run leaves as one NumPy file."""

    run: str = field(metadata=_about("run directory"))
    step: int | None = field(
        default=None,
        metadata=_about("update of the checkpoint; null: the newest sound one", 0, MAX_COUNT),
    )
    out: str | None = field(default=None, metadata=_about("file; null: <run>/policy.npz"))
    format: Literal["npz"] = field(default="npz", metadata=_about("of the file"))


def build[C: _Section](cls: type[C], mapping: Mapping[str, Any], where: str = "") -> C:
    """Make a configuration from plain data, strictly.

    Whole floats and numeric strings become integers, integers become floats, and lists become
    tuples; nothing else is converted, and no key is dropped.

    Args:
        cls: the dataclass to make.
        mapping: its keys and values, as `to_dict`, JSON or YAML give them.
        where: what comes before its keys in a sentence, such as `sim.`.

    Returns:
        An instance of `cls`.

    Raises:
        ConfigError: an unknown or missing key, a wrong type, or a value out of bounds.
    """
    if not isinstance(mapping, Mapping):
        key = where.rstrip(": .")
        example = dataclasses.fields(cls)[0].name
        raise ConfigError(f"{key} is {_show(mapping)}: give keys of its own, as {where}{example}.")
    known = {item.name: item for item in dataclasses.fields(cls)}
    for key in mapping:
        if key not in known:
            raise _unknown_key(str(key), cls, where)
    for item in known.values():
        if item.name not in mapping and _is_required(item):
            raise ConfigError(f"{where}{item.name} is missing and has no default: give it.")
    values = {
        key: _convert(known[key].type, value, f"{where}{key}") for key, value in mapping.items()
    }
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}{error}") from None


def to_dict(config: _Section) -> dict[str, Any]:
    """Return a configuration as plain data for JSON, from which `build` makes it again."""
    return {key: _plain(value) for key, value in dataclasses.asdict(config).items()}


def load_train(overrides: Sequence[str]) -> TrainConfig:
    """Make the configuration of `swarmjax.train` from its `key=value` words.

    Raises:
        ConfigError: see the module.
    """
    mapping, stage = _compose(TrainConfig, "train", overrides)
    mapping["stage"] = _expand(mapping.get("stage", {}), stage)
    return build(TrainConfig, mapping | {"stage_name": stage})


def load_evaluate(overrides: Sequence[str]) -> EvaluateConfig:
    """Make the configuration of `swarmjax.evaluate` from its `key=value` words.

    Raises:
        ConfigError: see the module.
    """
    mapping, stage = _compose(EvaluateConfig, "evaluate", overrides)
    stages = _expand(mapping.get("stage", {}), stage)
    if "sequence" in _read_yaml(f"stage/{stage}"):
        raise ConfigError(
            f"stage is {stage}, a curriculum: give one stage, as in stage={stages[-1]['name']}."
        )
    return build(EvaluateConfig, mapping | {"stage": stages[0]})


def load_export(overrides: Sequence[str]) -> ExportConfig:
    """Make the configuration of `swarmjax.export` from its `key=value` words.

    Raises:
        ConfigError: see the module.
    """
    mapping, _ = _compose(ExportConfig, "export", overrides)
    return build(ExportConfig, mapping)


def load_resume(stored: Mapping[str, Any], overrides: Sequence[str]) -> TrainConfig:
    """Make the configuration with which a stored run goes on.

    `run.stop_after` is not kept: it interrupted the stored run, and would stop this one at once.

    Args:
        stored: configuration of the run, as `to_dict` gave it.
        overrides: `key=value` words; only `budget`, `resume` and `run.*` may be given.

    Raises:
        ConfigError: another key is given, the stored configuration is unsound, or see the module.
    """
    words = _words(TrainConfig, overrides)
    for key, word in words.items():
        if key not in _RESUME_KEYS and not key.startswith("run."):
            allowed = ", ".join(_RESUME_KEYS)
            raise ConfigError(
                f"{word} cannot be given: resume keeps the rest of the stored run and takes "
                f"{allowed} only."
            )
    given = _values(words)
    kept = to_dict(build(TrainConfig, stored, "stored "))
    run = kept["run"] | {"stop_after": None} | given.get("run", {})
    return build(TrainConfig, kept | given | {"run": run})


def help_text(cls: type[_Section], command: str) -> str:
    """Describe a command's settings: groups with their choices, then every key.

    Args:
        cls: the command's dataclass.
        command: its name, `train` for `swarmjax.train`.

    Returns:
        Lines for a terminal, without a newline at the end.
    """
    lines = [f"usage: python -m swarmjax.{command} key=value ..."]
    chosen = _defaults(command)
    if chosen:
        lines += ["", "Groups, each a folder of configs/:"]
        lines += [f"  {f'{key}={chosen[key]}':<38}  ({', '.join(_choices(key))})" for key in chosen]
    lines += ["", "Keys, with their defaults:"]
    for key, item in _keys(cls).items():
        default = f"<{'the stage' if key.startswith('stage.') else 'required'}>"
        if not _is_required(item):
            default = _show(item.default, quote="")
        bounds = item.metadata["bounds"]
        allowed = _describe(item.type, "" if bounds == _Bounds() else f" {bounds}")
        lines.append(f"  {f'{key}={default}':<38}  {item.metadata['meaning']} ({allowed})")
    return "\n".join(lines)


def _is_required(item: dataclasses.Field[Any]) -> bool:
    return item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING


def _section(hint: object) -> type[_Section] | None:
    """Return the section that a field holds, alone or in a tuple, if it holds one."""
    inner = typing.get_args(hint)[0] if typing.get_origin(hint) is tuple else hint
    return inner if isinstance(inner, type) and issubclass(inner, _Section) else None


def _keys(cls: type[_Section], where: str = "") -> dict[str, dataclasses.Field[Any]]:
    """Return the dotted keys of the command line and the fields they set."""
    keys = {}
    for item in dataclasses.fields(cls):
        inner = _section(item.type)
        if inner is not None:
            keys |= _keys(inner, f"{where}{item.name}.")
        elif item.name not in _DERIVED:
            keys[f"{where}{item.name}"] = item
    return keys


def _unknown_key(key: str, cls: type[_Section], where: str = "") -> ConfigError:
    """Say that a key does not exist, and which one was probably meant."""
    names = [item.name for item in dataclasses.fields(cls) if item.name not in _DERIVED]
    dotted = {full.rpartition(".")[2]: full for full in reversed(_keys(cls))}
    near = [dotted[key]] if key in dotted else difflib.get_close_matches(key, names, n=1)
    near = near or [dotted[leaf] for leaf in difflib.get_close_matches(key, dotted, n=1)]
    hint = f"did you mean {where}{near[0]}?" if near else f"give one of {', '.join(names)}."
    return ConfigError(f"{where}{key} is not a key: {hint}")


def _convert(hint: object, value: object, key: str) -> object:
    """Turn plain data into what a field's type says."""
    section = _section(hint)
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{key} is {_show(value)}: give {_describe(hint)}.")
        inner = typing.get_args(hint)[0]
        return tuple(
            _convert(inner, item, _item_key(key, value, index) if section else key)
            for index, item in enumerate(value)
        )
    if section is not None:
        mapping = typing.cast(Mapping[str, Any], value)
        return build(section, mapping, key if key.endswith(": ") else f"{key}.")
    if hint is None and value is not None:
        raise ConfigError(f"{key} is {_show(value)}, but is not built yet: leave it out.")
    for option in _options(hint):
        try:
            return _scalar(option, value)
        except (TypeError, ValueError, OverflowError):
            continue
    raise ConfigError(f"{key} is {_show(value)}: give {_describe(hint)}.")


def _item_key(key: str, items: Sequence[Any], index: int) -> str:
    """Name one of several sections, by its name where it has one."""
    if len(items) == 1:
        return key
    item = items[index]
    name = item.get("name", index) if isinstance(item, Mapping) else index
    return f"{key} {name}: "


def _options(hint: object) -> tuple[Any, ...]:
    """Return the members of a union, or the type itself."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return typing.get_args(hint)
    return (types.NoneType,) if hint is None else (hint,)


def _scalar(hint: object, value: object) -> object:
    """Convert to one scalar type, or raise an error that `_convert` puts in words."""
    if typing.get_origin(hint) is Literal:
        if isinstance(value, str) and value in typing.get_args(hint):
            return value
    elif hint is int or hint is float:
        return _number(hint, value)
    elif isinstance(hint, type) and isinstance(value, hint) and value != "":
        return value
    raise TypeError


def _number(kind: type[int] | type[float], value: object) -> int | float:
    """Convert a number, or a string that is one; true and false are no numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise TypeError
    try:
        number: int | float = int(value) if isinstance(value, str) else value
    except ValueError:
        number = float(value)
    if isinstance(number, float) and not math.isfinite(number):
        raise ValueError
    if kind is int and number != int(number):
        raise ValueError
    return kind(number)


def _describe(hint: object, bounds: str = "") -> str:
    """Put a field's type in words, and the bounds of its numbers if they are given."""
    if typing.get_origin(hint) is tuple:
        examples = {int: "[64,64]", str: "[s1,s2]"}
        inner = typing.get_args(hint)[0]
        return f"a list, as in {examples[inner]}{bounds}" if inner in examples else "a list"
    words = []
    for option in _options(hint):
        if typing.get_origin(option) is Literal:
            words += typing.get_args(option)
        else:
            names = {int: f"a whole number{bounds}", float: f"a number{bounds}", str: "text"}
            words.append((names | {bool: "true or false", types.NoneType: "null"})[option])
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last


def _show(value: object, quote: str = "'") -> str:
    """Write a value as it would be typed, and short."""
    if isinstance(value, str):
        text = value.encode("unicode_escape").decode("ascii") if not value.isprintable() else value
        text = f"{quote}{text}{quote}"
    elif value is None or isinstance(value, bool):
        text = {None: "null", True: "true", False: "false"}[value]
    elif isinstance(value, list | tuple):
        text = f"[{','.join(_show(item, quote) for item in value)}]"
    else:
        text = f"{value:.10g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _plain(value: object) -> object:
    """Turn the tuples of nested plain data into lists."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


def _config_dir() -> Path:
    """Find configs/: at the root of the source tree, otherwise inside the installed package."""
    root = _PACKAGE.parent
    source, installed = root / "configs", _PACKAGE / "configs"
    # The folder above an installed package holds other packages too, so a folder configs/ there
    # is ours only beside the project file.
    if (root / "pyproject.toml").is_file() and source.is_dir():
        return source
    if installed.is_dir():
        return installed
    raise ConfigError(f"configs is missing: neither {source} nor {installed} is a folder.")


def _choices(group: str) -> list[str]:
    """Return the names of a group's files, or none if it is no group."""
    return sorted(path.stem for path in (_config_dir() / group).glob("*.yaml"))


def _read_yaml(name: str) -> dict[str, Any]:
    """Read one file of configs/ as it stands."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    path = _config_dir() / f"{name}.yaml"
    try:
        mapping = OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, YAMLError, OmegaConfBaseException) as error:
        raise ConfigError(f"{path} cannot be read: {_first_line(error)}.") from None
    if not isinstance(mapping, dict):
        raise ConfigError(f"{path} is no list of keys and values: write key: value.")
    return {str(key): value for key, value in mapping.items()}


def _defaults(command: str) -> dict[str, str]:
    """Return the groups of a command and the choices that its file makes."""
    entries = _read_yaml(command).get("defaults", [])
    return {
        str(group): str(choice)
        for entry in entries
        if isinstance(entry, dict)
        for group, choice in entry.items()
    }


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")


def _check_choice(group: str, choice: str, key: str) -> None:
    choices = _choices(group)
    if choice not in choices:
        # Names as short as s7 and s6 share half their letters, below difflib's own cutoff of 0.6.
        near = difflib.get_close_matches(choice, choices, n=1, cutoff=0.5)
        hint = f" (nearest: {near[0]})" if near else ""
        raise ConfigError(f"{key} is {_show(choice)}: give one of {', '.join(choices)}{hint}.")


def _words(cls: type[_Section], overrides: Sequence[str]) -> dict[str, str]:
    """Return the words of a command line by key; of a key given twice, the last."""
    sections = {item.name for item in dataclasses.fields(cls)} - _DERIVED
    words = {}
    for word in overrides:
        key, equals, _ = word.partition("=")
        if not equals or not re.fullmatch(r"\w[\w-]*(\.[\w-]+)*", key):
            raise ConfigError(f"{_show(word)} is not a setting: give key=value.")
        root = key.partition(".")[0]
        if root not in sections:
            raise _unknown_key(root, cls)
        words[key] = word
    quoted = {key for key, item in _keys(cls).items() if str in _options(item.type)}
    return {key: _quote(word) if key in quoted else word for key, word in words.items()}


def _quote(word: str) -> str:
    """Quote a text for Hydra's grammar, so that a path may hold `=`, a comma or a space."""
    from hydra.core.override_parser.types import Quote, QuotedString

    key, _, value = word.partition("=")
    if value in ("", "null") or value[0] in "'\"":
        return word
    return f"{key}={QuotedString(text=value, quote=Quote.single).with_quotes()}"


def _parse(word: str) -> object:
    """Parse one word with Hydra's grammar and return its value."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    key = word.partition("=")[0]
    try:
        parsed = OverridesParser.create().parse_override(f"++{word}")
    except HydraException:
        raise ConfigError(
            f"{_show(word)} cannot be read: quote a value with special characters, "
            f"as in \"{key}='a=b'\"."
        ) from None
    if parsed.is_sweep_override():
        raise ConfigError(
            f"{_show(word)} gives several values, and a run takes one: write a list as {key}=[1,2]."
        )
    return parsed.value()


def _values(words: Mapping[str, str]) -> dict[str, Any]:
    """Return the values of words as nested plain data."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    values = OmegaConf.create({})
    for key, word in words.items():
        try:
            OmegaConf.update(values, key, _parse(word))
        except OmegaConfBaseException as error:
            raise ConfigError(f"{_show(word)} cannot be used: {_first_line(error)}.") from None
    return _resolve(values)


def _resolve(config: "DictConfig") -> dict[str, Any]:
    """Return what Hydra composed as plain data, its interpolations filled in."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        mapping = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"the settings cannot be resolved: {_first_line(error)}.") from None
    return typing.cast(dict[str, Any], mapping)


def _compose(
    cls: type[_Section], command: str, overrides: Sequence[str]
) -> tuple[dict[str, Any], str]:
    """Let Hydra put the files and the words together.

    Returns:
        The keys and values that were given anywhere, and the choice of the group `stage`, empty
        for a command without stages.
    """
    words = _words(cls, overrides)
    groups = {key: word.partition("=")[2] for key, word in words.items() if _choices(key)}
    for key, choice in groups.items():
        _check_choice(key, choice, key)
    for key in words.keys() - groups.keys():
        _parse(words[key])
    chosen = _defaults(command) | groups
    for group, choice in chosen.items():
        _read_yaml(f"{group}/{choice}")  # names a broken file, where Hydra would not
    forced = [word if key in groups else f"++{word}" for key, word in words.items()]
    return _resolve(_hydra(command, forced)), chosen.get("stage", "")


def _hydra(command: str, overrides: list[str]) -> "DictConfig":
    """Compose in a Hydra of our own, and leave one that the caller may have as it was."""
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(config_dir=str(_config_dir()), version_base="1.3"):
            return compose(command, overrides=overrides)
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(f"the settings do not fit together: {_first_line(error)}.") from None
    finally:
        GlobalHydra.instance().hydra = outer


def _expand(stage: dict[str, Any], choice: str) -> list[dict[str, Any]]:
    """Return the stages that a file of configs/stage/ stands for: itself, or its sequence."""
    if "sequence" not in _read_yaml(f"stage/{choice}"):
        return [_named(stage, choice)]
    names = _convert(tuple[str, ...], stage["sequence"], "stage.sequence")
    names = typing.cast(tuple[str, ...], names)
    if not names:
        raise ConfigError("stage.sequence is []: give at least one stage.")
    for key in stage.keys() - {"sequence"}:
        raise ConfigError(
            f"stage.{key} cannot be given for {choice}, a curriculum: choose one stage, "
            f"as in stage={names[-1]}."
        )
    return [_member(name) for name in names]


def _member(name: str) -> dict[str, Any]:
    """Read one stage of a curriculum."""
    _check_choice("stage", name, "stage.sequence")
    stage = _read_yaml(f"stage/{name}")
    if "sequence" in stage:
        raise ConfigError(f"stage.sequence names {name}, a curriculum itself: give single stages.")
    return _named(stage, name)


def _named(stage: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the stage if it bears the name of its file."""
    found = stage.get("name", name)
    if found != name:
        raise ConfigError(f"stage.name is {_show(found)} in {name}.yaml: give the file's name.")
    return stage
