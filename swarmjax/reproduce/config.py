"""The settings of a reproduction."""

import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from swarmjax.config import ConfigError, Section, about, build, files, show, to_dict
from swarmjax.config.section import MAX_COUNT, build_stored

_REPRODUCE_RESUME_KEYS = ("resume", "minutes", "device", "arms", "episodes", "workers")


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


LEAST_SEEDS = 3  # for an interval


@dataclass(frozen=True, kw_only=True)
class ReproduceConfig(Section):
    """Settings to repeat the published experiment with several seeds.

    All other settings are as in `algo=paper`.
    """

    command: ClassVar[str] = "reproduce"

    seeds: int = field(default=10, metadata=about("seeds of each arm; at least 3", 1, 4096))
    seed: int = field(default=0, metadata=about("the first seed", 0, MAX_COUNT))
    seeds_by: Literal["vmap", "map", "cores"] = field(
        default="cores", metadata=about("as in training")
    )
    budget: int = field(
        default=1_000_000,
        metadata=about("control steps per seed: 'max training timesteps'", 1, MAX_COUNT),
    )
    fine_tune: int = field(
        default=250_000, metadata=about("control steps per seed in the 1.5 m arena", 1, MAX_COUNT)
    )
    arms: tuple[Arm, ...] = field(
        default=ARMS, metadata=about("arms to train; NAME_expanded continues arm NAME")
    )
    rollout_length: int = field(
        default=6000, metadata=about("control steps per update of the paper's PPO", 1, MAX_COUNT)
    )
    epochs: int = field(
        default=80, metadata=about("per update of the paper's PPO: 'PPO K epochs'", 1, MAX_COUNT)
    )
    step_limit: int = field(
        default=1500, metadata=about("'Max timesteps per episode'", 1, MAX_COUNT)
    )
    time_out: Literal["terminal", "leak"] = field(
        default="terminal", metadata=about("the paper's return at the step limit: algo.time_out")
    )
    threshold: float = field(
        default=0.8, metadata=about("share of targets reached that promotes", 0.0, 1.0)
    )
    robot: Literal["paper", "planar"] = field(
        default="paper", metadata=about("speed range: as printed, or of the hardware")
    )
    impl: Literal["auto", "jax", "warp"] = field(
        default="auto", metadata=about("physics implementation, as in sim.impl")
    )
    device: Literal["auto", "cpu", "gpu"] = field(
        default="auto", metadata=about("device for training; auto: a GPU if there is one")
    )
    minutes: float | None = field(
        default=None,
        metadata=about("save and stop after this time; resume continues", above=0.0),
    )
    episodes: int = field(
        default=20, metadata=about("episodes to judge each policy on each stage", 1, MAX_COUNT)
    )
    workers: int | None = field(
        default=None, metadata=about("processes that judge; null: one per core", 1, 1024)
    )
    out: str | None = field(
        default=None, metadata=about("directory; null: runs/<date>-<time>-reproduce")
    )
    resume: str | None = field(
        default=None, metadata=about("directory of a reproduction to continue")
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
                    f"least {self.rollout_length}, the control steps of one update."
                )
        if not self.arms:
            raise ConfigError(f"arms is []: give some of {', '.join(ARMS)}.")
        for arm in self.arms:
            if self.arms.count(arm) > 1:
                raise ConfigError(f"arms names {arm} more than once: give each once.")
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
        if key not in _REPRODUCE_RESUME_KEYS:
            raise ConfigError(
                f"{key}={show(value, quote='')} cannot be given: resume keeps the rest of "
                f"the stored reproduction and takes {', '.join(_REPRODUCE_RESUME_KEYS)} only."
            )
    kept = to_dict(build_stored(ReproduceConfig, stored, "stored ")) | {"minutes": None}
    return build(ReproduceConfig, kept | files.nest(words))
