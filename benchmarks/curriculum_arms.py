"""Defines the arms that a study of curricula compares, and when and on which stages it judges them.

An arm is a curriculum mode with the stages that lead to the goal. The arm `final` is the baseline,
which trains on the goal alone. `benchmarks.curriculum` describes the command.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np

from benchmarks import key_value
from swarmjax.config import ConfigError, Section, about
from swarmjax.config.section import MAX_COUNT
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.task.stage_config import StageConfig

BASELINE = "final"
HELD_OUT = "expanded"
GRID_GOAL = "s6"
HELD_OUT_ROBOTS = 5  # with another `sim.max_robots`, policies are judged on the goal alone
_CHOSEN = {"stage": "goal", "algo.policy": "policies", "curriculum.mode": "arms"}


@dataclass(frozen=True, kw_only=True)
class StudyConfig(Section):
    """Settings: which arms to compare, and how to judge them."""

    goal: str = field(default="s6", metadata=about("final stage of all arms"))
    arms: tuple[Literal["final", "sequential", "mixed", "adaptive", "adaptive-grid"], ...] = field(
        default=("final", "sequential", "mixed", "adaptive"),
        metadata=about("final: the goal alone; adaptive-grid: stage=grid instead of the list"),
    )
    policies: tuple[Literal["shared", "independent"], ...] = field(
        default=("shared", "independent"), metadata=about("algo.policy")
    )
    label: str | None = field(default=None, metadata=about("name of the arm, if there is only one"))
    points: int = field(default=10, metadata=about("points at which arms are judged", 2, 1000))
    first: int = field(default=100_000, metadata=about("arena steps at the first point", 1, 10**15))
    levels: int = field(default=256, metadata=about("of each stage", 1, 2**20))
    level_seed: int = field(default=2, metadata=about("of their levels", 0, MAX_COUNT))

    def _check(self) -> None:
        if "adaptive-grid" in self.arms and self.goal != GRID_GOAL:
            raise ConfigError(
                f"arms holds adaptive-grid, whose last cell is {GRID_GOAL}, but goal is "
                f"{self.goal}: give goal={GRID_GOAL}, or other arms."
            )
        if self.label is not None and len(self.arms) > 1:
            raise ConfigError(
                f"label is {self.label}, but arms names {len(self.arms)} arms: give one arm with a "
                "label."
            )


def parse(words: Sequence[str]) -> tuple[StudyConfig, list[str]]:
    """Separates the words for the study from the words for training.

    Args:
      words: `key=value` words of the command line.

    Returns:
      The study, and the words for training.

    Raises:
      ConfigError: if a word of the study is invalid, or a word sets a key that the arms set.
    """
    for key in (word.partition("=")[0] for word in words):
        if key in _CHOSEN:
            raise ConfigError(f"{key} cannot be given: choose it by {_CHOSEN[key]}.")
    return key_value.parse(StudyConfig, words)


def curriculum_of(goal: str) -> str:
    """Returns the name of the file in configs/stage/ whose stages lead to a goal."""
    return "curriculum" if goal == "s6" else f"{goal}_curriculum"


def load_arm(study: StudyConfig, arm: str, policy: str, words: Sequence[str]) -> TrainConfig:
    """Makes the config of one arm.

    Args:
      study: the study.
      arm: one of the study's arms.
      policy: one of the study's policies.
      words: `key=value` words for training.

    Returns:
      The config; all arms of a study have the same number of arenas and the same budget.

    Raises:
      ConfigError: if a word is invalid.
    """
    chosen = {
        BASELINE: [f"stage={study.goal}"],
        "adaptive-grid": ["stage=grid", "curriculum.mode=adaptive"],
    }.get(arm, [f"stage={curriculum_of(study.goal)}", f"curriculum.mode={arm}"])
    return load_train(["seeds=10", *words, *chosen, f"algo.policy={policy}"])


def points(study: StudyConfig, trained: TrainConfig) -> np.ndarray:
    """Computes the updates [P] after which arms are judged, evenly spaced on a logarithmic scale.

    Args:
      study: the study.
      trained: the config of an arm.

    Returns:
      Increasing integers up to the whole budget; fewer than requested if rounding makes some equal.

    Raises:
      ConfigError: if the budget ends before the first point.
    """
    update = trained.arenas * trained.algo.rollout_length
    first = max(1, round(study.first / update))
    if first >= trained.updates:
        raise ConfigError(
            f"first is {study.first}, but budget is {trained.budget}: give less than "
            f"{trained.updates * update}."
        )
    return np.unique(np.geomspace(first, trained.updates, study.points).round().astype(int))


def roles(study: StudyConfig, trained: TrainConfig, words: Sequence[str]) -> dict[str, StageConfig]:
    """Returns the stages that are judged, by their role."""
    load = partial(_stages, words)
    found = {"goal": load(study.goal)[-1]}
    if trained.sim.max_robots == HELD_OUT_ROBOTS:
        found["first"] = load(curriculum_of(study.goal))[0]
        found["held_out"] = load(HELD_OUT)[-1]
    return found


def _stages(words: Sequence[str], name: str) -> tuple[StageConfig, ...]:
    maxima = [word for word in words if word.startswith("sim.")]
    return load_train([*maxima, f"stage={name}"]).stage
