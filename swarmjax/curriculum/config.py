"""The settings of the curriculum."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from swarmjax.config import Section, about
from swarmjax.config.section import MAX_COUNT, check_options

_STEPWISE, _ADAPTIVE = ("sequential", "mixed"), ("adaptive",)
_PROMOTING = (*_STEPWISE, "adaptive with prerequisites")
# The modes that read an option.
_READ_BY: dict[str, tuple[str, Sequence[str]]] = {
    "earlier_share": ("mode", ("mixed",)),
    "optimizer": ("mode", _STEPWISE),
    "exploration": ("mode", _STEPWISE),
    "prerequisites": ("mode", _ADAPTIVE),
    "score": ("mode", _ADAPTIVE),
    "floor": ("mode", _ADAPTIVE),
    "shares": ("mode", _ADAPTIVE),
}


@dataclass(frozen=True, kw_only=True)
class LevelsConfig(Section):
    """Which levels of a stage are trained on."""

    mode: Literal["random", "learnability", "value_loss"] = field(
        default="random",
        metadata=about(
            "random: a new level every episode; learnability: a buffer of the levels with the "
            "largest p (1 - p), where p is their success; value_loss: with the largest positive "
            "value loss"
        ),
    )
    buffer: int = field(
        default=4096,
        metadata=about(
            "levels to keep, an equal number for each stage [learnability, value_loss]", 1, 2**20
        ),
    )
    replay: float = field(
        default=0.5,
        metadata=about(
            "share of episodes that begin on a level of a full buffer [learnability, value_loss]",
            above=0.0,
            below=1.0,
        ),
    )
    temperature: float = field(
        default=2.0,
        metadata=about(
            "replay is proportional to rank^(-1 / temperature) [learnability, value_loss]",
            0.01,
            100.0,
        ),
    )
    staleness: float = field(
        default=0.1,
        metadata=about(
            "share of the replay that depends on the time since a level was last played "
            "[learnability, value_loss]",
            0.0,
            1.0,
        ),
    )

    def _check(self) -> None:
        buffered = ("mode", ("learnability", "value_loss"))
        keys = ("buffer", "replay", "temperature", "staleness")
        check_options(self, dict.fromkeys(keys, buffered))


@dataclass(frozen=True, kw_only=True)
class CurriculumConfig(Section):
    """Which arenas train on which stage, when that changes, and what a promotion changes.

    Some options are read only by the modes that their meanings name in brackets.
    """

    mode: Literal["sequential", "mixed", "adaptive"] = field(
        default="mixed",
        metadata=about(
            "sequential: all arenas on the newest stage; mixed: some on earlier stages; adaptive: "
            "on all stages, more of them on stages with a higher score"
        ),
    )
    success: Literal["targets", "all"] = field(
        default="targets",
        metadata=about(
            "measure of success; targets: share of targets reached; all: share of episodes in "
            "which all robots arrived"
        ),
    )
    threshold: float = field(
        default=0.8,
        metadata=about(
            "success at which training moves on to the next stage [sequential, mixed, adaptive "
            "with prerequisites]",
            0.0,
            1.0,
        ),
    )
    budget_share: float = field(
        default=0.5,
        metadata=about(
            "share of the budget for all stages before the last, in equal parts; adaptive: limit "
            "for the prerequisites [sequential, mixed, adaptive with prerequisites]",
            above=0.0,
            below=1.0,
        ),
    )
    earlier_share: float = field(
        default=0.2,
        metadata=about("share of the arenas on earlier stages [mixed]", above=0.0, below=1.0),
    )
    score: Literal["learnability", "failure"] = field(
        default="learnability",
        metadata=about(
            "score of a stage with success p; learnability: p (1 - p); failure: 1 - p [adaptive]"
        ),
    )
    prerequisites: int = field(
        default=0,
        metadata=about(
            "how many of the first stages to practise alone until each one succeeds [adaptive]",
            0,
            MAX_COUNT,
        ),
    )
    floor: float = field(
        default=0.1,
        metadata=about(
            "share of the arenas spread evenly over all stages [adaptive]", above=0.0, high=1.0
        ),
    )
    shares: Literal["arenas", "robots"] = field(
        default="arenas",
        metadata=about(
            "what the weights divide among stages; robots: a stage with many robots gets fewer "
            "arenas, so that the samples follow the weights [adaptive]"
        ),
    )
    optimizer: Literal["keep", "reset"] = field(
        default="keep",
        metadata=about("Adam's moments at a promotion; reset: set them to 0 [sequential, mixed]"),
    )
    exploration: Literal["keep", "reset"] = field(
        default="keep",
        metadata=about(
            "exploration at a promotion; reset: set it to algo.initial_std [sequential, mixed]"
        ),
    )
    levels: LevelsConfig = field(default_factory=LevelsConfig)

    def _check(self) -> None:
        promoting = dict.fromkeys(("threshold", "budget_share"), ("mode", _PROMOTING))
        check_options(self, _READ_BY | ({} if self.prerequisites else promoting))
