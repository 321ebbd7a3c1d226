"""Evaluates the policies of a reproduction in MuJoCo's C engine. Needs no JAX.

Every policy drives on the last stage and in the 1.5 m arena, each with sampled actions and with its
mean action. PPO-PyTorch, which the paper used, tests with sampled actions. The levels of a stage
differ only in their sensor noise.
"""

from pathlib import Path
from typing import NamedTuple

from swarmjax import policy_file
from swarmjax.config import build
from swarmjax.evaluate import cells, engine_c
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.report.rows import Row
from swarmjax.reproduce.rows import Action
from swarmjax.run.load_settings import from_stored
from swarmjax.task import stage_files
from swarmjax.task.stage_config import StageConfig

EPISODES = 20  # for each policy, stage and kind of action


class Task(NamedTuple):
    """A policy to evaluate on one stage with one kind of action."""

    arm: str
    seed: int
    path: Path
    stage: str
    action: Action


def judge(task: Task) -> Row:
    """Evaluates one policy on one stage, and returns a row of `evaluation.json`.

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
        action=task.action,
        steps=config.task.step_limit,
        episodes=EPISODES,
    )
    levels = cells.split(cells.draw_stage(evaluation, range(EPISODES)).levels)
    outcome = engine_c.simulate(engine_c.load(evaluation, trained), levels)
    return {
        "arm": task.arm,
        "seed": task.seed,
        "stage": task.stage,
        "action": task.action,
        "targets_reached": float(outcome.arrived.mean()),
        "all_reached": float(outcome.arrived.all(axis=-1).mean()),
        "sensed_share": float(outcome.sensed.sum() / outcome.moving.sum()),
        "contacts_per_robot": float(outcome.contacts.sum(axis=-1).mean()),
    }
