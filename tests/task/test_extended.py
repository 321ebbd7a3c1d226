"""Tests what a user's extensions do in an arena, and how unfit extensions are refused."""

import dataclasses
from functools import partial
from pathlib import Path

import extensions
import holding
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sentences import refusal

from swarmjax import extension
from swarmjax.evaluate import judge
from swarmjax.sim import physics
from swarmjax.sim.config import SimConfig
from swarmjax.task import env, extended, level, observation
from swarmjax.task import stage as task_stage
from swarmjax.task import world as task_world
from swarmjax.task.config import Arrival, RewardConfig, TaskConfig
from swarmjax.task.stage_config import BUILT_IN, StageConfig
from swarmjax.task.world import World

RING = StageConfig(name="ring", robots=3, side=1.0, level="ring")
SIM = SimConfig(impl="jax", max_robots=4, max_obstacles=1)
WEIGHT = -0.25
_draw = jax.jit(extended.draw, static_argnums=(2, 3))


def _world(source: str, stages: tuple[StageConfig, ...] = (RING,), **task: object) -> World:
    return task_world.load(
        stages, task=TaskConfig(**task), sim=SIM, extensions=extension.load(source)
    )


@pytest.fixture(scope="module")
def world() -> World:
    reward = RewardConfig(progress=0.0, contact=0.0, step_penalty=0.0, extra={"turning": WEIGHT})
    return _world(str(extensions.OWN), reward=reward)


@pytest.fixture(scope="module")
def drawn(world: World) -> level.Level:
    uniforms = np.random.default_rng(3).random(level.uniform_count(world.spacing), np.float32)
    stage = task_stage.single(RING, world.drawings)
    return _draw(uniforms, stage, world.spacing, world.drawings)


def _step(world: World, drawn: level.Level, action: np.ndarray) -> tuple:
    state = jax.jit(env.reset, static_argnums=0)(world, drawn)
    begun = dataclasses.replace(state, sim=physics.unpack(world.physics, state.sim))
    return jax.jit(partial(env.step, world))(begun, action)


def test_an_observation_follows_the_built_in_ones(world: World, drawn: level.Level) -> None:
    names = world.electronics.layout.names
    assert (len(names), names[-1]) == (world.observation_size, "nearest_robot")
    place = np.array(drawn.start[:3, :2])
    apart = np.linalg.norm(place[:, None] - place[None], axis=-1) + 9.0 * np.eye(3)
    seen = jax.jit(env.reset, static_argnums=0)(world, drawn).observation[:3, -1]
    np.testing.assert_allclose(seen, apart.min(axis=1), atol=1e-6)  # float32


def test_a_term_has_its_weight(world: World, drawn: level.Level) -> None:
    action = np.zeros((4, 2), np.float32)
    action[:, 1] = [0.5, -1.0, 7.0, 1.0]  # 7.0 is clipped to 1; the last robot is absent
    came = _step(world, drawn, action)[1]
    np.testing.assert_allclose(came.reward, WEIGHT * np.array([0.25, 1.0, 1.0, 0.0]), rtol=1e-6)


def test_a_level_is_drawn_by_the_piece_and_the_rest_is_parked(drawn: level.Level) -> None:
    radius = np.linalg.norm(drawn.start[:3, :2], axis=-1)
    np.testing.assert_allclose(radius, 0.35, rtol=1e-6)  # float32
    np.testing.assert_allclose(drawn.target[:3], -np.array(drawn.start[:3, :2]), atol=1e-6)
    assert not np.any(drawn.obstacle_present)
    assert np.all(np.abs(drawn.start[3, :2]) > 1.0)


def test_the_judge_draws_the_same_level(world: World) -> None:
    stage = task_stage.single(RING, world.drawings)
    theirs = judge.draw_level(stage, world.spacing, 5, 2, world.drawings)
    uniforms = np.random.default_rng([5, 2]).random(level.uniform_count(world.spacing), np.float32)
    mine = _draw(uniforms, stage, world.spacing, world.drawings)
    for one, other in zip(theirs, mine, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)  # XLA's fusion changes the rounding


def test_other_stages_are_drawn_as_without_the_piece(world: World) -> None:
    plain = StageConfig(name="plain", robots=3, side=1.0)
    stages = task_stage.stack([RING, plain], world.drawings)
    uniforms = np.random.default_rng(4).random(level.uniform_count(world.spacing), np.float32)
    found = extended.draw(uniforms, task_stage.select(stages, 1), world.spacing, world.drawings)
    expected = level.sample(uniforms, task_stage.select(stages, 1), world.spacing, jnp)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_term_of_weight_0_is_not_computed() -> None:
    found = _world(str(extensions.OWN), reward=RewardConfig(extra={"turning": 0.0}))
    assert found.terms == ()


