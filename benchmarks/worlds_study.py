"""Does a curriculum help on worlds with walls? Also compares level replay, memory and messages.

`python -m benchmarks.worlds_study arms=random,adaptive [key=value ...]` trains each arm on the ten
families of `stage=worlds10`, all seeds side by side in one program. It judges every seed at several
points of its training, on the device. All arms are judged on the same new levels of each family,
with the obstacle sizes of the suite `worlds`. It prints a JSON line for each arm as soon as the arm
is done. It takes the keys of `Study` and of `swarmjax.train`; `seeds` is 10 by default.

`python -m benchmarks.worlds_table FILE...` makes tables of the results.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from benchmarks import curriculum, key_value, learners_judge
from swarmjax import command, provenance
from swarmjax.config import ConfigError, Section, about, to_dict
from swarmjax.config.section import MAX_COUNT
from swarmjax.ppo.learner import LearnerState
from swarmjax.run import checkpoint
from swarmjax.run.load_settings import load_train
from swarmjax.run.policy_export import POLICY, seed_path, write_policy
from swarmjax.run.settings import TrainConfig
from swarmjax.task import env
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import program as programs
from swarmjax.training import seeds

# Settings that all arms share. `_PARTS` adds memory, messages and a critic that sees the state
# (docs/worlds.md).
RECIPE = [
    "seeds=10",
    "stage=worlds10",
    "levels_per_rollout=1",
    "task.step_limit=1500",
    "task.reward.progress=0",
    "task.reward.path_progress=1",
    "task.reward.contact=-0.05",
    "task.reward.touching=-0.003",
    "task.reward.arrival=2",
    "robot.hull_friction=1",
    "algo.rollout_length=64",
    "algo.gae_lambda=0.98",
    "algo.num_minibatches=32",
    "algo.epochs=2",
    "arenas=4096",
    "budget=8e7",
    "curriculum.success=all",
]
_EVENLY = ["curriculum.mode=adaptive", "curriculum.floor=1", "curriculum.shares=robots"]
_BY_FAILURE = [
    "curriculum.mode=adaptive",
    "curriculum.floor=0.3",
    "curriculum.shares=robots",
    "curriculum.score=failure",
]
Arm = Literal[
    "hardest",
    "random",
    "sequential",
    "mixed",
    "adaptive",
    "prerequisites",
    "learnability",
    "failure",
    "value_loss",
    "mutation",
    "combined",
]
ARMS: dict[Arm, list[str]] = {
    "hardest": _EVENLY,
    "random": _EVENLY,
    "sequential": ["curriculum.mode=sequential"],
    "mixed": ["curriculum.mode=mixed"],
    "adaptive": _BY_FAILURE,
    "prerequisites": [*_BY_FAILURE, "curriculum.prerequisites=1", "curriculum.threshold=0.6"],
    "learnability": [*_EVENLY, "curriculum.levels.mode=learnability"],
    "failure": [*_EVENLY, "curriculum.levels.mode=failure"],
    "value_loss": [*_EVENLY, "curriculum.levels.mode=value_loss"],
    "mutation": [
        *_EVENLY,
        "curriculum.levels.mode=learnability",
        "curriculum.levels.mutation=0.3",
    ],
    "combined": [*_BY_FAILURE, "curriculum.levels.mode=learnability"],
}
_PARTS = {
    "memory": ["algo.memory=gru"],
    "messages": ["task.neighbours.count=4", "task.neighbours.message_size=2"],
    "state": ["algo.critic=state"],
}
# Obstacle sizes of the suite `worlds`; the stages for training have ranges of sizes instead.
HARDEST: dict[str, dict[str, Any]] = {
    "trap": {"width": 0.3, "depth": 0.3},
    "fence": {"length": 0.6},
    "door": {"gap": 0.13},
}


@dataclass(frozen=True, kw_only=True)
class Study(Section):
    """Settings: which arms to compare, and how to judge them."""

    arms: tuple[Arm, ...] = field(
        default=tuple(ARMS),
        metadata=about("hardest: no curriculum, the suite's sizes alone; random: all families"),
    )
    without: Literal["nothing", "memory", "messages", "state"] = field(
        default="nothing", metadata=about("part of the recipe that is left out")
    )
    points: int = field(default=16, metadata=about("evenly spaced points of judging", 1, 1000))
    levels: int = field(default=64, metadata=about("levels of each family", 1, 2**20))
    level_seed: int = field(default=5, metadata=about("of these levels", 0, MAX_COUNT))
    steps: int = field(default=3000, metadata=about("control steps of an episode", 1, 10**6))
    policies: str | None = field(
        default=None, metadata=about("directory for the final policies, one directory for each arm")
    )


def load_arm(study: Study, arm: Arm, words: Sequence[str]) -> TrainConfig:
    """Makes the config of one arm.

    Args:
      study: The settings of the study.
      arm: One of the study's arms.
      words: `key=value` arguments for training, which override the recipe.

    Returns:
      The config.

    Raises:
      ConfigError: If an argument is invalid.
    """
    parts = [word for name, mine in _PARTS.items() if name != study.without for word in mine]
    found = load_train([*RECIPE, *parts, *ARMS[arm], *words])
    if arm != "hardest":
        return found
    return replace(found, stage=tuple(_hardest(stage) for stage in found.stage))


def _hardest(stage: StageConfig) -> StageConfig:
    """Returns a stage whose ranges of sizes are replaced by the sizes of the suite `worlds`."""
    sizes = HARDEST.get(stage.level, {})
    ranges = [name for name in sizes if isinstance(getattr(stage, name), tuple)]
    return replace(stage, **{name: sizes[name] for name in ranges})


def points(study: Study, trained: TrainConfig) -> np.ndarray:
    """Returns the updates [P] after which an arm is judged; the last is the end of its budget.

    Raises:
      ConfigError: If there are fewer updates than points.
    """
    if trained.updates < study.points:
        raise ConfigError(
            f"points is {study.points}, but the budget pays for {trained.updates} updates: give "
            f"at most {trained.updates}."
        )
    return np.linspace(0, trained.updates, study.points + 1).round().astype(int)[1:]


def load_judge(study: Study, trained: TrainConfig) -> curriculum.Judge:
    """Makes the judge of one arm.

    Args:
      study: The study.
      trained: The config of the arm.

    Returns:
      A function that takes learners [N, L]. For each family it returns the `Outcomes`, each as a
      mean [N] over the levels.
    """
    stages = tuple(_hardest(stage) for stage in trained.stage)
    config = programs.load(trained)[0].config.algo
    world = env.load(
        stages,
        trained.robot,
        trained.task,
        trained.realism,
        trained.sim,
        arenas=len(stages) * study.levels * trained.seeds,
    )
    levels = curriculum.draw_levels(world, stages, study.level_seed, study.levels)
    run = partial(learners_judge.outcomes, world, config, steps=study.steps, sampled=True)
    call = jax.jit(jax.vmap(lambda learners: run(learners, levels)))
    names = [stage.name for stage in stages]
    return lambda learners: curriculum.means(call(learners), names)


def results(study: Study, words: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Trains and judges all arms; yields one line per arm."""
    arms: list[tuple[Arm, TrainConfig]] = [(arm, load_arm(study, arm, words)) for arm in study.arms]
    for arm, trained in arms:
        at = points(study, trained)
        line = _line(study, arm, trained, at)
        judge = _ReportingJudge(line["arm"], load_judge(study, trained))
        curves = curriculum.measure(trained, at, judge)
        if study.policies is not None:
            write_policies(Path(study.policies) / line["arm"], judge.learners, trained, int(at[-1]))
        yield line | vars(curves)


