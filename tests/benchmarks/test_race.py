"""Checks the settings that Brax gets in the race, and that the judge runs Brax's policy."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import race
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import PPO
from swarmjax.run.settings import TrainConfig
from swarmjax.task.observation import SIZE
from tests.sentences import refusal


def test_brax_is_given_our_numbers(tiny_config: TrainConfig) -> None:
    found = race.brax_settings(race.RaceConfig(points=4), tiny_config)
    # The budget has 20 updates, judged every 5 updates. An update has 8 arenas of 3 robots each,
    # and 8 control steps.
    assert found["num_timesteps"] == 20 * 24 * 8
    assert (found["num_envs"], found["batch_size"], found["num_minibatches"]) == (24, 12, 2)
    assert (found["unroll_length"], found["num_updates_per_batch"]) == (8, 2)
    assert (found["discounting"], found["learning_rate"]) == (tiny_config.algo.discount, 3e-4)
    assert race.points(race.RaceConfig(points=6), tiny_config).tolist() == [3, 6, 9, 12, 15, 18]


def test_brax_is_given_playgrounds_numbers(tiny_config: TrainConfig) -> None:
    words = race.RaceConfig(points=4, settings="playground")
    larger = dataclasses.replace(tiny_config, arenas=32, budget=32 * 8 * 20)
    found = race.brax_settings(words, larger)
    # 20 updates of 8 control steps are 8 updates of 20 control steps, judged every 2 updates. There
    # are 32 arenas of 3 robots each.
    assert found["num_timesteps"] == 8 * 96 * 20
    assert (found["num_envs"], found["batch_size"], found["num_minibatches"]) == (96, 3, 32)
    assert (found["discounting"], found["learning_rate"]) == (0.97, 3e-4)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["trainer=brax", "settings=playground", "arenas=40"],
            "arenas is 40, which makes 200 robots: settings=playground needs a multiple of 32 "
            "robots.",
        ),
        # 32 updates of 8 control steps are 12 updates of 20 control steps.
        (
            [
                "trainer=brax",
                "settings=playground",
                "arenas=32",
                "algo.rollout_length=8",
                "budget=8192",
            ],
            "points is 30, but the budget is 12 updates: give at most 12.",
        ),
        (
            ["arenas=40", "budget=12800"],
            "points is 30, but the budget is 10 updates: give at most 10.",
        ),
        (
            ["stage=s1"],
            "sim.max_robots is 5, but stage s1 has 2 robots, and Brax does not support "
            "absent ones: give sim.max_robots=2.",
        ),
    ],
)
def test_a_race_that_cannot_be_run_is_refused(words: list[str], sentence: str) -> None:
    assert refusal(race.parse, words) == sentence


def test_the_judge_sees_the_policy_that_brax_trained(tiny_config: TrainConfig) -> None:
    from brax.training.acme import running_statistics
    from brax.training.agents.ppo import networks

    made = race.network_factory(tiny_config)(
        SIZE, 2, preprocess_observations_fn=running_statistics.normalize
    )
    random = np.random.default_rng(0)
    seen = random.normal(0.2, 0.5, (6, SIZE)).astype(np.float32)
    empty = running_statistics.init_state(jnp.zeros(SIZE))
    moments = running_statistics.update(empty, jnp.asarray(seen))
    keys = jax.random.split(jax.random.key(1))
    params = (moments, made.policy_network.init(keys[0]), made.value_network.init(keys[1]))
    policy = networks.make_inference_fn(made)(params, deterministic=True)
    theirs, _ = policy(seen, jax.random.key(2))
    learners = race.as_learners(tiny_config, params)
    ppo = PPO.make(tiny_config.algo, Sizes(seen.shape[-1], 2), 1)
    still = jnp.zeros((*seen.shape[:-1], 2))
    mine, _, _ = ppo.act(jax.tree.map(lambda x: x[0, 0], learners), seen, still)
    np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-7)  # rounding of float32
    std = np.exp(learners.params["actor"]["log_std"])
    np.testing.assert_allclose(std, 0.6, rtol=1e-6)


def test_brax_begins_with_a_critic_like_ours(tiny_config: TrainConfig) -> None:
    theirs = race.network_factory(tiny_config)(SIZE, 2).value_network.init(jax.random.key(0))
    mine = PPO.make(tiny_config.algo, Sizes(SIZE, 2), 1).init(jax.random.key(0)).params["critic"]

    def gains(params: Any) -> list[list[float]]:
        kernels = [leaf for leaf in jax.tree.leaves(params) if leaf.ndim == 2]
        found = (np.linalg.svd(kernel, compute_uv=False).round(5) for kernel in kernels)
        return sorted(gain.tolist() for gain in found)

    assert gains(theirs) == gains(mine)
    assert gains(mine)[0] == pytest.approx([0.01])


def test_seconds_to_a_share() -> None:
    course = race.Course(
        train_s=np.array([1.0, 2.0, 3.0]),
        share=np.array([0.5, 0.9, 0.94]),
        transitions=np.array([10.0, 20.0, 30.0]),
        arena_steps=np.array([2.0, 4.0, 6.0]),
        compile_s=0.0,
    )
    assert race.seconds_to(course) == {"seconds_to_0.90": 2.0, "seconds_to_0.95": None}


@pytest.mark.slow
def test_our_course_has_a_point_for_each_judgement(
    tiny_config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stand-in for the judge returns how many transitions the normaliser has seen."""
    monkeypatch.setattr(
        race, "load_judge", lambda *_: lambda learners: float(learners.normalizer.count[0, 0])
    )
    asked = race.RaceConfig(points=4)
    course = race.run_ours(asked, tiny_config)
    np.testing.assert_array_equal(course.share, course.transitions)
    # 20 updates in 4 parts, each of 8 arenas with 8 control steps.
    np.testing.assert_array_equal(course.arena_steps, [320, 640, 960, 1280])
    assert (np.diff(course.train_s, prepend=0.0) > 0.0).all()
    assert course.transitions[-1] <= 3 * course.arena_steps[-1]
