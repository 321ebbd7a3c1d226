"""Judges the policies of a reproduction in MuJoCo's C engine: `evaluation.json`. No JAX.

Every policy drives by its mean action on the last stage and in the 1.5 m arena. The levels differ
only in their sensor noise.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from swarmjax import policy_file
from swarmjax.config import ConfigError, build, reading
from swarmjax.evaluate import cells, engine_c, trials
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.engine_c import Arenas
from swarmjax.evaluate.judge import Judge
from swarmjax.evaluate.measures import Outcome
from swarmjax.provenance import cores
from swarmjax.report.rows import Row
from swarmjax.reproduce.config import ReproduceConfig
from swarmjax.reproduce.rows import EVALUATION, EXPANDED, LAST
from swarmjax.run.load_settings import from_stored
from swarmjax.task import observation, stage_files
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig

STAGES = (LAST, EXPANDED)


class Task(NamedTuple):
    """A policy to judge on a stage."""

    arm: str
    seed: int
    path: Path
    stage: str


def judge(
    given: ReproduceConfig,
    tasks: Sequence[Task],
    report: Callable[[], None] = lambda: None,
) -> list[Row]:
    """Judges policies in several processes.

    Args:
      given: settings of the reproduction, with the number of episodes and processes.
      tasks: the tasks to judge.
      report: called whenever a task is done.

    Returns:
      A row of `evaluation.json` for each task.

    Raises:
      PolicyError: if a policy is invalid.
      ConfigError: if the physics breaks down.
    """
    workers = min(given.workers or cores(), max(1, len(tasks)))
    found = []
    for row in trials.work(partial(_judge, given.episodes), tasks, workers):
        found.append(row)
        report()
    return found


def _judge(episodes: int, task: Task) -> Row:
    """Judges one policy on one stage."""
    trained = policy_file.read(str(task.path))
    config = from_stored(trained.meta["config"])
    stage = build(StageConfig, stage_files.read_stage(task.stage))
    evaluation = EvaluateConfig(
        policy=str(task.path),
        stage=stage,
        robot=config.robot,
        task=config.task,
        realism=config.realism,
        action="mean",
        steps=config.task.step_limit,
        episodes=episodes,
    )
    levels = cells.split(cells.draw_stage(evaluation, range(episodes)).levels)
    outcome, nearer = play(evaluate_judge.load(evaluation, trained), levels)
    weights = config.task.reward  # only the terms of equation 3
    earned = weights.progress * nearer + weights.proximity * outcome.sensed
    return {
        "arm": task.arm,
        "seed": task.seed,
        "stage": task.stage,
        "episodes": episodes,
        "targets_reached": float(outcome.arrived.mean()),
        "all_reached": float(outcome.arrived.all(axis=-1).mean()),
        "sensed_share": float(outcome.sensed.sum() / outcome.moving.sum()),
        "contacts_per_robot": float(outcome.contacts.sum(axis=-1).mean()),
        "steps": float(outcome.clock.mean()),
        "return": float(earned.mean()),
    }


def play(judge: Judge, levels: Sequence[Level]) -> tuple[Outcome, np.ndarray]:
    """Runs episodes side by side, each until all its robots have arrived or the time is up.

    Args:
      judge: everything that the arenas share.
      levels: [A] the arenas' levels.

    Returns:
      The outcomes, and how much closer to its target each robot came before it arrived, [A, R] m.

    Raises:
      ConfigError: if the physics of an episode breaks down.
    """
    arenas = engine_c.start(judge, levels)
    total, nearer = arenas.outcome, np.zeros(arenas.outcome.arrived.shape)
    for _ in range(judge.config.step_limit):
        running = ~total.arrived.all(axis=-1)
        if not running.any():
            break
        before, arenas = arenas, engine_c.step(judge, arenas)
        gained = _distance(before) - _distance(arenas)
        nearer += np.where(before.outcome.arrived, 0.0, gained)
        total = Outcome(
            *(_keep(running, *each) for each in zip(arenas.outcome, total, strict=True))
        )
    return total, nearer


def _distance(arenas: Arenas) -> np.ndarray:
    """Computes the distances [A, R] to the targets, m."""
    return observation.to_target(arenas.pose, arenas.target, np)[0]


def _keep(running: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """Takes new values [A, ...] for running arenas and keeps the old ones for the others."""
    return np.where(running.reshape(running.shape + (1,) * (new.ndim - 1)), new, old)


def read(out: Path) -> list[Row]:
    """Reads the rows that already exist.

    Args:
      out: directory of the reproduction.

    Raises:
      ConfigError: if the file is damaged.
    """
    path = out / EVALUATION
    if not path.exists():
        return []
    try:
        return [*reading.read_json(path)["rows"]]
    except (ConfigError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} cannot be read ({error}): remove it to judge again.") from None
