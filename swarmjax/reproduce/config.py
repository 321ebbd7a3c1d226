"""The settings of a reproduction."""

import typing
from dataclasses import dataclass
from typing import ClassVar, Literal

from swarmjax.config import ConfigError, Section, setting
from swarmjax.config.section import MAX_COUNT as _MOST
from swarmjax.evaluate.statistics import LEAST_DRAWN

# docs/paper.md describes the runs of a reproduction.
Arm = Literal[
    "curriculum",
    "baseline",
    "curriculum_expanded",
    "baseline_expanded",
    "modern_curriculum",
    "modern_baseline",
]
ARMS: tuple[Arm, ...] = typing.get_args(Arm)
# Arena control steps of a seed: `BUDGET` is from the paper's Table 1, `FINE_TUNE` our own choice.
BUDGET, FINE_TUNE = 1_000_000, 250_000
UPDATE = 6000  # arena control steps per update of `algo=paper`; a smaller budget trains nothing


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig(Section):
    """Settings to repeat the published experiment (`algo=paper`) with several seeds."""

    command: ClassVar[str] = "reproduce"

    seeds: int = setting(10, "number of seeds of each arm", LEAST_DRAWN, 4096)
    budget: int = setting(BUDGET, "control steps of a seed; if fewer, no verdicts", UPDATE, _MOST)
    fine_tune: int = setting(FINE_TUNE, "as budget, for the arms NAME_expanded", UPDATE, _MOST)
    arms: tuple[Arm, ...] = setting(ARMS, "arms to train; NAME_expanded continues arm NAME")
    minutes: float | None = setting(
        None, "save and stop after this many minutes; resume=DIR continues", above=0.0
    )
    out: str | None = setting(None, "directory to write; null: runs/<date>-<time>-reproduce")
    resume: str | None = setting(None, "directory of the reproduction to continue")

    @property
    def is_short(self) -> bool:
        """Whether `budget` or `fine_tune` is below its default, so that no claim is decided."""
        return self.budget < BUDGET or self.fine_tune < FINE_TUNE

    def _check(self) -> None:
        if not self.arms:
            raise ConfigError(f"arms is []: give at least one of {', '.join(ARMS)}.")
        for arm in self.arms:
            first = arm.removesuffix("_expanded")
            if first not in self.arms:
                raise ConfigError(f"arms lists {arm}, which continues {first}: add {first}.")
