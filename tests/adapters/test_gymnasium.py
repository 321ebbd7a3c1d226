"""Tests the contract of Gymnasium's vector environments, for which Gymnasium has no checker."""

import gymnasium
import numpy as np
import pytest
from courses import ARENAS, SEED, Course, assert_close, robots
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from swarmjax.adapters.gymnasium import SwarmVectorEnv
from swarmjax.environment import Swarm


@pytest.fixture(scope="module")
def envs(swarm: Swarm) -> SwarmVectorEnv:
    return SwarmVectorEnv(swarm)


@pytest.fixture(scope="module")
def steps(envs: SwarmVectorEnv, course: Course) -> list[tuple]:
    envs.reset(seed=SEED)
    return [envs.step(robots(action)) for action in course.action]


@pytest.fixture
def closed(swarm: Swarm) -> SwarmVectorEnv:
    made = SwarmVectorEnv(swarm)
    made.close()
    return made


@pytest.mark.slow
def test_what_comes_lies_in_the_spaces(envs: SwarmVectorEnv) -> None:
    assert isinstance(envs, gymnasium.vector.VectorEnv)
    assert envs.single_observation_space.shape == (10,)
    assert envs.single_action_space == gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    seen, info = envs.reset(seed=0)
    assert info == {}
    assert seen in envs.observation_space
    seen, reward, terminated, truncated, _ = envs.step(envs.action_space.sample())
    assert seen in envs.observation_space
    assert (reward.shape, terminated.shape, truncated.shape) == ((6,), (6,), (6,))
    dtypes = (reward.dtype, terminated.dtype, truncated.dtype)
    assert dtypes == (np.float64, np.bool_, np.bool_)


def test_observations_and_rewards_are_those_of_the_course(steps: list, course: Course) -> None:
    for (seen, reward, *_), after, then in zip(
        steps, course.after, course.came.reward, strict=True
    ):
        assert_close(seen, robots(after))
        assert_close(reward, robots(then))


def test_the_robots_of_an_arena_end_together(steps: list, course: Course) -> None:
    for (_, _, terminated, truncated, _), done, late in zip(
        steps, course.came.done, course.came.truncated, strict=True
    ):
        np.testing.assert_array_equal(terminated | truncated, done[ARENAS])
        np.testing.assert_array_equal(truncated, robots(late))


def test_a_robot_that_waits_earns_nothing_and_says_so(steps: list, course: Course) -> None:
    waits = ~np.array([step[4]["valid"] for step in steps])
    np.testing.assert_array_equal(~waits, [robots(valid) for valid in course.came.valid])
    assert not np.array([step[1] for step in steps])[waits].any()
    assert waits.any()


def test_the_last_observation_comes_with_the_first_of_the_next_episode(
    envs: SwarmVectorEnv, steps: list, course: Course
) -> None:
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    for (_, _, terminated, _, info), done, last in zip(
        steps, course.came.done, course.came.observation, strict=True
    ):
        over = done[ARENAS]
        assert ("final_obs" in info) == over.any()
        if over.any():
            np.testing.assert_array_equal(info["_final_obs"], over)
            np.testing.assert_array_equal(info["_final_info"], over)
            assert_close(np.stack(info["final_obs"][over]), robots(last)[over])
            np.testing.assert_array_equal(info["final_info"]["_is_success"], over)
            np.testing.assert_array_equal(info["final_info"]["is_success"], terminated)
            assert all(each is None for each in info["final_obs"][~over])


def test_seeds_reproduce(envs: SwarmVectorEnv) -> None:
    first, again = envs.reset(seed=3)[0], envs.reset()[0]
    np.testing.assert_array_equal(envs.reset(seed=3)[0], first)
    np.testing.assert_array_equal(envs.reset()[0], again)
    assert (first != again).any()
    assert (envs.reset(seed=4)[0] != first).any()


def test_what_was_returned_stays_as_it_was(envs: SwarmVectorEnv) -> None:
    seen, _ = envs.reset(seed=0)
    kept = seen.copy()
    later = envs.step(envs.action_space.sample())[0]
    later[:] = 0.0  # the array belongs to the caller
    np.testing.assert_array_equal(seen, kept)
    assert envs.step(envs.action_space.sample())[0].any()


def test_gymnasiums_wrappers_take_it(envs: SwarmVectorEnv, course: Course) -> None:
    wrapped = RecordEpisodeStatistics(envs)
    wrapped.reset(seed=SEED)
    ended = int(np.argmax(course.came.done[:, 1]))  # arena 1 has one robot, at index 2
    infos = [wrapped.step(robots(action))[4] for action in course.action[: ended + 1]]
    info = infos[-1]
    assert info["episode"]["l"][2] == ended + 1
    earned = course.came.reward[: ended + 1, 1, 0].sum()
    np.testing.assert_allclose(info["episode"]["r"][2], earned, rtol=1e-4)  # sums in float32


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        (np.zeros((5, 2), np.float32), r"^action has the shape \(5, 2\): give \(6, 2\)"),
        (np.zeros((6, 2), np.int64), r"^action is of dtype int64: give float32"),
    ],
)
def test_a_wrong_action_is_an_invalid_one(
    envs: SwarmVectorEnv, action: np.ndarray, sentence: str
) -> None:
    envs.reset(seed=0)
    with pytest.raises(gymnasium.error.InvalidAction, match=sentence):
        envs.step(action)


def test_step_needs_a_reset(swarm: Swarm) -> None:
    with pytest.raises(gymnasium.error.ResetNeeded):
        SwarmVectorEnv(swarm).step(np.zeros((6, 2), np.float32))


def test_a_closed_one_is_of_no_use(closed: SwarmVectorEnv) -> None:
    closed.close()  # a second close does nothing
    with pytest.raises(gymnasium.error.ResetNeeded):
        closed.step(np.zeros((6, 2), np.float32))
