"""The settings of the curriculum."""

from dataclasses import dataclass, field
from typing import Literal

from swarmjax.config import ConfigError, Section, about, show
from swarmjax.config.section import MAX_COUNT

_STEPWISE = ("sequential", "mixed")
_PREPARED = "adaptive with prerequisites"
_PROMOTING = (*_STEPWISE, _PREPARED)
# Options that only some modes accept: these modes, and the default that null means.
_MODE_OPTIONS: dict[str, tuple[tuple[str, ...], float | str | None]] = {
    "prerequisites": (("adaptive",), 0),
    "threshold": (_PROMOTING, 0.8),
    "demotion": (_STEPWISE, None),
    "budget_share": (_PROMOTING, 0.5),
    "earlier_share": (("mixed",), 0.2),
    "score": (("adaptive",), "learnability"),
    "floor": (("adaptive",), 0.1),
    "shares": (("adaptive",), "arenas"),
    "optimizer": (_STEPWISE, "keep"),
    "normalizer": (_STEPWISE, "keep"),
    "exploration": (_STEPWISE, "keep"),
    "newcomers": (_STEPWISE, "copy"),
}
_BUFFERED = ("learnability", "failure", "value_loss")
_LISTED = f"{', '.join(_BUFFERED[:-1])} and {_BUFFERED[-1]}"

# Options of a curriculum over levels with a buffer, and the default that null means.
_LEVEL_OPTIONS: dict[str, float | int] = {
    "buffer": 4096,
    "replay": 0.5,
    "mutation": 0.0,
    "temperature": 2.0,
    "staleness": 0.1,
    "minimum_episodes": 4,
}
_MOST_LEVELS = 2**20


@dataclass(frozen=True, kw_only=True)
class LevelsConfig(Section):
    """Which levels of a stage are trained on.

    In a mode without a buffer, the options of a buffer must be null. In a mode with a buffer, null
    means the default.
    """

    mode: Literal["random", "learnability", "failure", "value_loss"] = field(
        default="random",
        metadata=about(
            "random: a new level every episode; learnability: a buffer of the levels with the "
            "largest p (1 - p), where p is their success; failure: with the largest 1 - p; "
            "value_loss: with the largest positive value loss"
        ),
    )
    buffer: int | None = field(
        default=None,
        metadata=about(
            "levels to keep, an equal number for each stage; null: 4096 "
            "[learnability, failure, value_loss]",
            1,
            _MOST_LEVELS,
        ),
    )
    replay: float | None = field(
        default=None,
        metadata=about(
            "share of episodes that begin on a level of a full buffer; null: 0.5 "
            "[learnability, failure, value_loss]",
            above=0.0,
            below=1.0,
        ),
    )
    mutation: float | None = field(
        default=None,
        metadata=about(
            "share of replayed episodes that begin on a mutated level, with one wall, box, start "
            "or target moved; null: 0 [learnability, failure, value_loss]",
            0.0,
            1.0,
        ),
    )
    temperature: float | None = field(
        default=None,
        metadata=about(
            "replay is proportional to rank^(-1 / temperature); null: 2 "
            "[learnability, failure, value_loss]",
            0.01,
            100.0,
        ),
    )
    staleness: float | None = field(
        default=None,
        metadata=about(
            "share of the replay that depends on the time since a level was last played; "
            "null: 0.1 [learnability, failure, value_loss]",
            0.0,
            1.0,
        ),
    )
    minimum_episodes: int | None = field(
        default=None,
        metadata=about(
            "episodes that a level needs before it can be mutated (the newest 16 are remembered); "
            "null: 4 [learnability, failure, value_loss]",
            1,
            16,
        ),
    )

    @property
    def is_on(self) -> bool:
        """Whether the curriculum has a buffer of levels."""
        return self.mode in _BUFFERED

    @property
    def mutates(self) -> bool:
        """Whether levels are mutated."""
        return bool(self.mutation)

    def _check(self) -> None:
        for key, default in _LEVEL_OPTIONS.items():
            value = getattr(self, key)
            if not self.is_on and value is not None:
                raise ConfigError(
                    f"{key} is {show(value, quote='')}, but mode is {self.mode}, which has no "
                    f"buffer: {key} is an option of {_LISTED}, so give null or "
                    f"mode={_BUFFERED[0]}."
                )
            if self.is_on and value is None:
                object.__setattr__(self, key, default)


