"""The settings of a training run, and checks that involve several sections."""

import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from swarmjax.config import ConfigError, Section, setting, show
from swarmjax.config.section import MAX_COUNT
from swarmjax.task.config import check_realism
from swarmjax.task.stage_config import make_room
from swarmjax.training.config import ProgramConfig


@dataclass(frozen=True, kw_only=True)
class RunConfig(Section):
    """Where a run is written, and how often."""

    id: str | None = setting(None, "random id, drawn when the run begins", derived=True)
    dir: str | None = setting(None, "run directory; null: runs/<date>-<time>-<stage>-seed<seed>")
    chunk: int | Literal["auto"] = setting(
        "auto", "updates per call of the compiled program; auto: as many as take 1 s", 1, MAX_COUNT
    )
    checkpoint_minutes: float = setting(
        1.0, "minutes between checkpoints; 0: after every chunk", 0.0
    )
    stop_after: int | None = setting(
        None, "updates after which the run saves and stops", 0, MAX_COUNT
    )
    stop_at: float | None = setting(
        None,
        "end the run once every seed has this success on the last stage (curriculum.success)",
        above=0.0,
        high=1.0,
    )
    verbose: bool = setting(False, "print the physics engine too")
    tensorboard: bool = setting(True, "write TensorBoard events")
    wandb: str | None = setting(None, "Weights & Biases project to log to; needs the extra wandb")
    episodes: bool = setting(False, "write each episode, robot by robot, to episodes.jsonl")
    distributed: bool = setting(
        False,
        "train with other processes, which Slurm, Open MPI or Kubernetes lists; elsewhere set "
        "JAX_COORDINATOR_ADDRESS (HOST:PORT), JAX_NUM_PROCESSES and JAX_PROCESS_ID",
    )
    deterministic: bool = setting(False, "make results on a GPU bit-for-bit repeatable; slower")


