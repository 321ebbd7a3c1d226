"""The settings of a reproduction."""

import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from swarmjax.config import ConfigError, Section, about, files, show
from swarmjax.config.section import MAX_COUNT as _MOST
from swarmjax.config.section import build_stored
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
UPDATE = 6000  # control steps of an update of `algo=paper`; a shorter budget trains nothing
_RESUME_KEYS = ("resume", "minutes", "arms", "episodes", "workers")


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig(Section):
    """Settings to repeat the published experiment with several seeds, as in `algo=paper`."""

    command: ClassVar[str] = "reproduce"

    seeds: int = field(default=10, metadata=about("seeds of each arm", LEAST_DRAWN, 4096))
    budget: int = field(default=1_000_000, metadata=about("control steps of a seed", UPDATE, _MOST))
    fine_tune: int = field(default=250_000, metadata=about("the same at 1.5 m", UPDATE, _MOST))
    arms: tuple[Arm, ...] = field(
        default=ARMS, metadata=about("arms to train; NAME_expanded continues arm NAME")
    )
    minutes: float | None = field(
        default=None, metadata=about("save and stop after this time; resume continues", above=0.0)
    )
    episodes: int = field(default=20, metadata=about("episodes to judge on a stage", 1, _MOST))
    workers: int | None = field(
        default=None, metadata=about("processes that judge; null: one per core", 1, 1024)
    )
    out: str | None = field(
        default=None, metadata=about("directory; null: runs/<date>-<time>-reproduce")
    )
    resume: str | None = field(default=None, metadata=about("reproduction to continue"))

    def _check(self) -> None:
        if not self.arms:
            raise ConfigError(f"arms is []: give some of {', '.join(ARMS)}.")
        for arm in self.arms:
            first = arm.removesuffix("_expanded")
            if first not in self.arms:
                raise ConfigError(f"arms names {arm}, but not {first}, which it continues.")


def load_reproduce(
    overrides: Sequence[str], stored: Mapping[str, Any] | None = None
) -> ReproduceConfig:
    """Makes the configuration of `swarmjax.reproduce` from its `key=value` words.

    Args:
      overrides: the words.
      stored: configuration of the reproduction to continue, from `to_dict`, if any. The words may
        then only change settings that do not affect what has been computed.

    Raises:
      ConfigError: if a key or a value is invalid.
    """
    if stored is None:
        return files.load(ReproduceConfig, overrides)
    words = files.parse(ReproduceConfig, overrides)
    for key, value in words.items():
        if key not in _RESUME_KEYS:
            raise ConfigError(
                f"{key}={show(value, quote='')} cannot be given: resume keeps the rest of "
                f"the stored reproduction and takes {', '.join(_RESUME_KEYS)} only."
            )
    return build_stored(ReproduceConfig, {**stored, "minutes": None, **words}, "")
