"""Checks what the policy without learning does."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks import baselines
from swarmjax import policy, policy_file
from swarmjax.evaluate import cells, trials
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.task.stage_files import load_levels


def test_the_baseline_is_judged_like_any_policy(tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    assert baselines.main([f"out={path}"]) == 0
    words = [f"policy={path}", "stage=s1", "episodes=3", "workers=1"]
    settings = load_levels(EvaluateConfig, words)
    entrants = trials.read_policies([str(path)])
    (trial,) = trials.run(settings, cells.load(settings).cells, entrants)
    assert np.mean(trial.measures["targets_reached"]) == 1.0


@pytest.mark.parametrize(
    ("bearing", "action"), [(0.0, [1.0, 0.0]), (0.3, [0.4, 0.6]), (-0.25, [0.5, -0.5])]
)
def test_straight_steers_at_its_target_whatever_the_infrared_says(
    tmp_path: Path, bearing: float, action: list[float]
) -> None:
    """The turn is twice the bearing; the speed falls from full speed as the bearing grows."""
    baselines.write(tmp_path / "policy.npz")
    straight = policy_file.read(str(tmp_path / "policy.npz"))
    for ray in (0.0, 0.04):
        seen = np.array([[*[ray] * 8, 0.5, bearing]], np.float32)
        assert policy.act(straight, seen)[0] == pytest.approx(action)