class _ReportingJudge:
    """A judge that reports each result on stderr, and keeps the learners it judged last."""

    learners: LearnerState

    def __init__(self, name: str, judge: curriculum.Judge) -> None:
        self._name = name
        self._judge = judge

    def __call__(self, learners: LearnerState) -> dict[str, dict[str, np.ndarray]]:
        self.learners = learners
        found = self._judge(learners)
        arrived = np.mean([measures["all_reached"] for measures in found.values()])
        sys.stderr.write(f"{self._name}: all robots arrive in {100 * arrived:.1f} % of levels\n")
        return found


def write_policies(folder: Path, learners: LearnerState, trained: TrainConfig, update: int) -> None:
    """Writes the policy of each seed.

    Args:
      folder: The directory; it is created.
      learners: Learners [N, L] of N seeds.
      trained: The config of the arm.
      update: The update that the learners come from.
    """
    folder.mkdir(parents=True, exist_ok=True)
    updates = np.full(trained.seeds, update)
    leaves = checkpoint.to_leaves({"learners": learners, "update": updates})
    for seed in seeds.numbers(trained):
        write_policy(seed_path(folder / POLICY, trained, seed), leaves, trained, update, seed)


def _line(study: Study, arm: Arm, trained: TrainConfig, at: np.ndarray) -> dict[str, Any]:
    """Returns the entries of a result line that describe the arm."""
    return {
        "benchmark": "worlds_study",
        "arm": arm if study.without == "nothing" else f"{arm}, without {study.without}",
        "config": to_dict(trained),
        "seeds": list(seeds.numbers(trained)),
        "levels": study.levels,
        "level_seed": study.level_seed,
        "steps": study.steps,
        "arena_steps": (at * trained.arenas * trained.algo.rollout_length).tolist(),
        "device": provenance.device(),
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    study, words = key_value.parse(Study, arguments)
    for line in results(study, words):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("worlds_study", main, TrainConfig))
