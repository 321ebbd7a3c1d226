"""Where does a curriculum help?

Each mode of the curriculum is compared with training on the goal alone, at equal arena steps.

`python -m benchmarks.curriculum goal=s6 arms=final,sequential,mixed,adaptive [key=value ...]` takes
the keys of `curriculum_arms.StudyConfig` and of `swarmjax.train`, except `stage`, `algo.policy` and
`curriculum.mode`, which the arms set. `seeds` is 10 by default.

Each arm trains all its seeds in one program. Training pauses at points that are evenly spaced on a
logarithmic scale of arena steps, and at each point the policies of every seed are judged on the
device. All arms are judged on the same levels of the goal. If the program is compiled for 5 robots,
all arms are also judged on the 1.5 m arena and on the first stage of the goal's curriculum. No arm
trains on the 1.5 m arena, and some arms do not train on the first stage. The command prints a JSON
line for each arm and kind of policy as soon as the arm has finished.
`benchmarks.curriculum_table` makes tables and plots from these lines.

The baseline `final` trains on the goal alone. To compare options of one mode, run one arm at a time
and give it a label: `arms=adaptive label=progress curriculum.score=progress`.
"""

import hashlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from benchmarks import curriculum_arms, learners_judge
from benchmarks.curriculum_arms import StudyConfig
from benchmarks.learners_judge import Outcomes
from swarmjax import command, provenance
from swarmjax.config import to_dict
from swarmjax.ppo.learner import LearnerState
from swarmjax.run import trainer
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import dispatch
from swarmjax.task import env
from swarmjax.task.env import World
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import mesh, seeds
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.program import Program

Judge = Callable[[LearnerState], dict[str, dict[str, np.ndarray]]]


def load_judge(study: StudyConfig, trained: TrainConfig, judged: dict[str, StageConfig]) -> Judge:
    """Makes one judge for all points, arms and policies.

    The judge compiles once for each kind of policy.

    Args:
      study: the study.
      trained: the config of any arm.
      judged: the stages, by role.

    Returns:
      A function that takes learners [N, L]. For each role it returns every field of `Outcomes` as a
      mean [N] over the levels.
    """
    stages, arenas = tuple(judged.values()), len(judged) * study.levels
    world = env.load(
        stages,
        trained.robot,
        trained.task,
        trained.realism,
        trained.sim,
        arenas=arenas * trained.seeds,
    )
    levels = draw_levels(world, stages, study.level_seed, study.levels)
    run = partial(learners_judge.outcomes, world, trained.algo, steps=trained.task.step_limit)
    call = jax.jit(jax.vmap(run, in_axes=(0, None)))
    return lambda learners: means(call(learners, levels), list(judged))


def draw_levels(world: World, stages: Sequence[StageConfig], seed: int, count: int) -> Level:
    """Draws the same number of levels for each stage, one stage after another.

    Args:
      world: the compiled environment.
      stages: S stages.
      seed: seed of the levels.
      count: E levels for each stage.

    Returns:
      [S E] levels.
    """
    drawn = [learners_judge.draw_levels(world, stage, seed, count) for stage in stages]
    return Level(*(np.concatenate(fields) for fields in zip(*drawn, strict=True)))


def means(found: Outcomes, names: Sequence[str]) -> dict[str, dict[str, np.ndarray]]:
    """Averages outcomes over the levels of each stage.

    Args:
      found: [N, S E] outcomes of N seeds on levels that `draw_levels` drew.
      names: S names of the stages.

    Returns:
      The means [N] by stage name and measure.
    """
    split = {name: np.split(np.asarray(x), len(names), 1) for name, x in found._asdict().items()}
    return {
        name: {measure: parts[i].mean(axis=1) for measure, parts in split.items()}
        for i, name in enumerate(names)
    }


@dataclass(frozen=True, kw_only=True, eq=False)
class Curves:
    """The results of an arm.

    Attributes:
      judged: [N, P] results of N seeds at P points, by role and measure.
      transitions: [N, P] robot steps that each seed has trained on up to each point.
      stage: [N, P] index of the newest stage at each point.
      mix: [P, S] share of the arenas on each stage, over all seeds.
      broken_arenas: number of training episodes that broken physics ended, over all seeds.
      train_s: [P] seconds of training up to each point, without compiling and judging.
      judge_s: seconds of judging.
      compile_s: seconds of compiling the training.
      judge_compile_s: seconds of the first judging, including its compilation.
    """

    judged: dict[str, dict[str, list[list[float]]]]
    transitions: list[list[int]]
    stage: list[list[int]]
    mix: list[list[float]]
    broken_arenas: int
    train_s: list[float]
    judge_s: float
    compile_s: float
    judge_compile_s: float


