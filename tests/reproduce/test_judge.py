"""Tests judging a reproduction's policies: on which levels, and what a row says of the outcome."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import steering

from swarmjax.config import to_dict
from swarmjax.evaluate import engine_c
from swarmjax.evaluate.engine_c import Judge
from swarmjax.evaluate.measures import Outcome
from swarmjax.reproduce import judge as reproduce_judge
from swarmjax.reproduce.judge import Task
from swarmjax.reproduce.rows import EXPANDED, LAST
from swarmjax.run.settings import TrainConfig
from swarmjax.task.config import TaskConfig
from swarmjax.task.level import Level
from swarmjax.task.stage_config import StageConfig


def _policy(folder: Path, drive: tuple, steps: int) -> Path:
    trained = TrainConfig(
        stage=(StageConfig(name="pair", robots=2, side=0.6),), task=TaskConfig(step_limit=steps)
    )
    return steering.write(folder / "p.npz", drive, config=to_dict(trained))


def test_a_row_is_computed_from_all_episodes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[Judge, Sequence[Level]]] = []

    def simulate(judge: Judge, levels: Sequence[Level]) -> Outcome:
        seen.append((judge, levels))
        zero = np.zeros((2, 2))
        # Three of four robots arrive, all of one episode. They sense something in 30 of 60 steps.
        return Outcome(
            clock=np.array([10, 20]),
            arrived=np.array([[True, True], [True, False]]),
            arrival=zero,
            contacts=np.array([[[1, 0, 0], [0, 2, 0]], [[0, 0, 3], [0, 0, 0]]]),
            touched=np.zeros((2, 2, 3)),
            sensed=np.array([[5, 5], [0, 20]]),
            moving=np.array([[10, 10], [20, 20]]),
            path=zero,
            still=zero,
            anchor=np.zeros((2, 2, 2)),
            measured=np.zeros((2, 0)),
        )

    monkeypatch.setattr(engine_c, "simulate", simulate)
    task = Task("baseline", 3, _policy(tmp_path, steering.STAY, 5), LAST, "sampled")
    assert reproduce_judge.judge(task) == {
        "arm": "baseline",
        "seed": 3,
        "stage": LAST,
        "action": "sampled",
        "targets_reached": 0.75,
        "all_reached": 0.5,
        "sensed_share": 0.5,
        "contacts_per_robot": 1.5,
    }
    ((judge, levels),) = seen
    assert (judge.config.action, judge.config.step_limit, len(levels)) == ("sampled", 5, 20)
    # The levels differ in their noise alone.
    assert all(np.array_equal(each.target, levels[0].target) for each in levels)
    assert len({int(each.seed) for each in levels}) == 20


@pytest.mark.parametrize("stage", [LAST, EXPANDED])
def test_a_policy_that_stays_reaches_nothing(
    stage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reproduce_judge, "EPISODES", 2)
    path = _policy(tmp_path, steering.STAY, 5)
    row = reproduce_judge.judge(Task("baseline", 0, path, stage, "mean"))
    assert row["targets_reached"] == row["all_reached"] == 0.0
