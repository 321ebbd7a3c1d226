"""Tests replays with `task.arrival=hold`, in which a robot enters its target and leaves again."""

import json
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import chromium
import holding
import numpy as np
import pytest
import replays
import steering
from holding import ENTERS, LEAVES, OTHER, RETURNS

from swarmjax import policy_file
from swarmjax.evaluate import engine_c
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.engine_c import Arenas, Judge
from swarmjax.replay import pack, page, record
from swarmjax.replay.config import ReplayConfig
from swarmjax.replay.record import Recording
from swarmjax.task.stage_files import load_levels

WORDS = (
    "stage.robots=2", "stage.obstacles=0", "stage.side=0.8", "robot=planar", "level=0",
    "task.reward.arrival=8", "task.reward.step_penalty=-0.25", "task.reward.contact=0",
)  # fmt: skip


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return steering.write(tmp_path_factory.mktemp("hold") / "policy.npz")


def _settings(policy: Path, *words: str) -> ReplayConfig:
    return load_levels(ReplayConfig, [f"policy={policy}", *WORDS, *words])


def _act(judge: Judge, memory: None, arenas: Arenas) -> tuple[None, np.ndarray]:
    """Replaces the policy by the actions of the scene in tests/holding.py."""
    row = min(int(arenas.outcome.clock[0]), RETURNS - 1)
    return memory, np.broadcast_to(holding.actions()[row], (len(arenas.data), 2, 2))


def _drive(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(engine_c, "act", _act)


@pytest.fixture(scope="module")
def recordings(policy: Path) -> list[Recording]:
    """Records the scene, and a second one in which robot 1's target is far away.

    Both episodes have a limit of 80 steps.
    """
    with pytest.MonkeyPatch.context() as patch:
        _drive(patch)
        settings = _settings(policy, "task.arrival=hold", "steps=80")
        judge = evaluate_judge.load(settings.evaluation, policy_file.read(policy))
        one = holding.level()
        far = one._replace(target=np.array([one.target[0], [0.35, -0.35]], np.float32))
        return record.record(judge, [one, far])


def test_an_episode_ends_when_all_are_there_whatever_others_do(
    recordings: list[Recording],
) -> None:
    assert [len(each.pose) for each in recordings] == [RETURNS + 1, 81]


def test_recording_ends_with_the_last_episode_though_robots_have_left_again(
    policy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _drive(monkeypatch)
    settings = _settings(policy, "task.arrival=hold", "steps=140")
    judge = evaluate_judge.load(settings.evaluation, policy_file.read(policy))
    one = holding.level()
    # After step 61 robot 0 is at x = 120.6 mm and drives back. In the second arena robot 0 is
    # within 50 mm of its target at -80 mm after 38 more steps. By then robot 0 of the first arena
    # has left its target at 60 mm again.
    behind = one._replace(target=np.array([[-0.08, 0.0], one.target[1]], np.float32))
    found = record.record(judge, [one, behind])
    assert [len(each.pose) - 1 for each in found] == [RETURNS, holding.TURNED + 38]


def test_who_is_within_its_target_is_recorded_step_by_step(recordings: list[Recording]) -> None:
    np.testing.assert_array_equal(recordings[0].arrived[1:], holding.arrived())
    assert recordings[0].arrival.tolist() == [RETURNS, OTHER]
    # In the second scene robot 1 never reaches its target. Robot 0 returns to its target and stays
    # within it to the end.
    assert recordings[1].arrival.tolist() == [RETURNS, 0]


def test_the_reward_is_that_of_training(recordings: list[Recording]) -> None:
    """Checks the numbers of tests/task/test_hold.py."""
    total = {name: term.sum(axis=0) for name, term in recordings[0].reward.items()}
    outside = np.array([ENTERS + RETURNS - LEAVES, OTHER])
    np.testing.assert_allclose(total["step_penalty"], -0.25 * outside)
    np.testing.assert_array_equal(total["arrival"], [8.0, 8.0])
    np.testing.assert_array_equal(recordings[0].reward["arrival"][-1], [8.0, 8.0])
    way = recordings[0].distance[0] - recordings[0].distance[-1]
    np.testing.assert_allclose(total["progress"], way, atol=1e-9)  # sums of 64 float64
    assert not recordings[1].reward["arrival"].any()


def _header(packed: bytes) -> dict[str, Any]:
    data = zlib.decompress(packed)
    return json.loads(data[4 : 4 + int.from_bytes(data[:4], "little")])


def _series(recording: Recording) -> list[str]:
    """Returns the names of the series in a packed recording."""
    (episode,) = _header(pack.pack({}, [replays.episode(recording)], 0.04))["episodes"]
    return [name for name, *_ in episode["runs"][0]["series"]]


def test_only_a_robot_that_left_again_needs_a_series(
    recordings: list[Recording], policy: Path
) -> None:
    assert "arrived" in _series(recordings[0])
    _, (latched,) = replays.recorded(policy, *WORDS, "steps=400")
    assert latched.arrived.any()
    assert "arrived" not in _series(latched)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    yield from chromium.browsers(tmp_path_factory.mktemp("profile"))


@chromium.needed
@pytest.mark.slow
def test_the_page_says_who_is_within_its_target(
    browser: Any, recordings: list[Recording], policy: Path, tmp_path: Path
) -> None:
    settings = _settings(policy, "task.arrival=hold")
    episodes = [replays.episode(recordings[0])]
    file = tmp_path / "replay.html"
    file.write_text(page.page(settings, [policy_file.read(policy)], episodes, "the command"))
    browser.get(file.as_uri())
    ready = (
        "return new Promise((done) => {const wait = () => window.replay?.ready ? done(1) : "
        "setTimeout(wait, 20); wait();})"
    )
    browser.execute_script(ready)
    browser.execute_script("replay.pause()")
    steps = np.arange(1, RETURNS + 1)
    for step, there in zip(steps, holding.arrived().sum(axis=-1), strict=True):
        browser.execute_script("replay.seek(arguments[0])", int(step))
        said = browser.find_element("css selector", ".status").text
        assert said.startswith(f"{there} of 2 within their targets"), (step, said)
