"""Tests the replay command: the levels it chooses, the files it writes, and what it refuses."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import policies
import pytest
import replays
import steering
from rich.progress import Progress
from sentences import refusal

from swarmjax import command, policy_file
from swarmjax.evaluate import cells, judge, trials
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.suite_config import SUITE_SEED, CellConfig
from swarmjax.policy import PolicyError
from swarmjax.replay import __main__ as replay
from swarmjax.replay import video
from swarmjax.replay.config import ReplayConfig
from swarmjax.replay.episodes import Pick, outcome, worst
from swarmjax.task.config import TaskConfig
from swarmjax.task.stage_config import StageConfig
from swarmjax.task.stage_files import load_levels

ROOT = Path(replay.__file__).resolve().parents[2]
QUICK = (*replays.SMALL, "steps=40", "workers=1")


@pytest.fixture(scope="module")
def steer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return steering.write(tmp_path_factory.mktemp("replay") / "steer.npz")


def _trial(reached: list, contacts: list, time: list):
    measured = {
        "targets_reached": np.array([reached]),
        "contacts_per_robot": np.array([contacts]),
        "episode_time_s": np.array([time]),
    }
    return SimpleNamespace(
        cell=SimpleNamespace(episodes=np.arange(len(reached))), measures=measured
    )


def test_the_worst_reached_least_then_touched_most_then_took_longest():
    judged = [
        _trial([1.0, 0.4, 0.4, 0.4], [9.0, 1.0, 2.0, 1.0], [48.0, 48.0, 48.0, 30.0]),
        _trial([0.4, 0.2], [1.0, 0.0], [48.0, 48.0]),
    ]
    order = [Pick(1, 1), Pick(0, 2), Pick(0, 1), Pick(1, 0), Pick(0, 3), Pick(0, 0)]
    assert worst(judged, 6) == order
    assert worst(judged, 2) == order[:2]


def _levels(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Returns the levels that the command printed, as in `7 of s6`."""
    lines = capsys.readouterr().out.splitlines()
    return [each.split(":")[0].removeprefix("Episode ") for each in lines if each[:7] == "Episode"]


def test_levels_are_written_in_the_order_in_which_they_were_named(steer, tmp_path, capsys):
    out = tmp_path / "new" / "a.html"
    assert replay.main([f"policy={steer}", *QUICK, "level=3,1", f"out={out}"]) == 0
    assert _levels(capsys) == ["3 of s6", "1 of s6"]
    assert out.read_text().startswith("<!DOCTYPE html>")


def test_the_worst_are_replayed(steer, tmp_path, capsys):
    words = [f"policy={steer}", *QUICK, "steps=150", "episodes=8"]
    rubs = "robot.hull_friction=1"  # as the command by default
    _, every = replays.recorded(steer, *words[1:], rubs, "level=0,1,2,3,4,5,6,7")
    reached = np.array([(each.arrival > 0).sum() for each in every])
    contacts = np.array([each.contacts[-1].sum() for each in every])
    frames = np.array([len(each.pose) for each in every])
    assert len(set(zip(reached, contacts, frames, strict=True))) > 2  # the levels differ in these
    order = sorted(range(8), key=lambda i: (reached[i], -contacts[i], -frames[i], i))
    assert replay.main([*words, "worst=3", f"out={tmp_path / 'a.html'}"]) == 0
    assert _levels(capsys) == [f"{i} of s6" for i in order[:3]]


def test_policies_replay_the_same_levels(steer, tmp_path):
    ahead = steering.write(tmp_path / "ahead.npz", steering.AHEAD)
    settings = load_levels(ReplayConfig, [f"policy={steer},{ahead}", *QUICK, "level=2"])
    entrants = trials.read_policies(settings.policies)
    progress = Progress(disable=True)
    (episode,) = replay.replay(settings, entrants, progress)
    first, second = episode.runs
    np.testing.assert_array_equal(first.pose[0], second.pose[0])
    np.testing.assert_array_equal(first.target, second.target)
    assert np.abs(first.pose[-1] - second.pose[-1]).max() > 0.01


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    """Writes a suite of two cells, with one robot and with two robots."""
    drawn = []
    for robots in (1, 2):
        stage = StageConfig(name=f"r{robots}", robots=robots, side=0.8)
        numbers = (4, 0, 7)[: 4 - robots]
        drawn.append(
            cells.draw_cell(
                CellConfig(
                    name=stage.name,
                    stage=stage,
                    levels=len(numbers),
                    episodes=numbers,
                    seed=SUITE_SEED,
                )
            )
        )
    cells.write(tmp_path / "suite.npz", cells.Suite("mine", tuple(drawn)))
    return tmp_path / "suite.npz"


