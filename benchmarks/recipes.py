"""What does more training achieve? Trains a recipe, and judges it at several points of training.

`python -m benchmarks.recipes label=NAME [judged=s6,crowd_dense] [key=value ...]` takes the keys of
`RecipeConfig` and of `swarmjax.train`. A recipe is a set of training settings. The benchmark trains
all seeds in one program, and pauses at points that are evenly spaced in the logarithm of the number
of updates. At each point it judges every seed on the training device, once with actions drawn from
the policy and once with mean actions. The levels for judging are in no suite. It prints one JSON
line.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import numpy as np

from benchmarks import key_value, learners_judge
from swarmjax import command, provenance
from swarmjax.config import Section, about, build, to_dict
from swarmjax.config.section import MAX_COUNT
from swarmjax.ppo.learner import LearnerState
from swarmjax.run import trainer
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import dispatch
from swarmjax.sim.config import RobotConfig
from swarmjax.task import env, stage_files
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import program as programs
from swarmjax.training import seeds
from swarmjax.training.loop import TrainState

Judge = Callable[[LearnerState], dict[str, dict[str, dict[str, np.ndarray]]]]
# Training metrics that are reported, as means over the last updates before a point.
_LOGGED = ("std", "approx_kl", "clip_fraction", "value_loss", "grad_norm", "success_by_stage")
_KEPT = 20  # maximum number of updates that these means cover


@dataclass(frozen=True, kw_only=True)
class RecipeConfig(Section):
    """Settings: the name of a recipe, and how to judge it."""

    label: str = field(default="default", metadata=about("name of the recipe"))
    judged: tuple[str, ...] = field(
        default=("s6", "crowd_dense"), metadata=about("stages of the levels")
    )
    body: str = field(default="planar", metadata=about("robot of the judge: planar or wheeled"))
    points: int = field(default=8, metadata=about("points at which to judge", 1, 1000))
    first: int = field(default=50, metadata=about("updates until the first point", 1, 10**9))
    levels: int = field(default=1000, metadata=about("of each stage", 1, 2**20))
    level_seed: int = field(default=2200, metadata=about("of their levels", 0, MAX_COUNT))
    steps: int = field(default=1500, metadata=about("control steps per episode", 1, 10**6))


def parse(words: Sequence[str]) -> tuple[RecipeConfig, TrainConfig]:
    """Separates the benchmark's own arguments from the arguments of training.

    Raises:
      ConfigError: if an argument is invalid.
    """
    recipe, rest = key_value.parse(RecipeConfig, words)
    return recipe, load_train(["seeds=5", *rest])


def load_judge(recipe: RecipeConfig, trained: TrainConfig) -> Judge:
    """Makes the judge that is used at every point.

    Returns:
      A function that takes learners [N, L] and returns means [N] over levels, by stage, kind of
      action and measure.
    """
    stages = [build(StageConfig, stage_files.read_stage(name)) for name in recipe.judged]
    robot = trained.robot
    if recipe.body != robot.body:
        robot = build(RobotConfig, to_dict(robot) | {"body": recipe.body})
    world = env.load(
        stages,
        robot,
        trained.task,
        trained.realism,
        replace(trained.sim, max_robots=None, max_obstacles=None, substeps=None),
        arenas=len(stages) * recipe.levels * trained.seeds,
    )
    drawn = [
        learners_judge.draw_levels(world, stage, recipe.level_seed, recipe.levels)
        for stage in stages
    ]
    levels = Level(*(np.concatenate(fields) for fields in zip(*drawn, strict=True)))

    def judge(learners: LearnerState) -> dict[str, dict[str, dict[str, np.ndarray]]]:
        found: dict[str, dict[str, dict[str, np.ndarray]]] = {name: {} for name in recipe.judged}
        for action, call in calls.items():
            measures = call(learners, levels)._asdict()
            for name, value in measures.items():
                parts = np.split(np.asarray(value), len(stages), 1)
                for stage, part in zip(recipe.judged, parts, strict=True):
                    found[stage].setdefault(action, {})[name] = part.mean(axis=1)
        return found

    run = partial(learners_judge.outcomes, world, trained.algo, steps=recipe.steps)
    calls = {
        action: jax.jit(jax.vmap(partial(run, sampled=sampled), in_axes=(0, None)))
        for action, sampled in (("drawn", True), ("mean", False))
    }
    return judge


def points(recipe: RecipeConfig, trained: TrainConfig) -> np.ndarray:
    """Returns the updates after which the recipe is judged; the last is the end of the budget."""
    first = min(recipe.first, trained.updates)
    spread = np.geomspace(first, trained.updates, recipe.points)
    return np.unique(np.round(spread).astype(int))


def measure(recipe: RecipeConfig, trained: TrainConfig) -> Iterator[dict[str, Any]]:
    """Trains a recipe; yields the results at each point."""
    program, schedule = programs.load(trained)
    state = jax.jit(partial(seeds.init, program))(schedule)
    compiled = trainer.compile_chunk(program, schedule, state)
    call, judge = partial(compiled.call, schedule), load_judge(recipe, trained)
    at, seconds = points(recipe, trained), 0.0
    for before, after in zip([0, *at[:-1]], at, strict=True):
        began = time.perf_counter()
        state, logged = _train(call, state, int(after - before), program.rows)
        seconds += time.perf_counter() - began
        yield {
            "updates": int(after),
            "train_s": round(seconds, 3),
            "compile_s": round(compiled.seconds, 1),
            **logged,
            "judged": jax.tree.map(
                lambda x: np.asarray(x, float).round(5).tolist(), judge(state.learners)
            ),
        }


def _train(
    call: Callable[..., Any], state: TrainState, updates: int, rows: int
) -> tuple[TrainState, dict[str, Any]]:
    """Trains all seeds for some updates, in calls of at most `rows` updates each."""
    metrics, last = {}, 0
    for done in range(0, updates, rows):
        last = min(rows, updates - done)
        state, metrics = call(state, np.int32(last))
        metrics = jax.device_get(metrics)
    kept = slice(max(0, last - _KEPT), last)
    return state, {
        name: np.asarray(metrics[name], float)[:, kept].mean(axis=1).round(6).tolist()
        for name in _LOGGED
        if name in metrics
    }


def result(recipe: RecipeConfig, trained: TrainConfig, words: Sequence[str]) -> dict[str, Any]:
    """Trains and judges a recipe; returns its JSON line."""
    found = list(measure(recipe, trained))
    return {
        "benchmark": "recipes",
        "label": recipe.label,
        "words": key_value.parse(RecipeConfig, words)[1],
        "seeds": list(trained.numbers),
        "arenas": trained.arenas,
        "budget": trained.budget,
        "levels": recipe.levels,
        "level_seed": recipe.level_seed,
        "judge": recipe.body,
        "points": found,
        "impl": dispatch.resolve_impl(trained.sim.impl),
        "device": provenance.device(),
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    recipe, trained = parse(arguments)
    sys.stdout.write(json.dumps(result(recipe, trained, arguments)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("recipes", main, TrainConfig))
