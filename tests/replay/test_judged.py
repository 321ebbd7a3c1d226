"""Tests that a replay takes its worst levels from an evaluation of the same episodes, if stored."""

import json
from collections.abc import Callable
from pathlib import Path

import extensions
import numpy as np
import pytest
import replays
import steering

from swarmjax.evaluate import __main__ as evaluate
from swarmjax.evaluate import cells, trials
from swarmjax.replay import __main__ as replay
from swarmjax.replay import judged
from swarmjax.replay.config import ReplayConfig
from swarmjax.replay.episodes import worst
from swarmjax.task.stage_files import load_levels

WORDS = (*replays.SMALL, "steps=40", "workers=1", "episodes=6", "robot.hull_friction=1")
OWN = "@reward_term(weight=1.0)\ndef mine(step):\n    return step.distance\n"


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    """Writes a policy, and beside it the folder `judged` with its evaluation."""
    path = steering.write(tmp_path / "steer.npz")
    words = [word for word in WORDS if "friction" not in word]
    assert evaluate.main([f"policy={path}", *words, f"out={tmp_path / 'judged'}"]) == 0
    return path


def _find(policy: Path, *words: str):
    settings = load_levels(ReplayConfig, [f"policy={policy}", *WORDS, "worst=2", *words])
    (entrant,) = trials.read_policies([str(policy)])
    return judged.find(settings, entrant, cells.load(settings.evaluation))


def test_the_results_are_those_of_the_evaluation(policy):
    found = _find(policy)
    assert found is not None
    settings = load_levels(ReplayConfig, [f"policy={policy}", *WORDS, "worst=2"])
    entrants = trials.read_policies([str(policy)])
    suite = cells.load(settings.evaluation)
    again = list(trials.run(settings.evaluation, suite.cells, entrants))
    for name in judged.RANKED:
        np.testing.assert_array_equal(found[1][0].measures[name], again[0].measures[name])
    assert worst(found[1], 6) == worst(again, 6)


def test_nothing_is_judged_again(policy, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(trials, "run", None)
    words = [word for word in WORDS if "friction" not in word]
    assert replay.main([f"policy={policy}", *words, "worst=2", f"out={tmp_path / 'a.html'}"]) == 0
    said = (
        f"Takes the results of 6 episodes from {tmp_path / 'judged'}, where evaluate stored them."
    )
    assert said in capsys.readouterr().err


def test_it_says_that_it_judges(tmp_path, capsys):
    path = steering.write(tmp_path / "steer.npz")
    words = [word for word in WORDS if "friction" not in word]
    assert replay.main([f"policy={path}", *words, "worst=2", f"out={tmp_path / 'a.html'}"]) == 0
    said = "Evaluates 6 episodes. To reuse results, give `out=` to evaluate (docs/replay.md)."
    assert said in capsys.readouterr().err


def test_the_folder_of_the_page_is_searched(policy, tmp_path):
    elsewhere = steering.write(tmp_path / "policies" / "other" / "steer.npz")
    assert _find(elsewhere) is None
    assert _find(elsewhere, f"out={tmp_path / 'a.html'}") is not None


def test_a_comparison_serves_for_both_policies(policy, tmp_path):
    ahead = steering.write(tmp_path / "ahead.npz", steering.AHEAD)
    words = [word for word in WORDS if "friction" not in word]
    assert _find(ahead) is None
    evaluate.main([f"compare={policy},{ahead}", *words, f"out={tmp_path / 'both'}"])
    assert _find(ahead) is not None


@pytest.mark.parametrize(
    "word",
    ["seed=2", "steps=41", "episodes=5", "stage.robots=2", "action=mean", "realism=real"],
)
def test_an_evaluation_of_other_episodes_is_not_used(policy, word):
    assert _find(policy, word) is None


def test_an_evaluation_of_another_policy_is_not_used(policy):
    assert _find(steering.write(policy, steering.AHEAD)) is None


def test_an_extension_is_judged_anew(policy, tmp_path):
    file = extensions.write(tmp_path / "own.py", OWN)
    assert _find(policy, f"extensions={file}") is None


def _edit(change: Callable[[dict], object]) -> Callable[[str], str]:
    """Makes a change of a JSON text."""

    def edit(text: str) -> str:
        content = json.loads(text)
        change(content)
        return json.dumps(content)

    return edit


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("result.json", lambda text: text[:-9]),
        ("result.json", lambda _: "[]"),
        ("result.json", lambda _: "[" * 100_000),
        ("result.json", _edit(lambda each: each["versions"].update(mujoco="1"))),
        ("result.json", _edit(lambda each: each["cells"][0].update(digest="0"))),
        ("result.json", _edit(lambda each: each.update(cells=[3]))),
        ("result.json", _edit(lambda each: each.update(policies={"a": []}))),
        ("levels.csv", lambda text: text[: len(text) // 2]),
        ("levels.csv", lambda text: text.replace("targets_reached", "other")),
        ("levels.csv", lambda text: text.replace("steer", "other")),
        ("levels.csv", lambda text: text.replace("s6,3", "s6,4")),
        ("levels.csv", lambda text: text.replace("1.28", "x")),
        ("levels.csv", lambda _: "a" * 200_000 + ",b"),
        ("levels.csv", lambda _: "\udcff"),
    ],
)
def test_a_damaged_file_is_not_used(policy, name, change):
    file = policy.parent / "judged" / name
    text = file.read_text()
    file.write_text(change(text), errors="surrogateescape")
    assert file.read_text(errors="replace") != text
    assert _find(policy) is None