def measure(trained: TrainConfig, at: np.ndarray, judge: Judge) -> Curves:
    """Trains one arm, and judges it at every point.

    Args:
      trained: the arm's config.
      at: [P] updates, increasing.
      judge: judges learners [N, L].

    Returns:
      The curves.
    """
    program, schedule = programs.load(trained)
    state = jax.jit(mesh.init(program))(schedule)
    compiled = trainer.compile_chunk(program, schedule, state)
    call = partial(compiled.call, schedule)
    # This first judging includes compilation, and the time in which Warp builds its kernels in its
    # first step. Neither counts as training.
    judge_compile_s, _ = _timed(partial(judge, jax.device_get(state.learners)))
    rows, train_s, judge_s = [], [], 0.0
    for n in np.diff(at, prepend=0):
        seconds, (state, row) = _timed(partial(_train, program, call, state, int(n)))
        train_s.append(seconds + (train_s[-1] if train_s else 0.0))
        seconds, found = _timed(partial(judge, jax.device_get(state.learners)))
        judge_s += seconds
        rows.append(row | {"judged": found})
    judged = {
        role: {name: _curve([row["judged"][role][name] for row in rows]) for name in names}
        for role, names in rows[0]["judged"].items()
    }
    return Curves(
        judged=judged,
        transitions=np.cumsum([row["transitions"] for row in rows], axis=0).T.tolist(),
        stage=np.array([row["stage"] for row in rows]).T.tolist(),
        mix=[row["mix"].round(4).tolist() for row in rows],
        broken_arenas=int(sum(row["broken_arenas"] for row in rows)),
        train_s=train_s,
        judge_s=judge_s,
        compile_s=compiled.seconds,
        judge_compile_s=judge_compile_s,
    )


def _curve(rows: Sequence[np.ndarray]) -> list[list[float]]:
    """Turns P rows [N] into lists [N, P], rounded to five decimals."""
    return np.array(rows, np.float64).T.round(5).tolist()


def _timed[T](call: Callable[[], T]) -> tuple[float, T]:
    """Returns the seconds of a call and its result, once the result is ready."""
    began = time.perf_counter()
    result = jax.block_until_ready(call())
    return time.perf_counter() - began, result


def _train(
    program: Program, call: Callable[..., Any], state: TrainState, n: int
) -> tuple[TrainState, dict[str, Any]]:
    """Trains all seeds for n updates, in calls no longer than the program's report interval."""
    transitions, broken, metrics, last = 0, 0, {}, 0
    for done in range(0, n, program.rows):
        last = min(program.rows, n - done)
        state, metrics = call(state, np.int32(last))
        metrics = jax.device_get(metrics)
        transitions = transitions + metrics["transitions"][:, :last].astype(np.int64).sum(axis=1)
        broken += metrics["broken_arenas"][:, :last].sum()
    mix = metrics["mix"][:, last - 1].sum(axis=0)
    return state, {
        "transitions": transitions,
        "broken_arenas": broken,
        "stage": metrics["stage"][:, last - 1],
        "mix": mix / mix.sum(),
    }


def results(study: StudyConfig, words: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Trains and judges all arms; yields one line per arm and policy."""
    arms = [
        (arm, policy, curriculum_arms.load_arm(study, arm, policy, words))
        for policy in study.policies
        for arm in study.arms
    ]
    judged = curriculum_arms.roles(study, arms[0][2], words)
    judge = load_judge(study, arms[0][2], judged)
    for arm, _, trained in arms:
        at = curriculum_arms.points(study, trained)
        curves = measure(trained, at, judge)
        yield _line(study, arm, trained, at) | {
            "roles": {role: stage.name for role, stage in judged.items()},
            **vars(curves),
        }


def _line(study: StudyConfig, arm: str, trained: TrainConfig, at: np.ndarray) -> dict[str, Any]:
    """Returns the entries of the JSON line that describe an arm."""
    whole = to_dict(trained)
    digest = hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()
    return {
        "benchmark": "curriculum",
        "goal": study.goal,
        "arm": study.label or arm,
        "policy": trained.algo.policy,
        "curriculum": whole["curriculum"],
        "stages": trained.stage_names,
        "seeds": list(seeds.numbers(trained)),
        "arenas": trained.arenas,
        "budget": trained.budget,
        "levels": study.levels,
        "level_seed": study.level_seed,
        "steps": trained.task.step_limit,
        "robot": trained.robot.body,
        "realism": trained.realism.name,
        "impl": dispatch.resolve_impl(trained.sim.impl),
        "arena_steps": (at * trained.arenas * trained.algo.rollout_length).tolist(),
        "settings_digest": digest[:12],
        "device": provenance.device(),
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    study, words = curriculum_arms.parse(arguments)
    for line in results(study, words):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("curriculum", main, TrainConfig))