def test_the_worst_of_a_suite_are_replayed(steer, suite, tmp_path, capsys):
    words = [f"policy={steer}", f"suite={suite}", f"out={tmp_path / 'a.html'}", "workers=1"]
    assert replay.main([*words, "worst=5", "steps=1"]) == 0
    # No robot arrives or touches anything in a single step, so the levels keep their order.
    assert _levels(capsys) == ["4 of r1", "0 of r1", "7 of r1", "4 of r2", "0 of r2"]


def _ended(arrived: list[bool], steps: int) -> Any:
    """Returns what `outcome` reads of a recording."""
    frames = np.tile(arrived, (steps + 1, 1))
    return SimpleNamespace(arrived=frames, pose=frames)


@pytest.mark.parametrize(
    ("runs", "arrival", "text"),
    [
        ([_ended([True, False], 384)], "latch", "1 of 2 robots arrived, 12.3 s"),
        ([_ended([True], 10)], "latch", "1 of 1 robot arrived, 0.3 s"),
        ([_ended([True, False], 10)], "hold", "1 of 2 robots within their targets, 0.3 s"),
        (
            [_ended([True, False], 1500), _ended([True, True], 384)],
            "latch",
            "1 and 2 of 2 robots arrived, 48.0 and 12.3 s",
        ),
    ],
)
def test_a_title_says_how_the_episode_ended(runs, arrival, text):
    assert outcome(runs, TaskConfig(arrival=arrival)) == text


def test_only_levels_that_are_named_are_drawn(steer, monkeypatch):
    words = [f"policy={steer}", *QUICK, "seed=5", "robot.hull_radius=0.035"]
    settings = load_levels(ReplayConfig, [*words, "level=7,2"])
    every = cells.draw_stage(settings.evaluation, range(8))
    drawn, draw = [], judge.draw_level

    def count(stage, spacing, seed, episode, *drawings):
        drawn.append(episode)
        return draw(stage, spacing, seed, episode, *drawings)

    monkeypatch.setattr(judge, "draw_level", count)
    entrants = trials.read_policies(settings.policies)
    seven, two = replay.replay(settings, entrants, Progress(disable=True))
    assert drawn[:2] == [7, 2]
    assert set(drawn[2:]) <= {0}  # the engine is compiled with level 0
    levels = cells.split(every.levels)
    for episode, number in ((seven, 7), (two, 2)):
        scene, level = episode.runs[0].scene, levels[number]
        np.testing.assert_array_equal(episode.runs[0].target[0], level.target)
        np.testing.assert_array_equal(scene.box, level.obstacle[level.obstacle_present])
        # Levels are drawn in float32, which limits how closely the engine's poses match them.
        np.testing.assert_allclose(episode.runs[0].pose[0], level.start, atol=1e-6)


