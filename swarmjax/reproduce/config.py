"""The settings of a reproduction."""

import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from swarmjax.config import ConfigError, Section, about, build, files, show, to_dict
from swarmjax.config.section import MAX_COUNT, modernise

_REPRODUCE_RESUME_KEYS = ("resume", "minutes", "device", "arms", "episodes", "workers")


# The runs of a reproduction: docs/paper.md.
Arm = Literal[
    "curriculum",
    "baseline",
    "curriculum_expanded",
    "baseline_expanded",
    "modern_curriculum",
    "modern_baseline",
]


ARMS: tuple[Arm, ...] = typing.get_args(Arm)


LEAST_SEEDS = 3  # for an interval


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig(Section):
    """The published experiment, several times over.

    What is not said here is as in `algo=paper`.
    """

    command: ClassVar[str] = "reproduce"
    renamed: ClassVar[Mapping[str, str]] = {"rollout": "rollout_length"}

    seeds: int = field(default=10, metadata=about("of each arm; an interval takes 3", 1, 4096))
    seed: int = field(default=0, metadata=about("the first of them", 0, MAX_COUNT))
    seeds_by: Literal["vmap", "map", "cores"] = field(
        default="cores", metadata=about("as in training")
    )
    budget: int = field(
        default=1_000_000,
        metadata=about("control steps of a seed: 'max training timesteps'", 1, MAX_COUNT),
    )
    fine_tune: int = field(
        default=250_000, metadata=about("control steps of a seed in the 1.5 m arena", 1, MAX_COUNT)
    )
    arms: tuple[Arm, ...] = field(
        default=ARMS, metadata=about("which runs; *_expanded goes on with the one before it")
    )
    rollout_length: int = field(
        default=6000, metadata=about("control steps of an update of the paper's", 1, MAX_COUNT)
    )
    epochs: int = field(
        default=80, metadata=about("of an update of the paper's: 'PPO K epochs'", 1, MAX_COUNT)
    )
    step_limit: int = field(
        default=1500, metadata=about("'Max timesteps per episode'", 1, MAX_COUNT)
    )
    time_out: Literal["terminal", "leak"] = field(
        default="terminal", metadata=about("the paper's return at the step limit: algo.time_out")
    )
    threshold: float = field(
        default=0.8, metadata=about("share of the targets that promotes", 0.0, 1.0)
    )
    robot: Literal["paper", "planar"] = field(
        default="paper", metadata=about("range of the commands: printed, or of the hardware")
    )
    impl: Literal["auto", "jax", "warp"] = field(
        default="auto", metadata=about("who steps the physics, as sim.impl")
    )
    device: Literal["auto", "cpu", "gpu"] = field(
        default="auto", metadata=about("that trains; auto: a GPU if there is one")
    )
    minutes: float | None = field(
        default=None,
        metadata=about("after which it saves and stops, to go on with resume", above=0.0),
    )
    episodes: int = field(
        default=20, metadata=about("on which each policy is judged on each stage", 1, MAX_COUNT)
    )
    workers: int | None = field(
        default=None, metadata=about("processes that judge; null: one a core", 1, 1024)
    )
    out: str | None = field(
        default=None, metadata=about("directory; null: runs/<date>-<time>-reproduce")
    )
    resume: str | None = field(
        default=None, metadata=about("directory of a reproduction to go on with")
    )

    def _check(self) -> None:
        if self.seeds < LEAST_SEEDS:
            raise ConfigError(
                f"seeds is {self.seeds}, too few for an interval: give {LEAST_SEEDS} or more."
            )
        for key in ("budget", "fine_tune"):
            if getattr(self, key) < self.rollout_length:
                raise ConfigError(
                    f"{key} is {getattr(self, key)}, which ends before the first update: give at "
                    f"least {self.rollout_length}, the control steps of one."
                )
        if not self.arms:
            raise ConfigError(f"arms is []: give some of {', '.join(ARMS)}.")
        for arm in self.arms:
            if self.arms.count(arm) > 1:
                raise ConfigError(f"arms names {arm} more than once: give each once.")
            first = arm.removesuffix("_expanded")
            if first not in self.arms:
                raise ConfigError(f"arms names {arm}, but not {first}, which it goes on with.")


def load_reproduce(
    overrides: Sequence[str], stored: Mapping[str, Any] | None = None
) -> ReproduceConfig:
    """Make the configuration of `swarmjax.reproduce` from its `key=value` words.

    Args:
        overrides: the words.
        stored: configuration of the reproduction to go on with, as `to_dict` gave it, if any; only
            what does not change what has been computed may then be given.

    Raises:
        ConfigError: see the module.
    """
    if stored is None:
        return files.load(ReproduceConfig, overrides)
    words = files.split_words(ReproduceConfig, overrides)
    for key, word in words.items():
        if key not in _REPRODUCE_RESUME_KEYS:
            raise ConfigError(
                f"{show(word, quote='')} cannot be given: resume keeps the rest of "
                f"the stored reproduction and takes {', '.join(_REPRODUCE_RESUME_KEYS)} only."
            )
    kept = to_dict(build(ReproduceConfig, modernise(ReproduceConfig, stored), "stored ")) | {
        "minutes": None
    }
    return build(ReproduceConfig, kept | files.values(words))
