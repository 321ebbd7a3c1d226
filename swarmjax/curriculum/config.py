"""The settings of the curriculum."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from swarmjax.config import ConfigError, Section, about, setting, show
from swarmjax.config.section import ByName, check_options
from swarmjax.extension import OwnCurriculum

PROMOTING = ("sequential", "mixed")  # modes that move from stage to stage
MODES = (*PROMOTING, "adaptive", "frontier")
# Options that have an effect only in some modes. Values: the key `mode`, and these modes.
_READ_BY: dict[str, tuple[str, Sequence[str]]] = {
    **dict.fromkeys(("budget_share", "optimizer", "exploration"), ("mode", PROMOTING)),
    **dict.fromkeys(("score", "shares"), ("mode", ("adaptive",))),
    "threshold": ("mode", (*PROMOTING, "frontier")),
    "floor": ("mode", ("adaptive", "frontier")),
}


@dataclass(frozen=True, kw_only=True)
class CurriculumConfig(Section):
    """Settings: which arenas train on which stage, when that changes, and what a promotion resets.

    Some options have an effect only in some modes. Their descriptions name these modes in brackets.
    """

    mode: str = setting(
        "mixed",
        "where arenas train; sequential: all on the newest stage; mixed: most on the newest, some "
        "on earlier stages; adaptive: on all stages, more on those with a higher score; frontier: "
        "on stages whose easier neighbours are learned; or the name of an extension's curriculum",
    )
    axes: dict[str, tuple[float | tuple[float, float], ...]] = field(
        default_factory=ByName,
        metadata=about(
            "for each key of the stage, a list of easier values, from easy to hard; each "
            "combination becomes a stage, and mode is frontier by default"
        ),
    )
    success: Literal["targets", "all"] = setting(
        "targets",
        "measure of success; targets: share of targets that were reached; all: share of episodes "
        "in which all robots arrived",
    )
    threshold: float | tuple[float, ...] = setting(
        0.8,
        "success from which a stage counts as learned: one number, or a list with one per stage "
        "[mode=sequential, mixed or frontier]",
        0.0,
        1.0,
    )
    budget_share: float = setting(
        0.5,
        "budget share of all stages before the last, in equal parts [mode=sequential or mixed]",
        above=0.0,
        below=1.0,
    )
    score: Literal["learnability", "failure"] = setting(
        "learnability",
        "score of a stage with success p; learnability: p (1 - p); failure: 1 - p [mode=adaptive]",
    )
    floor: float = setting(
        0.1,
        "share of the arenas that is spread evenly over all stages [mode=adaptive or frontier]",
        above=0.0,
        high=1.0,
    )
    shares: Literal["arenas", "robots"] = setting(
        "arenas",
        "what the stages' weights are shares of; robots: a stage with more robots gets fewer "
        "arenas, so that its weight is its share of all robots [mode=adaptive]",
    )
    optimizer: Literal["keep", "reset"] = setting(
        "keep", "Adam's moments after a promotion; reset: 0 [mode=sequential or mixed]"
    )
    exploration: Literal["keep", "reset"] = setting(
        "keep",
        "SD of actions after a promotion; reset: algo.initial_std [mode=sequential or mixed]",
    )

    def _check(self) -> None:
        check_options(self, _READ_BY)


def check_mode(mode: str, own: Sequence[OwnCurriculum]) -> None:
    """Refuses a `curriculum.mode` that is neither built in nor a curriculum of an extension."""
    names = [*MODES, *(piece.name for piece in own)]
    if mode not in names:
        raise ConfigError(
            f"curriculum.mode is {show(mode)}: give one of {', '.join(names)}, or add "
            "extensions=FILE, the Python file that defines this curriculum."
        )
