"""Tests hearing in both judges: hidden robots, observations, and policy files that do not fit."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import policies
import pytest
from sentences import refusal

from benchmarks import learners_judge
from swarmjax import policy_file
from swarmjax.config import ConfigError
from swarmjax.evaluate import engine_c, engine_mjx, rays
from swarmjax.evaluate import judge as evaluate_judge
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.trained_settings import load as load_as_trained
from swarmjax.policy import Policy
from swarmjax.run.load_settings import load_train
from swarmjax.run.policy_export import policy_meta
from swarmjax.sim import physics
from swarmjax.sim.config import RobotConfig
from swarmjax.sim.realism_config import RealismConfig
from swarmjax.task import env, hearing
from swarmjax.task.stage_config import StageConfig

WORDS = ["stage=s3", "task.neighbours.count=2"]
STAGE = StageConfig(name="boxes", robots=4, side=1.4, obstacles=4, obstacle_size=0.2)


def _policy(path: Path, words: list[str] = WORDS, kind: str = "none") -> str:
    """Writes a policy that was trained with these words."""
    config = load_train(words)
    meta = policy_meta(config, update=1, seed=0)
    heard = config.task.neighbours
    arrays = policies.arrays()
    if heard.count:
        arrays, _ = policies.hearing(arrays, heard.count)
    if kind == "gru":
        arrays, meta = policies.recalling(arrays, 5, **meta)
    policies.saved(path, arrays, **meta)
    return str(path)


def _judge(path: Path, kind: str = "none", **rest: Any) -> evaluate_judge.Judge:
    policy = _policy(path, kind=kind)
    given = {"robot": RobotConfig(), "stage": STAGE, "workers": 1} | rest
    config = EvaluateConfig(policy=policy, **given)
    return evaluate_judge.load(config, policy_file.read(policy))


def test_mujoco_and_geometry_agree_on_who_is_hidden(tmp_path: Path) -> None:
    judge = _judge(tmp_path / "policy.npz")
    levels = [evaluate_judge.draw_level(judge.stage, judge.spacing, 1, i) for i in range(200)]
    arenas = engine_c.start(judge, levels)
    found = rays.hidden(judge.scene, arenas.data, arenas.pose, arenas.obstacle, 9.0)
    expected = hearing.hidden(jnp.asarray(arenas.pose), jnp.asarray(arenas.obstacle), jnp)
    np.testing.assert_array_equal(found, np.asarray(expected))
    assert 0.1 < found.mean() < 0.9


@pytest.mark.parametrize("kind", [pytest.param("ideal", marks=pytest.mark.slow), "real"])
def test_both_engines_observe_the_same_neighbours_step_by_step(kind: str, tmp_path: Path) -> None:
    noise: dict[str, Any] = {"packet_loss": 0.4}
    realism = RealismConfig(**(noise if kind == "real" else {}))
    judge = _judge(tmp_path / "policy.npz", realism=realism)
    task = load_train(WORDS).task
    world = env.load([STAGE], RobotConfig(), task, realism)
    level = evaluate_judge.draw_level(judge.stage, judge.spacing, 1, 3)
    arenas = engine_c.start(judge, [level])
    assert world.spacing.robots >= STAGE.robots
    level = learners_judge._make_room(level, world.spacing)
    state = jax.jit(partial(env.reset, world))(jax.tree.map(jnp.asarray, level))
    state = state.replace(sim=physics.unpack(world.physics, state.sim))
    step = jax.jit(partial(env.step, world))
    draw, heard = np.random.default_rng(0), 0
    for _ in range(20):
        mine = np.asarray(state.observation)[: STAGE.robots, 10:]
        np.testing.assert_allclose(mine, arenas.observation[0, :, 10:], atol=1e-4)
        heard += (mine[:, ::4] > 0).sum()
        action = draw.uniform(-1.2, 1.2, (1, STAGE.robots, 2)).astype(np.float32)
        padded = np.zeros((len(level.present), 2), np.float32)
        padded[: STAGE.robots] = action[0]
        state, _ = step(state, jnp.asarray(padded))
        arenas = engine_c.step(judge, arenas, action)
    assert 20 < heard < 20 * 8


@pytest.mark.parametrize("kind", ["none", "gru"])
@pytest.mark.slow
def test_both_engines_come_to_the_same_by_a_policy_that_hears(kind: str, tmp_path: Path) -> None:
    judge = _judge(tmp_path / "policy.npz", kind, steps=10, action="sampled")
    levels = [evaluate_judge.draw_level(judge.stage, judge.spacing, 1, i) for i in range(8)]
    by_c = engine_c.simulate(judge, levels)
    world = engine_mjx.load(judge.config, levels[0].obstacle[:, 3:], 8)
    stacked = type(levels[0])(*map(np.stack, zip(*levels, strict=True)))
    by_mjx = engine_mjx.play(world, stacked, judge.policy, 10, sampled=True)
    np.testing.assert_allclose(by_mjx.path, by_c.path, atol=1e-4)  # m; paths are 1 to 40 mm long
    deaf = judge.policy._replace(hearing=tuple(0 * part for part in judge.policy.hearing or ()))
    unheard = engine_c.simulate(_with(judge, deaf), levels)
    assert np.abs(unheard.path - by_c.path).max() > 5e-4  # m; five times the tolerance above


def _with(judge: evaluate_judge.Judge, trained: Policy) -> evaluate_judge.Judge:
    return evaluate_judge.load(judge.config, trained)


def test_a_policy_is_judged_with_the_hearing_that_it_has(tmp_path: Path) -> None:
    path = _policy(tmp_path / "hears.npz")
    settings, _ = load_as_trained(EvaluateConfig, [f"policy={path}"])
    assert settings.task.neighbours.count == 2


@pytest.mark.parametrize(
    ("key", "value", "held"),
    [("count", 3, 2), ("range", 0.5, 0.7)],
)
def test_another_hearing_is_refused(key: str, value: float, held: float, tmp_path: Path) -> None:
    path = _policy(tmp_path / "hears.npz")
    sentence = refusal(
        lambda *words: load_as_trained(EvaluateConfig, words),
        f"policy={path}",
        f"task.neighbours.{key}={value}",
    )
    assert sentence == (
        f"task.neighbours.{key} is {value}, but {path} was trained with {held}: leave "
        f"task.neighbours.{key} out, since each policy is judged with the value that it was "
        "trained with."
    )


def test_a_policy_that_does_not_hear_is_not_made_to(tmp_path: Path) -> None:
    path = _policy(tmp_path / "deaf.npz", ["stage=s3"])
    with pytest.raises(ConfigError, match=r"task\.neighbours\.count is 2, but .* trained with 0"):
        load_as_trained(EvaluateConfig, [f"policy={path}", "task.neighbours.count=2"])


def test_policies_that_hear_and_do_not_are_compared_each_with_its_own(tmp_path: Path) -> None:
    first, second = _policy(tmp_path / "a.npz"), _policy(tmp_path / "b.npz", ["stage=s3"])
    settings, _ = load_as_trained(EvaluateConfig, [f"compare={first},{second}"])
    assert settings.task.neighbours.count == 2