@dataclass(frozen=True, kw_only=True)
class TrainConfig(ProgramConfig):
    """All settings of a training run: what the program does, and where the run is written."""

    command: ClassVar[str] = "train"
    # What is trained. Whoever starts the run decides which code runs, where the run is written and
    # what it starts from.
    shared: ClassVar[tuple[str, ...]] = (
        *("stage", "robot", "task", "realism", "algo", "curriculum", "sim"),
        *("arenas", "budget", "levels_per_rollout", "seed", "seeds", "streams"),
    )

    # `recipes.expand` replaces this word by the recipe's words, so no config holds it.
    recipe: str | None = setting(
        None, "settings of a whole run, which other arguments override", stored=False
    )
    run: RunConfig = field(default_factory=RunConfig)
    resume: str | None = setting(
        None, "run directory to continue; auto: run.dir, if it holds a run"
    )
    init_from: str | None = setting(
        None, "run directory that gives the first networks and normaliser"
    )
    stage_name: str = setting("", "name of the stage or of the curriculum", derived=True)

    def _check(self) -> None:
        object.__setattr__(self, "sim", make_room(self.sim, self.stage))
        if self.seed + self.seeds - 1 > MAX_COUNT:
            raise ConfigError(
                f"seed is {self.seed}, but seeds is {self.seeds} and the last seed may be at most "
                f"{MAX_COUNT}: give a seed of at most {MAX_COUNT - self.seeds + 1}."
            )
        self._check_stages()
        self._check_threshold()
        self._check_devices()
        self._check_budget()
        self._check_counts()
        check_realism(self.realism, self.robot, self.task, self.task.step_limit)
        if self.arena_devices > 1:
            object.__setattr__(self, "streams", self.stream_count)
        names = self.stage_names
        if len(names) == 1 or not self.stage_name:
            object.__setattr__(self, "stage_name", "-".join(names))

    def _check_stages(self) -> None:
        if not self.stage:
            raise ConfigError("stage is []: give at least one stage.")
        names, along = self.stage_names, self.curriculum.axes
        if along and (count := math.prod(len(each) + 1 for each in along.values())) != len(names):
            raise ConfigError(
                f"curriculum.axes makes {count} stages, but stage lists {len(names)}: leave out "
                "curriculum.axes or stage."
            )
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f"stage lists {name} more than once: give each stage once.")
        for stage in self.stage:
            where = "stage." if len(names) == 1 else f"stage {stage.name}: "
            for key, least in (("robots", 1), ("obstacles", 0)):
                value, most = getattr(stage, key), getattr(self.sim, f"max_{key}")
                if value > most:
                    raise ConfigError(
                        f"{where}{key} is {value}, but sim.max_{key} is {most}: "
                        f"give {least} to {most}."
                    )

    def _check_threshold(self) -> None:
        given, stages = self.curriculum.threshold, len(self.stage)
        if isinstance(given, tuple) and self.curriculum.axes:
            raise ConfigError(
                f"curriculum.threshold is {show(given)}, but curriculum.axes makes {stages} "
                "stages: give one number."
            )
        if isinstance(given, tuple) and len(given) != stages:
            raise ConfigError(
                f"curriculum.threshold is {show(given)}, but the number of stages is {stages}: "
                "give one number, or one for each stage."
            )

    def _check_devices(self) -> None:
        share = self.arena_devices
        if self.streams is not None and self.streams % share:
            raise ConfigError(
                f"streams is {self.streams}, but devices is {share}: give a multiple of {share}, "
                "or null."
            )
        streams, minibatches = self.stream_count, self.algo.num_minibatches
        if self.arenas % (streams * minibatches):
            which = "streams" if self.streams else "devices"
            spread = "" if streams == 1 else f"{which} is {streams} and "
            raise ConfigError(
                f"arenas is {self.arenas}, but {spread}algo.num_minibatches is {minibatches}: "
                f"give a multiple of {streams * minibatches}."
            )
        if self.devices > 1 and self.seeds_by == "cores":
            raise ConfigError(
                f"seeds_by is cores, but devices is {self.devices}: give seeds_by=vmap, "
                "seeds_by=devices or devices=1."
            )
        if self.seeds_by == "devices" and self.seeds % self.devices:
            raise ConfigError(
                f"seeds is {self.seeds}, but seeds_by is devices and devices is {self.devices}: "
                f"give a multiple of {self.devices}."
            )

    def _check_counts(self) -> None:
        steps = max(self.task.step_limit, self.algo.rollout_length)
        most = MAX_COUNT // (self.sim.robots * steps)
        if self.arenas > most:
            raise ConfigError(
                f"arenas is {self.arenas}, but robot steps are counted in 32 bits, which is enough "
                f"for {most} arenas with {self.sim.robots} robots and {steps} control steps: give "
                f"at most {most} arenas."
            )

    def _check_budget(self) -> None:
        update = self.arenas * self.algo.rollout_length
        if self.updates < 1:
            raise ConfigError(
                f"budget is {self.budget}, but one update takes arenas x algo.rollout_length = "
                f"{update} control steps: give at least {update}."
            )
        most = MAX_COUNT // (self.algo.epochs * self.algo.num_minibatches) * update
        if self.budget >= most + update:
            raise ConfigError(
                f"budget is {self.budget}, but gradient steps are counted in 32 bits: give a "
                f"budget of at most {most}, more arenas, or a longer algo.rollout_length."
            )


@dataclass(frozen=True, kw_only=True)
class ProbeConfig(TrainConfig):
    """All settings of a probe: those of a training run, and how many episodes are counted."""

    episodes: int = setting(
        256, "episodes of each stage, rounded up to a multiple of arenas", 1, MAX_COUNT
    )

    def _check(self) -> None:
        super()._check()
        for key in ("resume", "init_from"):
            if getattr(self, key) is not None:
                raise ConfigError(
                    f"{key} is {show(getattr(self, key))}, but a probe drives an untrained swarm: "
                    f"leave {key} out."
                )
