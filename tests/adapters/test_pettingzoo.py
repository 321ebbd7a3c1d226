"""Runs PettingZoo's own checker, and tests what the checker does not cover."""

import warnings

import gymnasium
import numpy as np
import pytest
from courses import ARENA_SEED, LIMIT, Course, assert_close
from pettingzoo.test import parallel_api_test

from swarmjax.adapters.pettingzoo import SwarmParallelEnv
from swarmjax.environment import Swarm

AGENTS = ["robot_0", "robot_1"]


@pytest.fixture(scope="module")
def env(arena: Swarm) -> SwarmParallelEnv:
    return SwarmParallelEnv(arena)


@pytest.fixture(scope="module")
def steps(env: SwarmParallelEnv, arena_course: Course) -> list[tuple]:
    """Returns the acting agents and the outcome of each step, until no agent is left.

    Agents that have left still receive actions.
    """
    env.reset(seed=ARENA_SEED)
    found, told = [], iter(arena_course.action)
    while env.agents:
        acting = env.agents
        actions = dict(zip(AGENTS, next(told)[0], strict=True))
        found.append((acting, *env.step(actions)))
    return found


@pytest.mark.slow
def test_the_checker_passes(env: SwarmParallelEnv, capsys: pytest.CaptureFixture[str]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the checker reports many faults only as warnings
        parallel_api_test(env, num_cycles=LIMIT + 5)
    assert "Passed" in capsys.readouterr().out


def test_who_arrives_leaves(steps: list, arena_course: Course) -> None:
    arrived = int(np.argmax(arena_course.came.terminated[:, 0, 0]))
    assert arrived == 42  # see courses.py
    acting = [step[0] for step in steps]
    assert acting == [AGENTS] * 43 + [["robot_1"]] * (LIMIT - 43)
    *_, terminated, truncated, infos = steps[42]
    assert terminated == {"robot_0": True, "robot_1": False}
    assert truncated == {"robot_0": False, "robot_1": False}
    assert infos == {"robot_0": {"is_success": True}, "robot_1": {}}


def test_who_is_late_is_truncated(steps: list) -> None:
    *_, terminated, truncated, infos = steps[-1]
    assert (terminated, truncated) == ({"robot_1": False}, {"robot_1": True})
    assert infos == {"robot_1": {"is_success": False}}


def test_observations_and_rewards_are_those_of_the_course(
    steps: list, arena_course: Course
) -> None:
    came = arena_course.came
    for t, (acting, seen, reward, *_) in enumerate(steps):
        assert list(seen) == list(reward) == acting
        for agent in acting:
            i = AGENTS.index(agent)
            assert_close(seen[agent], came.observation[t, 0, i])
            assert_close(reward[agent], came.reward[t, 0, i])


def test_seeds_reproduce(env: SwarmParallelEnv) -> None:
    first, again = env.reset(seed=3)[0], env.reset()[0]
    np.testing.assert_equal(env.reset(seed=3)[0], first)
    np.testing.assert_equal(env.reset()[0], again)
    assert (first["robot_0"] != again["robot_0"]).any()
    assert first["robot_0"] in env.observation_space("robot_0")


@pytest.mark.parametrize(
    ("actions", "sentence"),
    [
        (
            {"robot_0": np.zeros(2, np.float32)},
            "actions are missing or not expected for ['robot_1'].",
        ),
        (
            dict.fromkeys([*AGENTS, "robot_2"], np.zeros(2, np.float32)),
            "actions are missing or not expected for ['robot_2'].",
        ),
        (
            dict.fromkeys(AGENTS, np.zeros(3, np.float32)),
            "robot_0: action has the shape (3,): give (2,), speed and turn rate.",
        ),
        (
            dict.fromkeys(AGENTS, np.zeros(2, np.int64)),
            "robot_0: action is of dtype int64: give float32, -1 to 1.",
        ),
    ],
)
def test_wrong_actions_are_invalid(env: SwarmParallelEnv, actions: dict, sentence: str) -> None:
    env.reset(seed=0)
    with pytest.raises(gymnasium.error.InvalidAction) as caught:
        env.step(actions)
    assert str(caught.value) == sentence


def test_step_needs_a_reset_and_an_open_environment(arena: Swarm) -> None:
    made = SwarmParallelEnv(arena)
    with pytest.raises(gymnasium.error.ResetNeeded):
        made.step({})
    made.close()
    with pytest.raises(gymnasium.error.ResetNeeded):
        made.step({})
