"""Tests judging a reproduction's policies on levels that differ only in their sensor noise."""

from pathlib import Path

import numpy as np
import pytest
import steering
from steering import STAY, STEER, STRIDE

from swarmjax import policy
from swarmjax.config import to_dict
from swarmjax.evaluate import cells, engine_c
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.measures import Outcome
from swarmjax.replay.record import record
from swarmjax.reproduce import judge as reproduce_judge
from swarmjax.reproduce.judge import Task
from swarmjax.reproduce.rows import EXPANDED, LAST
from swarmjax.run.settings import TrainConfig
from swarmjax.sim.config import RobotConfig
from swarmjax.task.config import RewardConfig, TaskConfig
from swarmjax.task.stage_config import StageConfig

STAGES = (LAST, EXPANDED)
RADIUS = TaskConfig().target_radius


def _judged(tmp_path: Path, drive: tuple) -> tuple[dict[str, float], Outcome, np.ndarray]:
    """Runs four episodes of two robots in an arena of 0.6 m.

    Returns their measures, the judge's outcomes, and the distances to the targets at the start.
    """
    reward = RewardConfig(progress=1.0, proximity=0.0, arrival=7.0)
    stage = StageConfig(name="pair", robots=2, side=0.6)
    trained = TrainConfig(stage=(stage,), task=TaskConfig(reward=reward))
    path = steering.write(tmp_path / "policy.npz", drive, config=to_dict(trained))
    settings = EvaluateConfig(
        policy=str(path), stage=stage, robot=RobotConfig(), steps=150, episodes=4
    )
    levels = cells.split(cells.draw_stage(settings, range(4)).levels)
    judge = engine_c.load(settings, policy.load(path))
    away = np.array([np.hypot(*(each.start[:, :2] - each.target).T) for each in levels])
    found = reproduce_judge.measure(record(judge, levels), settings.task.sensor_range)
    return found, engine_c.simulate(judge, levels), away


def test_measures_are_those_of_the_judge(tmp_path: Path) -> None:
    found, outcome, away = _judged(tmp_path, STEER)
    assert outcome.arrived.any()
    assert len(set(outcome.clock.tolist())) > 1  # episodes have different lengths
    assert found["targets_reached"] == outcome.arrived.mean()
    assert found["all_reached"] == outcome.arrived.all(axis=-1).mean()
    assert found["sensed_share"] == outcome.sensed.sum() / outcome.moving.sum()
    assert found["contacts_per_robot"] == outcome.contacts.sum(axis=-1).mean()
    assert found["steps"] == outcome.clock.mean()
    # Equation 3 pays for the way to the target, and has no bonus for arriving. A robot that has
    # arrived crossed the target's radius in its last step, by at most one stride. 1e-6 m allows for
    # levels in float32.
    assert outcome.arrived.all()
    assert found["return"] >= (away - RADIUS).mean() - 1e-6
    assert found["return"] <= (away - RADIUS + STRIDE).mean() + 1e-6


def test_robots_that_stay_come_no_nearer(tmp_path: Path) -> None:
    found, outcome, _ = _judged(tmp_path, STAY)
    assert outcome.clock.tolist() == [150] * 4
    assert found["return"] == pytest.approx(0.0, abs=1e-9)  # rounding of the physics


def test_a_row_says_what_became_of_a_policy(tmp_path: Path) -> None:
    trained = TrainConfig(
        stage=(StageConfig(name="pair", robots=2, side=0.6),),
        task=TaskConfig(step_limit=5, reward=RewardConfig(proximity=-0.001)),
    )
    path = steering.write(tmp_path / "p.npz", STAY, config=to_dict(trained))
    tasks = [Task("baseline", 3, path, stage) for stage in STAGES]
    rows = [reproduce_judge.judge(2, task) for task in tasks]
    for row, stage in zip(rows, STAGES, strict=True):
        assert {key: row[key] for key in ("arm", "seed", "stage", "episodes", "steps")} == {
            "arm": "baseline", "seed": 3, "stage": stage, "episodes": 2, "steps": 5.0
        }  # fmt: skip
        assert row["targets_reached"] == row["all_reached"] == 0.0
        # By equation 3 a robot that stays loses 0.001 in each of the 5 steps in which its infrared
        # sensors see something.
        assert row["return"] == pytest.approx(-0.005 * row["sensed_share"], abs=1e-9)
