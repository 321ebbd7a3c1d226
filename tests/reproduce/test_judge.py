"""Tests judging a reproduction's policies on levels that differ only in their sensor noise."""

import json
from pathlib import Path

import numpy as np
import pytest
import steering
from steering import STAY, STEER, STRIDE

from swarmjax import policy
from swarmjax.config import ConfigError, to_dict
from swarmjax.evaluate import cells, engine_c
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.reproduce import judge as reproduce_judge
from swarmjax.reproduce.config import ReproduceConfig
from swarmjax.reproduce.judge import Task
from swarmjax.run.settings import TrainConfig
from swarmjax.sim.config import RobotConfig
from swarmjax.task.config import RewardConfig, TaskConfig
from swarmjax.task.stage_config import StageConfig

RADIUS = TaskConfig().target_radius


def _play(tmp_path: Path, drive: tuple) -> tuple:
    """Runs four episodes of two robots in an arena of 0.6 m by `play` and by `simulate`.

    Returns both results and the robots' distances to their targets at the start.
    """
    path = steering.write(tmp_path / "policy.npz", drive)
    stage = StageConfig(name="pair", robots=2, side=0.6)
    settings = EvaluateConfig(
        policy=str(path), stage=stage, robot=RobotConfig(), steps=150, episodes=4
    )
    levels = cells.split(cells.draw_stage(settings, range(4)).levels)
    judge = engine_c.load(settings, policy.load(path))
    away = np.array([np.hypot(*(each.start[:, :2] - each.target).T) for each in levels])
    return reproduce_judge.play(judge, levels), engine_c.simulate(judge, levels), away


def test_episodes_are_those_of_the_judge(tmp_path: Path) -> None:
    (outcome, nearer), expected, away = _play(tmp_path, STEER)
    for name, mine, theirs in zip(outcome._fields, outcome, expected, strict=True):
        np.testing.assert_array_equal(mine, theirs, err_msg=name)
    # A robot that has arrived crossed the target's radius in its last step, by at most one stride.
    # 1e-6 m allows for levels in float32.
    arrived = outcome.arrived
    assert arrived.any()
    assert len(set(outcome.clock.tolist())) > 1  # episodes have different lengths
    left = (away - nearer)[arrived]
    assert (left <= RADIUS + 1e-6).all()
    assert (left >= RADIUS - STRIDE - 1e-6).all()


def test_robots_that_stay_come_no_nearer(tmp_path: Path) -> None:
    (outcome, nearer), _, _ = _play(tmp_path, STAY)
    assert outcome.clock.tolist() == [150] * 4
    np.testing.assert_allclose(nearer, 0.0, atol=1e-9)  # rounding of the physics


def test_a_row_says_what_became_of_a_policy(tmp_path: Path) -> None:
    trained = TrainConfig(
        stage=(StageConfig(name="pair", robots=2, side=0.6),),
        task=TaskConfig(step_limit=5, reward=RewardConfig(proximity=-0.001)),
    )
    path = steering.write(tmp_path / "p.npz", STAY, config=to_dict(trained))
    tasks = [Task("baseline", 3, path, stage) for stage in reproduce_judge.STAGES]
    given = ReproduceConfig(episodes=2, workers=1)
    done: list[None] = []
    rows = reproduce_judge.judge(given, tasks, lambda: done.append(None))
    assert len(done) == 2
    for row, stage in zip(rows, reproduce_judge.STAGES, strict=True):
        assert {key: row[key] for key in ("arm", "seed", "stage", "episodes", "steps")} == {
            "arm": "baseline", "seed": 3, "stage": stage, "episodes": 2, "steps": 5.0
        }  # fmt: skip
        assert row["targets_reached"] == row["all_reached"] == 0.0
        # By equation 3 a robot that stays loses 0.001 in each of the 5 steps in which its infrared
        # sensors see something.
        assert row["return"] == pytest.approx(-0.005 * row["sensed_share"], abs=1e-9)


def test_rows_that_were_written_are_read(tmp_path: Path) -> None:
    assert reproduce_judge.read(tmp_path) == []
    (tmp_path / "evaluation.json").write_text(json.dumps({"format": 2, "rows": [{"seed": 1}]}))
    assert reproduce_judge.read(tmp_path) == [{"seed": 1}]


@pytest.mark.parametrize("text", ["{", "[]", '{"rows": null}'])
def test_rows_that_are_damaged_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "evaluation.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"cannot be read \(.*\): remove it to judge again\.$"):
        reproduce_judge.read(tmp_path)
