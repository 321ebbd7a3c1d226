"""Checks which words the command `baselines` takes and refuses, and what it prints."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import baselines
from swarmjax import exit_codes, policy, policy_file
from swarmjax.command import run
from swarmjax.config import ConfigError
from swarmjax.evaluate import cells
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.task.stage_files import load_levels


def test_a_line_says_who_where_and_what_came_of_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert baselines.main(["stage=s1", "episodes=3", "who=still,straight", "workers=1"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(line["who"], line["cell"], line["episodes"]) for line in lines] == [
        ("still", "s1", 3),
        ("straight", "s1", 3),
    ]
    reached = [line["measures"]["targets_reached"] for line in lines]
    assert [each["mean"] for each in reached] == [0.0, 1.0]
    assert {"cvar", "iqm"} <= reached[0].keys()
    assert {"device", "versions", "commit", "digest"} <= lines[0].keys()


def test_a_baseline_is_compared_with_policies_on_the_same_levels(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        baselines.write(tmp_path / f"{name}.npz", *baselines.POLICIES["straight"])
    words = ["stage=s1", "episodes=3", "workers=1"]
    (line,) = baselines.results(["still"], words, str(tmp_path / "*.npz"))
    found = line["compared"]["targets_reached"]
    assert (found["a"], found["b"]) == (0.0, 1.0)
    assert (found["difference"], found["difference_interval"]) == (1.0, [1.0, 1.0])


def test_policies_on_other_levels_are_refused(tmp_path: Path) -> None:
    """The default stage is that of the policy, and a baseline has none."""
    baselines.write(tmp_path / "a.npz", *baselines.POLICIES["straight"])
    policy_word = f"policy={tmp_path / 'a.npz'}"
    others = cells.load(load_levels(EvaluateConfig, ["stage=s2", "episodes=1", policy_word])).cells
    with pytest.raises(ConfigError, match="which has other levels: give a stage"):
        baselines.judge_policies(str(tmp_path / "a.npz"), ["stage=s1", "episodes=1"], others)


def test_values_of_each_level_are_paired() -> None:
    """The difference is the same on each level, so resampling levels does not change it."""
    baseline = {"all_reached": np.array([0.0, 0.25, 0.5, 0.75])}
    policies = {"all_reached": np.stack([baseline["all_reached"] + 0.25] * 3)}
    found = baselines.compare(baseline, policies)["all_reached"]
    assert found["difference_interval"] == [0.25, 0.25]


@pytest.mark.parametrize(
    ("bearing", "action"), [(0.0, [1.0, 0.0]), (0.3, [0.4, 0.6]), (-0.25, [0.5, -0.5])]
)
def test_straight_steers_at_its_target_whatever_the_infrared_says(
    tmp_path: Path, bearing: float, action: list[float]
) -> None:
    """The turn is twice the bearing; the speed falls from full speed as the bearing grows."""
    baselines.write(tmp_path / "policy.npz", *baselines.POLICIES["straight"])
    straight = policy_file.read(str(tmp_path / "policy.npz"))
    for ray in (0.0, 0.04):
        seen = np.array([[*[ray] * 8, 0.5, bearing]], np.float32)
        assert policy.act(straight, seen)[0] == pytest.approx(action)


def test_whatever_it_is_split_into_a_cell_comes_to_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = ["stage=s2", "episodes=3", "workers=1"]
    (whole,) = baselines.results(["bug2"], words)
    monkeypatch.setattr(baselines, "BATCH", 1)
    (parts,) = baselines.results(["bug2"], words)
    assert parts["measures"] == whole["measures"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["who=straight,bug3"], "who is 'bug3': give some of straight, still, bug2, orca"),
        (["engine=mjx"], "engine cannot be given for baselines"),
        (["policy=a.npz"], "policy cannot be given for baselines"),
        (["stage=nowhere"], "nowhere"),
    ],
)
def test_what_makes_no_sense_is_refused_in_a_sentence(words: list[str], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        baselines.main(words)


def test_a_missing_package_ends_the_command_with_code_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "navground.core", None)
    monkeypatch.setattr("sys.argv", ["baselines", "stage=s1", "who=hl"])
    assert run("baselines", baselines.main, EvaluateConfig) == exit_codes.USER_ERROR
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "install the extra navground" in said
