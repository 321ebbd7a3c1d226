"""Checks that the MuJoCo C arena for other trainers matches the judge, and its rewards the task."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import steering
from entries import INFRARED
from sentences import refusal

from benchmarks import mujoco_arena, peer_paper_way
from benchmarks.mujoco_arena import MujocoArena
from swarmjax import policy
from swarmjax.evaluate import engine_c
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.task import observation, reward

STEPS = 150


@pytest.fixture(scope="module")
def settings() -> EvaluateConfig:
    return mujoco_arena.load_settings(["robot=planar", "stage=s4", f"steps={STEPS}", "seed=3"])


def test_an_arena_does_what_the_judge_does(settings: EvaluateConfig, tmp_path: Path) -> None:
    trained = policy.load(steering.write(tmp_path / "p.npz"))
    judge = engine_c.load(settings, trained)
    levels = [engine_c.draw_level(judge.stage, judge.spacing, 3, n) for n in range(2)]
    judged = engine_c.simulate(judge, levels)
    arena = MujocoArena(settings)
    for n in range(2):
        seen, over, steps = arena.reset(), False, 0
        while not over:
            moved = arena.step(policy.act(trained, seen))
            seen, over, steps = moved.observation, moved.over, steps + 1
        assert arena.arenas is not None
        came = arena.arenas.outcome
        assert steps == came.clock[0] == judged.clock[n]
        np.testing.assert_array_equal(came.arrived[0], judged.arrived[n])
        np.testing.assert_array_equal(came.path[0], judged.path[n])


def test_rewards_are_those_of_the_task(settings: EvaluateConfig) -> None:
    weights = replace(settings.task.reward, proximity=-0.5, contact=-0.25, step_penalty=-0.125)
    arena = MujocoArena(replace(settings, task=replace(settings.task, reward=weights)))
    arena.reset()
    random, touched, near = np.random.default_rng(0), 0, 0
    for _ in range(STEPS):
        before = arena.arenas
        assert before is not None
        moved = arena.step(random.uniform([0.5, -0.2], [1.0, 0.2], (len(before.pose[0]), 2)))
        after = arena.arenas
        assert after is not None
        start, end = (observation.to_target(x.pose, x.target, np)[0][0] for x in (before, after))
        active = ~before.outcome.arrived[0]
        begun = (after.outcome.contacts - before.outcome.contacts)[0]
        rays = after.observation[0, :, INFRARED]  # ideal sensors give metres
        arrives = after.outcome.arrived[0] & active
        step = reward.Step(start, end, rays, 0.04, arrives, begun, begun > 0, active)
        expected = np.where(active, reward.total(step, weights), 0.0)
        # The arena computes in float64, and the expected reward is in float32. A ray that is
        # exactly as long as its range may be rounded either way.
        np.testing.assert_allclose(moved.reward, expected, rtol=0.0, atol=1e-6)
        touched, near = touched + begun.sum(), near + (rays < 0.04).any(axis=-1).sum()
        if moved.over:
            break
    assert touched > 0
    assert near > 0


@pytest.mark.parametrize("term", ["arrival", "path_progress"])
def test_a_reward_that_it_does_not_know_is_refused(settings: EvaluateConfig, term: str) -> None:
    task = replace(settings.task, reward=replace(settings.task.reward, **{term: 1.0}))
    assert (
        refusal(MujocoArena, replace(settings, task=task)) == f"task.reward.{term} is 1.0: give 0."
    )


def test_a_rule_of_arrival_that_it_does_not_know_is_refused(settings: EvaluateConfig) -> None:
    task = replace(settings.task, arrival="hold")
    assert refusal(MujocoArena, replace(settings, task=task)) == "task.arrival is hold: give latch."


def test_returns_end_with_their_episodes() -> None:
    # An episode ends at the second reward, so the first return is 1 + 2 / 2. The last three rewards
    # belong to the next episode, and each later reward is halved once per step.
    found = peer_paper_way.discounted([1, 2, 3, 4, 5], [False, True, False, False, False], 0.5)
    np.testing.assert_array_equal(found, [2.0, 2.0, 6.25, 6.5, 5.0])


def test_the_first_call_is_a_warm_up() -> None:
    numbers: list[int] = []
    assert len(peer_paper_way.timed(numbers.append, 1e-9)) == len(numbers) - 1
    assert numbers[:2] == [0, 1]
