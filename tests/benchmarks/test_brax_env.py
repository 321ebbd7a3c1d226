"""The adapter to Brax steps, rewards, ends and restarts as the environment itself does."""

import dataclasses
import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import race
from swarmjax.ppo import learner as ppo
from swarmjax.ppo.config import AlgoConfig
from swarmjax.run.settings import TrainConfig
from swarmjax.sim.config import SimConfig
from swarmjax.task import env
from swarmjax.task.config import TaskConfig
from swarmjax.task.observation import SIZE
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import program as programs
from swarmjax.training.program import Program
from tests.sentences import refusal

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # JAXopt, which Brax imports, says that nobody keeps it up
    brax_env = pytest.importorskip("benchmarks.brax_env", exc_type=ImportError)

STEPS = 20  # the step limit is 16, so that every arena begins anew once


@pytest.fixture(scope="module")
def program() -> Program:
    """Two robots where three are compiled in; one solver iteration, which compiles sooner."""
    stage = StageConfig(name="pair", robots=2, side=0.5)
    sim = SimConfig(impl="jax", max_robots=3, max_obstacles=0, iterations=1, ls_iterations=1)
    task, algo = TaskConfig(step_limit=16), AlgoConfig(rollout_length=8, num_minibatches=2)
    config = TrainConfig(stage=(stage,), task=task, algo=algo, sim=sim, arenas=4, budget=32)
    return Program(config, programs.load_world(config))


@pytest.mark.slow  # 22 s of compiling, for a peer of a benchmark
def test_it_is_the_environment_robot_by_robot(program: Program) -> None:
    world, swarm = program.world, brax_env.SwarmEnv(program, programs.schedule(program.config))
    state = jax.jit(swarm.reset)(jax.random.split(jax.random.PRNGKey(0), 4 * 3))

    @jax.jit
    def step(state, action):
        alone = jax.vmap(partial(env.step, world))
        _, came = alone(state.pipeline_state.now, action.reshape(4, 3, 2))
        return swarm.step(state, action), came

    random, ended, drawn = np.random.default_rng(0), 0, []
    for number in range(1, STEPS + 1):
        before = state.pipeline_state
        np.testing.assert_array_equal(state.obs, before.now.observation.reshape(12, SIZE))
        state, came = step(state, random.uniform(-1.0, 1.0, (12, 2)).astype(np.float32))
        over = np.asarray(came.done)[:, None, None]
        seen = np.where(over, before.starts.observation, came.observation)
        # The same numbers twice in one program, which XLA may add up in another order.
        np.testing.assert_allclose(state.obs, seen.reshape(12, SIZE), rtol=0.0, atol=1e-5)
        np.testing.assert_allclose(state.reward, came.reward.ravel(), rtol=0.0, atol=1e-5)
        idle = np.asarray(came.truncated | ~came.valid).ravel()
        np.testing.assert_array_equal(state.info["truncation"], idle)
        np.testing.assert_array_equal(state.done, idle | np.asarray(came.terminated).ravel())
        # Of three robots two are there: Brax learns nothing from the third.
        assert idle.reshape(4, 3)[:, 2].all()
        ended += int(np.sum(came.done))
        if np.any(before.starts.level.start != state.pipeline_state.starts.level.start):
            drawn.append(number)
    assert ended >= 4
    assert drawn == [8, 16]  # once a rollout of 8 control steps


def test_brax_is_given_our_numbers(tiny_config: TrainConfig) -> None:
    found = race.brax_settings(race.RaceConfig(points=4), tiny_config)
    # 20 updates are judged every 5; 8 arenas of 3 robots, 8 control steps each.
    assert found["num_timesteps"] == 20 * 24 * 8
    assert (found["num_envs"], found["batch_size"], found["num_minibatches"]) == (24, 12, 2)
    assert (found["unroll_length"], found["num_updates_per_batch"]) == (8, 2)
    assert (found["discounting"], found["learning_rate"]) == (tiny_config.algo.discount, 3e-4)
    assert race.points(race.RaceConfig(points=6), tiny_config).tolist() == [3, 6, 9, 12, 15, 18]


def test_brax_is_given_playgrounds_numbers(tiny_config: TrainConfig) -> None:
    words = race.RaceConfig(points=4, settings="playground")
    larger = dataclasses.replace(tiny_config, arenas=32, budget=32 * 8 * 20)
    found = race.brax_settings(words, larger)
    # 20 updates of 8 control steps are 8 of 20, judged every 2; 32 arenas of 3 robots.
    assert found["num_timesteps"] == 8 * 96 * 20
    assert (found["num_envs"], found["batch_size"], found["num_minibatches"]) == (96, 3, 32)
    assert (found["discounting"], found["learning_rate"]) == (0.97, 3e-4)
    words = dataclasses.replace(words, learning_rate=1e-3)
    assert race.brax_settings(words, larger)["learning_rate"] == 1e-3


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["trainer=brax", "settings=playground", "arenas=40"],
            "arenas is 40: settings=playground takes a number of robots, 200 of which there are, "
            "that 32 divides.",
        ),
        # 32 updates of 8 control steps are 12 of 20.
        (
            [
                "trainer=brax",
                "settings=playground",
                "arenas=32",
                "algo.rollout_length=8",
                "budget=8192",
            ],
            "points is 30, but the budget is 12 updates: give at most as many.",
        ),
        (
            ["arenas=40", "budget=12800"],
            "points is 30, but the budget is 10 updates: give at most as many.",
        ),
        (
            ["stage=s1"],
            "sim.max_robots is 5, but stage s1 has 2 robots, and Brax has no place for "
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
    mine = ppo.mode(jax.tree.map(lambda x: x[0, 0], learners), tiny_config.algo, seen)
    np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=1e-7)  # rounding of float32
    std = np.exp(learners.params["actor"]["log_std"])
    np.testing.assert_allclose(std, 0.6, rtol=1e-6)


def test_seconds_to_a_share() -> None:
    course = race.Course(
        train_s=np.array([1.0, 2.0, 3.0]),
        share=np.array([0.5, 0.9, 0.94]),
        transitions=np.array([10.0, 20.0, 30.0]),
        arena_steps=np.array([2.0, 4.0, 6.0]),
        compile_s=0.0,
    )
    assert race.seconds_to(course) == {"seconds_to_0.90": 2.0, "seconds_to_0.95": None}