@dataclass(frozen=True, kw_only=True)
class CurriculumConfig(Section):
    """Which arenas train on which stage, when that changes, and what a promotion changes.

    Some options work only in the modes that their meanings name in brackets. Other modes accept
    only the initial value of such an option. In the modes that support the option, null means the
    default.
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
    threshold: float | None = field(
        default=None,
        metadata=about(
            "success at which training moves on to the next stage; null: 0.8 [sequential, mixed, "
            "adaptive with prerequisites]",
            0.0,
            1.0,
        ),
    )
    demotion: float | None = field(
        default=None,
        metadata=about(
            "success below which a run returns to the previous stage; null: never "
            "[sequential, mixed]",
            0.0,
            1.0,
        ),
    )
    budget_share: float | None = field(
        default=None,
        metadata=about(
            "share of the budget for all stages before the last, in equal parts; adaptive: limit "
            "for the prerequisites; null: 0.5 [sequential, mixed, adaptive with prerequisites]",
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
    score: Literal["learnability", "progress", "failure"] | None = field(
        default=None,
        metadata=about(
            "score of a stage with success p; learnability: p (1 - p); progress: how fast p "
            "changes; failure: 1 - p; null: learnability [adaptive]"
        ),
    )
    prerequisites: int | None = field(
        default=None,
        metadata=about(
            "how many of the first stages to practise alone until each one succeeds; null: 0 "
            "[adaptive]",
            0,
            MAX_COUNT,
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
    shares: Literal["arenas", "robots"] | None = field(
        default=None,
        metadata=about(
            "what the weights divide among stages; robots: a stage with many robots gets fewer "
            "arenas, so that the samples follow the weights; null: arenas [adaptive]"
        ),
    )
    optimizer: Literal["keep", "reset"] = field(
        default="keep",
        metadata=about("Adam's moments at a promotion; reset: set them to 0 [sequential, mixed]"),
    )
    normalizer: Literal["keep", "relearn"] = field(
        default="keep",
        metadata=about(
            "observation normaliser at a promotion; relearn: forget earlier batches and estimate "
            "it again from the next ones [sequential, mixed]"
        ),
    )
    exploration: Literal["keep", "reset"] = field(
        default="keep",
        metadata=about(
            "exploration at a promotion; reset: set it to algo.initial_std [sequential, mixed]"
        ),
    )
    newcomers: Literal["copy", "fresh"] = field(
        default="copy",
        metadata=about(
            "independent policies of robots that a promotion adds; copy: copies of the trained "
            "ones, in turn; fresh: untrained [sequential, mixed]"
        ),
    )
    levels: LevelsConfig = field(default_factory=LevelsConfig)

    def _check(self) -> None:
        kinds = {self.mode, _PREPARED} if self.prerequisites else {self.mode}
        for key, (modes, default) in _MODE_OPTIONS.items():
            value = getattr(self, key)
            plain = getattr(CurriculumConfig, key)
            accepted = not kinds.isdisjoint(modes)
            if not accepted and value != plain:
                raise ConfigError(
                    f"{key} is {show(value, quote='')}, but mode is {self.mode}: {key} is an "
                    f"option of {' and '.join(modes)}, so give {show(plain, quote='')} or "
                    f"mode={modes[0]}."
                )
            if accepted and value is None:
                object.__setattr__(self, key, default)
        if self.demotion is None or self.threshold is None:
            return
        if self.demotion >= self.threshold:
            raise ConfigError(
                f"demotion is {show(self.demotion)}, but threshold is {show(self.threshold)}: "
                f"give less than {show(self.threshold)}."
            )
