"""The settings of a replay."""

import re
from dataclasses import dataclass, field, fields
from typing import ClassVar

from swarmjax.config import ConfigError, about, setting, show
from swarmjax.evaluate.config import EvaluateConfig, JudgeConfig


@dataclass(frozen=True, kw_only=True)
class ReplayConfig(JudgeConfig):
    """Settings: which episodes of which policies to show, and where to write the replay."""

    command: ClassVar[str] = "replay"

    policy: str = field(metadata=about("path of a policy.npz; to compare two, a.npz,b.npz"))
    level: str | None = setting(
        None, "numbers of the levels to replay, as in 0,7,12; null: 0, unless worst is given"
    )
    worst: int | None = setting(None, "replay this many of the worst episodes", 1, 100)
    out: str = setting("replay.html", "HTML file of the replay")
    video: str | None = setting(None, "MP4 file of the scene in 3-D; null: no video")

    def _check(self) -> None:
        super()._check()
        if not 1 <= len(self.policies) <= 2 or not all(self.policies):
            raise ConfigError(
                f"policy is {show(self.policy)}: give one file, or two with a comma between them."
            )
        if self.level is not None and self.worst is not None:
            raise ConfigError(
                f"level is {self.level} and worst is {self.worst}: give only one of the two."
            )
        if self.suite is not None and self.worst is None:
            raise ConfigError(f"suite is {show(self.suite)}: give worst too, as in worst=5.")
        if self.level is not None and not re.fullmatch(r"\d{1,10}(,\d{1,10})*", self.level):
            raise ConfigError(
                f"level is {show(self.level)}: give whole numbers with commas between them, "
                "as in 0,7,12."
            )

    @property
    def policies(self) -> tuple[str, ...]:
        """Paths of the policy files."""
        return tuple(self.policy.split(","))

    @property
    def levels(self) -> tuple[int, ...]:
        """Indices of the levels that `level` lists; index 0 if it is None."""
        return (0,) if self.level is None else tuple(int(each) for each in self.level.split(","))

    @property
    def evaluation(self) -> EvaluateConfig:
        """Settings of the evaluation to which the replayed episodes belong."""
        shared = {item.name: getattr(self, item.name) for item in fields(JudgeConfig)}
        return EvaluateConfig(policy=self.policy, **shared)
