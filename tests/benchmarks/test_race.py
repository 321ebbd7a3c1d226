"""Checks the settings that Brax gets in the race, and that the judge runs Brax's policy."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import steering

from benchmarks import race
from benchmarks.race import RaceConfig
from swarmjax import policy
from swarmjax.evaluate import trained_settings
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.evaluation import evaluate
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import PPO
from swarmjax.run.settings import TrainConfig
from swarmjax.task.observation import SIZE
from tests.sentences import refusal

SEEN = np.random.default_rng(0).normal(0.2, 0.5, (6, SIZE)).astype(np.float32)


def test_brax_is_given_our_numbers(tiny_config: TrainConfig) -> None:
    found = race.brax_settings(RaceConfig(points=4), tiny_config)
    # The budget has 20 updates, judged every 5 updates. An update has 8 arenas of 3 robots each,
    # and 8 control steps.
    assert found["num_timesteps"] == 20 * 24 * 8
    assert (found["num_envs"], found["batch_size"], found["num_minibatches"]) == (24, 12, 2)
    assert (found["unroll_length"], found["num_updates_per_batch"]) == (8, 2)
    assert (found["discounting"], found["learning_rate"]) == (tiny_config.algo.discount, 3e-4)
    assert race.points(RaceConfig(points=6), tiny_config).tolist() == [3, 6, 9, 12, 15, 18]


def test_brax_is_given_playgrounds_numbers(tiny_config: TrainConfig) -> None:
    words = RaceConfig(points=4, settings="playground")
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
            ["algo.policy=independent"],
            "algo.policy is independent, and Brax has only shared: give that.",
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


def _begin_brax(race_config: RaceConfig, trained: TrainConfig) -> tuple[Any, Any, Any]:
    """Returns the parameters that Brax begins with: moments of some observations, and networks."""
    from brax.training.acme import running_statistics

    made = race.network_factory(race_config, trained)(SIZE, 2)
    empty = running_statistics.init_state(jnp.zeros(SIZE))
    moments = running_statistics.update(empty, jnp.asarray(SEEN))
    keys = jax.random.split(jax.random.key(1))
    return moments, made.policy_network.init(keys[0]), made.value_network.init(keys[1])


@pytest.mark.parametrize("settings", ["ours", "bounded", "playground"])
def test_the_judge_takes_the_mean_action_of_the_policy(
    tiny_config: TrainConfig, settings: Any
) -> None:
    chosen = RaceConfig(settings=settings)
    moments, policy, critic = _begin_brax(chosen, tiny_config)
    found = race.act_brax(chosen, tiny_config, SIZE)((moments, policy, critic), jnp.asarray(SEEN))
    layers = policy["params"]
    torso = dict(layers["MLP_0"] if settings == "ours" else layers)
    head = layers["Dense_0"] if settings == "ours" else torso.pop(f"hidden_{len(torso) - 1}")
    x = (SEEN - np.mean(SEEN, axis=0)) / np.std(SEEN, axis=0)
    for i in range(len(torso)):
        x = x @ torso[f"hidden_{i}"]["kernel"] + torso[f"hidden_{i}"]["bias"]
        x = x / (1 + np.exp(-x)) if settings == "playground" else np.tanh(x)
    mean = (x @ head["kernel"] + head["bias"])[:, :2]
    expected = mean if settings == "ours" else np.tanh(mean)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)  # rounding of float32


def test_brax_begins_with_our_spread_of_actions(tiny_config: TrainConfig) -> None:
    _, policy, _ = _begin_brax(RaceConfig(), tiny_config)
    std = np.exp(policy["params"]["std_logparam"]["log_value"])
    np.testing.assert_allclose(std, 0.6, rtol=1e-6)


def _gains(params: Any) -> list[list[float]]:
    kernels = [leaf for leaf in jax.tree.leaves(params) if leaf.ndim == 2]
    found = (np.linalg.svd(kernel, compute_uv=False).round(5) for kernel in kernels)
    return sorted(gain.tolist() for gain in found)


@pytest.mark.parametrize(("settings", "heads"), [("ours", [0.01] * 2), ("bounded", [0.01] * 4)])
def test_brax_begins_with_networks_like_ours(
    tiny_config: TrainConfig, settings: Any, heads: list[float]
) -> None:
    _, actor, critic = _begin_brax(RaceConfig(settings=settings), tiny_config)
    mine = PPO.make(tiny_config.algo, Sizes(SIZE, 2), 1).init(jax.random.key(0)).params
    assert _gains(critic) == _gains(mine["critic"])
    assert _gains(critic)[0] == pytest.approx([0.01])
    assert _gains(actor)[1:] == _gains(mine["actor"])[1:]
    assert _gains(actor)[0] == pytest.approx(heads)  # bounded: means and standard deviations


def test_the_judge_counts_what_mujoco_c_counts(tmp_path: Path) -> None:
    levels, steps = 40, 120  # few enough steps that some robots are late
    path = steering.write(tmp_path / "policy.npz")
    trained = policy.load(path)
    _, config = race.parse(["stage=s3", "sim.max_robots=3", f"task.step_limit={steps}"])

    def act(_: Any, seen: jax.Array) -> jax.Array:
        return policy.step(trained, None, seen, 0.0, jnp)[1]

    share = race.load_judge(RaceConfig(levels=levels), config, act)(())
    words = f"stage=s3 robot=planar robot.hull_friction=0 episodes={levels} steps={steps}".split()
    words += [f"policy={path}", "seed=2", "action=mean", "workers=1"]
    settings, _ = trained_settings.load(EvaluateConfig, words)
    (trial,) = evaluate(settings).trials
    assert 0.1 < share < 0.9
    # A contact may end differently for one robot of the 120.
    assert share == pytest.approx(np.mean(trial.measures["targets_reached"]), abs=1.01 / 120)


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
    asked = RaceConfig(points=4)
    course = race.run_ours(asked, tiny_config)
    np.testing.assert_array_equal(course.share, course.transitions)
    # 20 updates in 4 parts, each of 8 arenas with 8 control steps.
    np.testing.assert_array_equal(course.arena_steps, [320, 640, 960, 1280])
    assert (np.diff(course.train_s, prepend=0.0) > 0.0).all()
    assert course.transitions[-1] <= 3 * course.arena_steps[-1]