def test_a_page_whose_writing_breaks_off_is_as_it_was(steer, tmp_path, monkeypatch):
    out = tmp_path / "a.html"
    out.write_text("before")

    def crash(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", crash)
    with pytest.raises(KeyboardInterrupt):
        replay.main([f"policy={steer}", *QUICK, f"out={out}"])
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a.html": "before"}


def test_a_film_that_cannot_be_written_says_why(steer, tmp_path, monkeypatch):
    def fail(*_: object) -> None:
        raise OSError("ffmpeg ended")  # imageio gives no error number

    monkeypatch.setattr(video, "check", lambda: None)
    monkeypatch.setattr(video, "_pictures", fail)
    film = tmp_path / "a.mp4"
    words = [f"policy={steer}", *QUICK, f"out={tmp_path / 'a.html'}", f"video={film}"]
    sentence = f"video is {film}, which cannot be written: ffmpeg ended."
    assert refusal(replay.main, words) == sentence


def test_what_a_suite_has_not_is_refused(steer, suite):
    words = [f"policy={steer}", f"suite={suite}"]
    assert refusal(replay.main, [*words, "worst=6"]) == ("worst is 6: give 1 to 5 levels.")
    assert refusal(load_levels, ReplayConfig, [*words, "level=4"]).endswith(
        ": give worst too, as in worst=5."
    )
    assert refusal(load_levels, ReplayConfig, [*words, "worst=1", "seed=3"]).startswith(
        "seed cannot be given with"
    )


def test_defaults():
    settings = load_levels(ReplayConfig, ["policy=a.npz,b.npz"])
    stage = load_levels(EvaluateConfig, ["policy=a"]).stage
    assert settings == ReplayConfig(policy="a.npz,b.npz", stage=stage, robot=settings.robot)
    assert settings.policies == ("a.npz", "b.npz")
    assert (settings.levels, settings.robot.body) == ((0,), "wheeled")
    assert settings.evaluation.step_limit == 1500


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["level=x"], "level is 'x': give whole numbers with commas between them, as in 0,7,12."),
        (["level=-1"], "level is '-1': give whole numbers with commas between them, as in 0,7,12."),
        (["level=1", "worst=2"], "level is 1 and worst is 2: give only one of the two."),
        (["worst=0"], "worst is 0: give 1 to 100."),
        (
            ["stage=curriculum"],
            "stage is curriculum, a curriculum: give one stage, as in stage=s6.",
        ),
    ],
)
def test_settings_are_refused(words, sentence):
    assert refusal(load_levels, ReplayConfig, ["policy=a.npz", *words]) == sentence


@pytest.mark.parametrize("policies", ["a,b,c", "a,", ",a"])
def test_one_or_two_policies(policies):
    assert refusal(load_levels, ReplayConfig, [f"policy={policies}"]) == (
        f"policy is '{policies}': give one file, or two with a comma between them."
    )


def test_files_that_cannot_be_written_are_refused(steer, tmp_path):
    (tmp_path / "file").write_text("")
    words = [f"policy={steer}", *QUICK]
    out = tmp_path / "file" / "a.html"
    assert refusal(replay.main, [*words, f"out={out}"]) == (
        f"out is {out}, which cannot be written: File exists."
    )
    folder = tmp_path / "b.html"
    folder.mkdir()
    assert refusal(replay.main, [*words, f"out={folder}"]) == (
        f"out is {folder}, which cannot be written: it is a folder."
    )
    words += [f"out={tmp_path / 'a.html'}", "video=a.gif"]
    assert refusal(replay.main, words) == "video is a.gif: give a name that ends with .mp4."
    assert not (tmp_path / "a.html").exists()


def test_a_policy_that_does_not_fit_is_refused(steer, tmp_path):
    path = tmp_path / "two.npz"
    trained = policies.arrays(learners=2)
    policy_file.write(path, trained, policies.meta(**policies.several(2)))
    words = [f"policy={steer},{path}", *QUICK, f"out={tmp_path / 'a.html'}"]
    with pytest.raises(PolicyError, match=r"two\.npz holds a network for each of 2 robots"):
        replay.main(words)


def test_a_mistake_ends_in_one_sentence_and_code_2(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["replay", "policy=none.npz"])
    assert command.run("replay", replay.main, ReplayConfig) == 2
    error = capsys.readouterr().err
    assert error.startswith("swarmjax.replay: error: none.npz ")
    assert error.count("\n") == 1


def test_it_runs_without_jax(steer, tmp_path):
    code = (
        "import sys, runpy\n"
        "sys.modules.update(dict.fromkeys(['jax', 'flax', 'chex', 'mujoco.mjx', 'imageio']))\n"
        f"sys.argv = ['replay', 'policy={steer}', *{QUICK}, 'out=a.html']\n"
        "runpy.run_module('swarmjax.replay', run_name='__main__', alter_sys=True)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.html").exists()
