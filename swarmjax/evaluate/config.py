"""The settings of an evaluation."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from swarmjax.config import ConfigError, Section, setting, show
from swarmjax.config.section import MAX_COUNT
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task.config import TaskConfig, check_realism
from swarmjax.task.stage_config import StageConfig

# Settings of a judge's robot, unless a robot file or an argument sets them. Hulls rub on hulls,
# boxes and walls as in Webots, where `coulombFriction` of ContactProperties is 1 by default.
JUDGED: Mapping[str, Any] = {"body": "wheeled", "hull_friction": 1.0}
MOST_STEPS = 1_000_000  # control steps of an episode; nine hours
STEPS = 1500  # control steps of an episode by default; Table 1 of the paper
MOST_EPISODES = 1_000_000  # the levels of this many episodes take a few gigabytes
# What `trained_settings.load` takes from the policies, as `--help` shows it.
AS_TRAINED = {
    "stage": "the policy's last stage",
    "robot": "as trained, on wheels and with hulls of friction 1",
    "task": "as trained",
    "realism": "as trained",
}


@dataclass(frozen=True, kw_only=True)
class JudgeConfig(Section):
    """The settings shared by commands that evaluate policies: levels, robots and the world."""

    inherited: ClassVar[Mapping[str, str]] = AS_TRAINED

    stage: StageConfig
    robot: RobotConfig = field(default_factory=lambda: RobotConfig(**JUDGED))
    task: TaskConfig = field(default_factory=TaskConfig)
    suite: str | None = setting(
        None, "suite instead of a stage: a name in configs/suites/, or a .yaml or .npz file"
    )
    realism: RealismConfig = field(default_factory=RealismConfig)
    action: Literal["sampled", "mean"] = setting(
        "sampled",
        "robots' actions; sampled: from the policy's distribution, repeatably for each level; "
        "mean: the most likely action",
    )
    steps: int | None = setting(
        None,
        f"control steps of an episode; null: as in the suite's cell, else {STEPS}",
        1,
        MOST_STEPS,
    )
    episodes: int = setting(1000, "number of episodes", 1, MOST_EPISODES)
    seed: int = setting(1, "random seed of the levels", 0, MAX_COUNT)
    workers: int | None = setting(None, "number of processes; null: one per core", 1, 1024)
    substeps: int | None = setting(
        None, "physics steps per control step; null: 1 for planar, 4 for wheeled", 1, 1000
    )
    extensions: str | None = setting(
        None, "Python file with the policies' extension; it is executed"
    )

    @property
    def step_limit(self) -> int:
        """Control steps of an episode, unless a suite's cell sets its own number."""
        return STEPS if self.steps is None else self.steps

    def _check(self) -> None:
        check_realism(self.realism, self.robot, self.task, self.step_limit)


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(JudgeConfig):
    """All settings of an evaluation."""

    command: ClassVar[str] = "evaluate"

    policy: str | None = setting(
        None, "policy.npz, or those of several seeds: a.npz,b.npz or a pattern"
    )
    compare: str | None = setting(
        None, "instead of policy: two policies or patterns to compare, as a.npz,b.npz"
    )
    engine: Literal["c", "mjx"] = setting("c", "c: MuJoCo's C engine; mjx: the engine of training")
    out: str | None = setting(None, "folder for result.json and levels.csv, or a single .json file")

    def _check(self) -> None:
        if (self.policy is None) == (self.compare is None):
            raise ConfigError(
                f"policy is {show(self.policy)} and compare is {show(self.compare)}: give exactly "
                "one of the two, policy=FILE or compare=FILE,FILE."
            )
        super()._check()
