"""Tests the contract of Stable-Baselines3's vector environments.

Stable-Baselines3 has a checker for single environments only.
"""

import gymnasium
import numpy as np
import pytest
from courses import ARENAS, SEED, Course, assert_close, robots

from swarmjax.environment import Swarm

pytestmark = pytest.mark.torch
vec_env = pytest.importorskip("stable_baselines3.common.vec_env")
ppo = pytest.importorskip("stable_baselines3.ppo")
sb3 = pytest.importorskip("swarmjax.adapters.sb3", exc_type=ImportError)


@pytest.fixture(scope="module")
def env(swarm: Swarm):
    return sb3.SwarmVecEnv(swarm)


@pytest.fixture(scope="module")
def steps(env, course: Course) -> list[tuple]:
    env.seed(SEED)
    env.reset()
    return [env.step(robots(action)) for action in course.action]


def test_shapes_and_dtypes(env) -> None:
    assert isinstance(env, vec_env.VecEnv)
    assert env.num_envs == 6
    assert (env.observation_space.shape, env.action_space.shape) == ((10,), (2,))
    assert env.get_attr("arena", [0, 5])[1].tolist() == ARENAS.tolist()
    assert env.env_is_wrapped(object) == [False] * 6
    seen = env.reset()
    assert (seen.shape, seen.dtype) == ((6, 10), np.float32)
    seen, reward, done, infos = env.step(np.zeros((6, 2), np.float32))
    assert (seen.shape, reward.shape, done.shape, len(infos)) == ((6, 10), (6,), (6,), 6)
    assert (seen.dtype, reward.dtype, done.dtype) == (np.float32, np.float32, np.bool_)


def test_it_follows_the_course(steps: list, course: Course) -> None:
    for t, (seen, reward, done, _) in enumerate(steps):
        assert_close(seen, robots(course.after[t]))
        assert_close(reward, robots(course.came.reward[t]))
        np.testing.assert_array_equal(done, course.came.done[t][ARENAS])


def test_infos_tell_the_last_observation_and_who_was_late(steps: list, course: Course) -> None:
    for t, (*_, done, infos) in enumerate(steps):
        last, late = robots(course.came.observation[t]), robots(course.came.truncated[t])
        for i, info in enumerate(infos):
            assert set(info) == (
                {"TimeLimit.truncated", "terminal_observation", "is_success"} if done[i] else set()
            )
            if done[i]:
                assert_close(info["terminal_observation"], last[i])
                assert info["TimeLimit.truncated"] == late[i]
                assert info["is_success"] is not bool(late[i])


def test_seeds_reproduce(env) -> None:
    env.seed(3)
    first, again = env.reset(), env.reset()
    env.seed(3)
    np.testing.assert_array_equal(env.reset(), first)
    np.testing.assert_array_equal(env.reset(), again)
    assert (first != again).any()


def test_its_monitor_and_its_ppo_take_it(env) -> None:
    monitored = vec_env.VecMonitor(env)
    model = ppo.PPO("MlpPolicy", monitored, n_steps=96, batch_size=96, n_epochs=1, device="cpu")
    model.learn(96 * 6)
    assert len(model.ep_info_buffer) >= 6  # the time limit is 80 steps
    assert max(info["l"] for info in model.ep_info_buffer) == 80
    assert set(model.ep_success_buffer) <= {False, True}
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer)


@pytest.mark.parametrize(
    ("action", "sentence"),
    [
        (np.zeros((5, 2), np.float32), r"^action has the shape \(5, 2\): give \(6, 2\)"),
        (np.zeros((6, 2), np.int64), r"^action is of dtype int64: give float32"),
    ],
)
def test_a_wrong_action_is_an_invalid_one(env, action: np.ndarray, sentence: str) -> None:
    env.reset()
    with pytest.raises(gymnasium.error.InvalidAction, match=sentence):
        env.step(action)


def test_steps_come_in_order(swarm: Swarm) -> None:
    made = sb3.SwarmVecEnv(swarm)
    with pytest.raises(gymnasium.error.ResetNeeded):
        made.step(np.zeros((6, 2), np.float32))
    with pytest.raises(gymnasium.error.NoAsyncCallError):
        made.step_wait()
    made.close()
    with pytest.raises(gymnasium.error.ResetNeeded):
        made.step(np.zeros((6, 2), np.float32))


def test_nothing_can_be_set_or_called(env) -> None:
    with pytest.raises(AttributeError, match=r"^task cannot be set"):
        env.set_attr("task", 1)
    with pytest.raises(AttributeError, match=r"^jump cannot be called"):
        env.env_method("jump")
