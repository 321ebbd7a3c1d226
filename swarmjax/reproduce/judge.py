"""Judges the policies of a reproduction in MuJoCo's C engine. No JAX.

Every policy drives by its mean action on the last stage and in the 1.5 m arena. The levels differ
only in their sensor noise.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from swarmjax import policy_file
from swarmjax.config import build
from swarmjax.evaluate import cells
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.replay.record import Recording, record
from swarmjax.report.rows import Row
from swarmjax.run.load_settings import from_stored
from swarmjax.task import stage_files
from swarmjax.task.stage_config import StageConfig

_EQUATION_3 = ("progress", "proximity")  # the terms of the paper's reward


class Task(NamedTuple):
    """A policy to judge on a stage."""

    arm: str
    seed: int
    path: Path
    stage: str


def judge(episodes: int, task: Task) -> Row:
    """Judges one policy on one stage.

    Args:
      episodes: number of episodes.
      task: the policy and the stage.

    Returns:
      A row of `evaluation.json`.

    Raises:
      PolicyError: if the policy is invalid.
      ConfigError: if the physics breaks down.
    """
    trained = policy_file.read(str(task.path))
    config = from_stored(trained.meta["config"])
    evaluation = EvaluateConfig(
        policy=str(task.path),
        stage=build(StageConfig, stage_files.read_stage(task.stage)),
        robot=config.robot,
        task=config.task,
        realism=config.realism,
        action="mean",
        steps=config.task.step_limit,
        episodes=episodes,
    )
    levels = cells.split(cells.draw_stage(evaluation, range(episodes)).levels)
    recordings = record(evaluate_judge.load(evaluation, trained), levels)
    about = {"arm": task.arm, "seed": task.seed, "stage": task.stage, "episodes": episodes}
    return about | measure(recordings, config.task.sensor_range)


def measure(episodes: Sequence[Recording], sensor_range: float) -> dict[str, float]:
    """Computes the means of a policy over its episodes.

    Args:
      episodes: episodes of the same number of robots.
      sensor_range: range of the infrared sensors, m.
    """
    moving = np.concatenate([~each.arrived[:-1] for each in episodes])
    near = np.concatenate([(each.ray[1:] < sensor_range).any(axis=-1) for each in episodes])
    reached = np.array([each.arrived[-1] for each in episodes])
    earned = sum(
        float(each.reward[term].sum())
        for each in episodes
        for term in _EQUATION_3
        if term in each.reward
    )
    return {
        "targets_reached": float(reached.mean()),
        "all_reached": float(reached.all(axis=-1).mean()),
        "sensed_share": float((near & moving).sum() / moving.sum()),
        "contacts_per_robot": float(np.mean([each.contacts[-1].sum(-1) for each in episodes])),
        "steps": float(np.mean([len(each.pose) - 1 for each in episodes])),
        "return": earned / reached.size,
    }