def test_observations_may_be_left_out() -> None:
    assert _world(str(extensions.OWN), observations=()).observation_size == observation.SIZE


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ("@observation(size=2)\ndef a(view): return view.distance",
         "observation a returns float32 of shape [4]: return float numbers of shape [4, 2]."),
        ("@observation()\ndef a(view): return view.arrived",
         "observation a returns bool of shape [4]: return float numbers of shape [4, 1] or [4]."),
        ("@observation()\ndef a(view): return 3",
         "observation a returns int32 of shape []: return float numbers of shape [4, 1] or [4]."),
        ("@observation()\ndef a(view): return view.no_such",
         "observation a fails: AttributeError: 'View' object has no attribute 'no_such'."),
        ("@reward_term(weight=1.0)\ndef a(step): return step.pose",
         "reward a returns float32 of shape [4, 3]: return float numbers of shape [4]."),
        ("@level_drawing\ndef ring(level, key): return level.start",
         "level ring returns "),
        ("@level_drawing\ndef ring(level, key): return level._replace(target=level.start)",
         "level ring returns target as float32 of shape [4, 3]: return float32 of shape [4, 2]."),
        ("@level_drawing\ndef ring(level, key): return level._replace(target=level.target + 9)",
         "level ring, drawn for stage ring: robot 0 overlaps a wall where it has its target."),
        ("@level_drawing\ndef ring(level, key): return level._replace(start=0 * level.start)",
         "level ring, drawn for stage ring: robot 0 overlaps another robot where it starts."),
        ("@level_drawing\ndef ring(level, key): return level._replace(start=level.start + jnp.nan)",
         "level ring, drawn for stage ring: a number is not finite."),
        ("@level_drawing\ndef ring(level, key): return level._replace(obstacle=2 * level.obstacle)",
         "level ring changes the sizes of obstacles: leave obstacle[:, 3:] as it is, and set the "
         "stage's obstacle_size."),
    ],
)  # fmt: skip
def test_a_piece_that_does_not_fit_is_one_sentence(
    tmp_path: Path, body: str, sentence: str
) -> None:
    source = extensions.write(tmp_path / "mine.py", body)
    stages = (RING,) if "def ring" in body else (StageConfig(name="s", robots=3, side=1.0),)
    found = refusal(_world, source, stages)
    assert found.startswith(f"{source}: {sentence}")


def test_what_the_task_names_and_nobody_defines_is_refused() -> None:
    stages = (StageConfig(name="s", robots=3, side=1.0),)
    for task, key in (
        ({"observations": ("x",)}, "task.observations names 'x', "),
        ({"reward": RewardConfig(extra={"x": 1.0})}, "task.reward.extra names 'x', "),
    ):
        sentence = refusal(partial(task_world.load, sim=SIM, task=TaskConfig(**task)), stages)
        assert sentence == (
            f"{key}which is not part of swarmjax: add extensions=FILE, the Python file that "
            "defines 'x'."
        )


def test_a_way_of_drawing_that_is_missing_is_refused() -> None:
    assert refusal(partial(task_world.load, sim=SIM), (RING,)) == (
        f"stage ring: level is 'ring': give one of {', '.join(BUILT_IN)}, or add extensions=FILE, "
        "the Python file that defines this level."
    )


@pytest.mark.parametrize(
    "body",
    [
        "@reward_term(weight=1.0)\ndef a(step): return step.distance * jnp.nan",
        "@observation()\ndef a(view): return jnp.where(view.distance > 0, jnp.inf, 0.0)",
    ],
)
def test_what_is_not_finite_ends_the_episode_and_teaches_nothing(tmp_path: Path, body: str) -> None:
    stage = StageConfig(name="s", robots=3, side=1.0)
    world = _world(extensions.write(tmp_path / "mine.py", body), (stage,))
    uniforms = np.random.default_rng(3).random(level.uniform_count(world.spacing), np.float32)
    mine = extended.draw(uniforms, task_stage.single(stage, world.drawings), world.spacing, ())
    _, came = _step(world, mine, np.zeros((4, 2), np.float32))
    assert not came.sound
    assert came.done
    assert not came.valid.any()
    assert not came.reward.any()


BY_RULE = """
@reward_term(weight=1.0)
def away(step):
    return step.outside * 1.0 + step.arrives * 10.0

@observation()
def there(view):
    return view.arrived * 1.0
"""


@pytest.mark.parametrize("rule", ["latch", "hold"])
def test_pieces_see_who_is_there_by_either_rule(tmp_path: Path, rule: Arrival) -> None:
    """Starts one robot at its target and one far from its own, then moves the first target away."""
    file = extensions.write(tmp_path / "own.py", BY_RULE)
    price = RewardConfig(progress=0.0, contact=0.0, step_penalty=0.0, extra={"away": 1.0})
    pair = StageConfig(name="pair", robots=2, side=0.8)
    world = _world(file, (pair,), arrival=rule, reward=price)
    scene = holding.level(4, 1)
    at_first = np.concatenate([scene.start[:1, :2], scene.target[1:]])
    state = env.reset(world, scene._replace(target=at_first))
    state = dataclasses.replace(state, sim=physics.unpack(world.physics, state.sim))
    step = jax.jit(partial(env.step, world))
    still = np.tile(np.float32(holding.STILL), (4, 1))
    state, first = step(state, still)
    moved = state.level._replace(target=state.level.target.at[0].set(jnp.array([0.3, 0.0])))
    state, second = step(dataclasses.replace(state, level=moved), still)
    state, third = step(state, still)
    there = [each.observation[0, -1] for each in (first, second, third)]
    earned = [each.reward[0] for each in (first, second, third)]
    # With latch, the robot arrives in the first step, is paid for it, and then earns nothing.
    assert there == ([1, 1, 1] if rule == "latch" else [1, 0, 0])
    assert earned == ([11, 0, 0] if rule == "latch" else [1, 0, 1])
