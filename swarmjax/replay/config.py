"""The settings of a replay."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from swarmjax.config import ConfigError, Section, about, show
from swarmjax.config.section import MAX_COUNT
from swarmjax.evaluate.config import AS_TRAINED, MOST_EPISODES, MOST_STEPS, STEPS, EvaluateConfig
from swarmjax.outputs import OVERWRITE
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task.config import TaskConfig, check_realism
from swarmjax.task.shapes import Shape
from swarmjax.task.stage_config import StageConfig


@dataclass(frozen=True, kw_only=True)
class ReplayConfig(Section):
    """Settings: which episodes of which policies to show, and where to write the replay."""

    command: ClassVar[str] = "replay"
    inherited: ClassVar[Mapping[str, str]] = AS_TRAINED

    policy: str = field(metadata=about("path of a policy.npz; to compare two, a.npz,b.npz"))
    stage: StageConfig
    suite: str | None = field(
        default=None,
        metadata=about("instead of a stage: a name in configs/suites/, or a .yaml or .npz file"),
    )
    cell: str | None = field(
        default=None, metadata=about("cell of the suite; null: all cells, only with worst")
    )
    robot: RobotConfig = field(default_factory=lambda: RobotConfig(body="wheeled"))
    task: TaskConfig = field(default_factory=TaskConfig)
    realism: RealismConfig = field(default_factory=RealismConfig)
    shape: Shape = field(default="box", metadata=about("shape of a random level's obstacles"))
    action: Literal["sampled", "mean"] = field(
        default="sampled",
        metadata=about(
            "actions of the robots; sampled: drawn from the policy, the same for the same level; "
            "mean: the most likely one"
        ),
    )
    level: str | None = field(
        default=None,
        metadata=about("numbers of the levels, as in 0,7,12; null: 0, unless worst is given"),
    )
    worst: int | None = field(
        default=None,
        metadata=about("replay this many of the worst episodes", 1, 100),
    )
    steps: int | None = field(
        default=None,
        metadata=about(
            f"control steps of an episode; null: as in the suite's cell, else {STEPS}",
            1,
            MOST_STEPS,
        ),
    )
    episodes: int = field(
        default=1000, metadata=about("number of levels to choose from", 1, MOST_EPISODES)
    )
    seed: int = field(default=1, metadata=about("random seed of the levels", 0, MAX_COUNT))
    workers: int | None = field(
        default=None, metadata=about("processes for worst; null: one per core", 1, 1024)
    )
    substeps: int | None = field(
        default=None,
        metadata=about("physics steps per control step; null: the body's default", 1, 1000),
    )
    extensions: str | None = field(
        default=None,
        metadata=about("Python file with the pieces that the policies need; it is executed"),
    )
    out: str = field(default="replay.html", metadata=about("HTML file of the replay"))
    video: str | None = field(default=None, metadata=about("MP4 file of the scene in 3-D"))
    overwrite: bool = field(default=False, metadata=OVERWRITE)
    video_speed: float = field(
        default=1.0,
        metadata=about("seconds of the episode per second of video", 0.05, 100.0),
    )

    def _check(self) -> None:
        check_realism(self.realism, self.robot, self.task, self.steps or STEPS)
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
        """The numbers of the named levels."""
        return (0,) if self.level is None else tuple(int(each) for each in self.level.split(","))

    @property
    def _drawn(self) -> int:
        """How many levels of a stage are drawn; no more than the named ones need."""
        is_named = self.worst is None and self.suite is None
        return max(self.levels) + 1 if is_named else self.episodes

    @property
    def evaluation(self) -> EvaluateConfig:
        """The evaluation to which the episodes belong."""
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
            episodes=self._drawn,
            seed=self.seed,
            workers=self.workers,
            substeps=self.substeps,
            extensions=self.extensions,
        )
