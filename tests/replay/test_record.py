"""Tests that recordings match what the judge simulates, and rewards match those of training."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import replays
import steering
from sentences import refusal

from swarmjax import policy_file
from swarmjax.evaluate import cells, engine_c
from swarmjax.replay import record as replay_record
from swarmjax.replay.config import ReplayConfig
from swarmjax.sim import infrared
from swarmjax.task import geodesic
from swarmjax.task.config import RewardConfig, TaskConfig
from swarmjax.task.stage_files import load_levels

WEIGHTS = RewardConfig(
    progress=2.0,
    path_progress=1.5,
    proximity=-0.01,
    arrival=0.5,
    contact=-0.3,
    touching=-0.25,
    step_penalty=-1e-4,
)


@pytest.fixture(scope="module")
def steer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return steering.write(tmp_path_factory.mktemp("replay") / "steer.npz")


def test_weights_are_those_of_training(tmp_path):
    stored = {"task": {"reward": {"contact": -0.02}}}
    path = steering.write(tmp_path / "a.npz")
    trained = policy_file.read(path)
    own = TaskConfig(reward=WEIGHTS)
    assert replay_record.weights(trained, own) == WEIGHTS  # the policy stores no weights
    trained.meta["config"] = stored
    assert replay_record.weights(trained, own) == RewardConfig(contact=-0.02)
    stored["task"]["reward"] = {"contacts": 1.0}
    sentence = refusal(replay_record.weights, trained, own)
    assert sentence.startswith("the policy's config.task.reward.contacts is not a key")


def test_a_recording_is_what_the_judge_saw(steer):
    words = [*replays.SMALL, "level=0,3", "steps=200", "realism=real"]
    judge, found = replays.recorded(steer, *words)
    settings = load_levels(ReplayConfig, [f"policy={steer}", *words])
    levels = cells.split(cells.draw_stage(settings.evaluation, settings.levels).levels)
    for level, recording in zip(levels, found, strict=True):
        alone = engine_c.simulate(judge, [level])
        assert len(recording.pose) == alone.clock[0] + 1
        np.testing.assert_array_equal(recording.arrival, alone.arrival[0])
        np.testing.assert_array_equal(recording.contacts[-1], alone.contacts[0])
        np.testing.assert_array_equal(
            (recording.ray[1:] < 0.04).any(axis=-1)[:, alone.arrival[0] == 0].sum(axis=0),
            alone.sensed[0][alone.arrival[0] == 0],
        )
        np.testing.assert_allclose(recording.pose[0], level.start, atol=1e-6)  # of float32
        away = np.linalg.norm(recording.pose[..., :2] - level.target, axis=-1)
        np.testing.assert_allclose(recording.distance, away, atol=1e-9)  # of float64
        np.testing.assert_array_equal(
            recording.scene.box, level.obstacle[level.obstacle_present].astype(float)
        )
    # Each episode has its own sensor directions, and the recording holds them.
    _, nominal = infrared.rays(np.zeros(3), np)
    off = found[0].scene.sensor[..., 2:] - nominal
    assert 0.0 < np.abs(off).max() < 0.2  # rad; 5 deviations of 2 degrees
    assert not np.array_equal(found[0].scene.sensor, found[1].scene.sensor)


def test_rewards_are_those_of_the_steps(steer):
    _, (recording,) = replays.recorded(
        steer, *replays.SMALL, "level=2", "steps=300", "task.reward.proximity=-0.001"
    )
    total = {name: term.sum(axis=0) for name, term in recording.reward.items()}
    robots = np.arange(3)
    end = np.where(recording.arrival > 0, recording.arrival, len(recording.pose) - 1)
    gained = recording.distance[0] - recording.distance[end, robots]
    np.testing.assert_allclose(total["progress"], gained, atol=1e-9)  # sums of 300 float64
    near = (recording.ray < 0.04).any(axis=-1)
    lit = [near[1 : end[i] + 1, i].sum() for i in robots]
    np.testing.assert_allclose(total["proximity"], -0.001 * np.array(lit), atol=1e-12)
    assert sum(lit) > 0
    assert (recording.arrival > 0).any()


def test_progress_along_paths_is_that_of_training(steer):
    judge, (recording,) = replays.recorded(
        steer, *replays.SMALL, "level=2", "steps=100", "task.reward.path_progress=2"
    )
    level = cells.split(cells.load(judge.config).cells[0].levels)[2]
    level = jax.tree.map(jnp.asarray, level)
    radius = judge.config.robot.hull_radius
    path = jax.jit(geodesic.begin, static_argnums=1)(level, radius)
    end = jax.jit(geodesic.go_on, static_argnums=3)(path, recording.pose[-1, :, :2], level, radius)
    np.testing.assert_allclose(
        recording.reward["path_progress"].sum(axis=0)[recording.arrival == 0],
        2.0 * (path.distance - end.distance)[recording.arrival == 0],
        atol=1e-5,  # sums of 100 float32
    )
    assert (recording.arrival == 0).any()


def test_a_recording_ends_when_all_have_arrived(steer):
    _, found = replays.recorded(steer, "stage.robots=1", "stage.obstacles=0", "level=0,1,2")
    for recording in found:
        assert recording.arrival.tolist() == [len(recording.pose) - 1]
        assert recording.distance[-1, 0] <= 0.05 < recording.distance[-2, 0]
    assert len({len(recording.pose) for recording in found}) == 3


def test_touching_is_seen_while_it_lasts(tmp_path):
    ahead = steering.write(tmp_path / "ahead.npz", steering.AHEAD)
    _, (recording,) = replays.recorded(
        ahead, "stage.robots=1", "stage.obstacles=0", "stage.side=0.5", "level=0", "steps=250"
    )
    assert recording.arrival[0] == 0
    first = int(recording.contacts[:, 0, 2].argmax())
    assert recording.touching[first, 0].tolist() == [False, False, True]  # a wall
    assert not recording.touching[first - 1].any()
    assert recording.contacts[-1, 0].tolist() == [0, 0, 1]
