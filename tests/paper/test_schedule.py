"""Compares deviations, updates and ends of episodes, step by step, with a replay in NumPy.

The replay is our own implementation of the loop of PPO-PyTorch's train.py (commit 728cce8).
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.curriculum.engine import Schedule
from swarmjax.ppo import exploration
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim.config import SimConfig
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import loop, rollout
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.rollout import Program

PAPER = load_train(["algo=paper", "sim.impl=jax"])


class Replay(NamedTuple):
    """The deviation of each step, the step count and deviation of each update, and episode ends."""

    std: np.ndarray
    updates: list[tuple[int, float]]
    ends: list[int]


def _replay(config: TrainConfig, steps: int, arrived: np.ndarray) -> Replay:
    """Replays `steps` steps of one environment, whose robot arrives where `arrived` is true."""
    algo = config.algo
    assert algo.std_interval is not None
    assert algo.std_decrement is not None
    assert algo.std_floor is not None
    std, time_step, stds, updates, ends = algo.initial_std, 0, np.zeros(steps), [], []
    while time_step < steps:
        for _ in range(config.task.step_limit):
            stds[time_step] = std
            done = arrived[time_step]
            time_step += 1
            if time_step % algo.rollout_length == 0:
                updates.append((time_step, std))
            if time_step % algo.std_interval == 0:
                std = max(round(std - algo.std_decrement, 4), algo.std_floor)
            if done or time_step == steps:
                break
        ends.append(time_step - 1)
    return Replay(stds, updates, ends)


def test_the_deviation_of_every_one_of_a_million_steps() -> None:
    steps = 1_000_000
    replay = _replay(PAPER, steps, np.zeros(steps, bool))
    found = exploration.scheduled_std(PAPER.algo, jnp.arange(steps))
    np.testing.assert_array_equal(found, replay.std.astype(np.float32))
    counts = np.unique(replay.std, return_counts=True)
    assert [each.tolist() for each in counts] == [[0.45, 0.5, 0.55, 0.6], [250_000] * 4]


def test_the_updates_of_a_million_steps() -> None:
    replay = _replay(PAPER, PAPER.budget, np.zeros(PAPER.budget, bool))
    assert PAPER.updates == len(replay.updates) == 166
    made = [(i + 1) * PAPER.arenas * PAPER.algo.rollout_length for i in range(PAPER.updates)]
    assert made == [step for step, _ in replay.updates]
    # An update learns with the deviation of its rollout's last step. If the deviation drops at the
    # same step, as at 750,000, the update comes before the drop.
    last = exploration.scheduled_std(PAPER.algo, jnp.array(made) - 1)
    np.testing.assert_array_equal(last, np.float32([std for _, std in replay.updates]))
    assert (750_000, 0.5) in replay.updates


def _drive(config: TrainConfig, updates: int) -> dict[str, np.ndarray]:
    """Drives one arena for `updates` rollouts without learning; returns steps [updates, T, ...]."""
    program, schedule = programs.load(config)
    state = jax.jit(partial(loop.init, program))(schedule)
    rounds = jax.jit(lambda s: jax.lax.scan(partial(_round, program, schedule), s, length=updates))
    _, found = rounds(state)
    return jax.tree.map(np.asarray, found)


def _round(
    program: Program, schedule: Schedule, state: TrainState, _: None
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Runs one rollout as `loop.update` does; returns the data that reveal its deviation."""
    config, world = program.config, program.world
    key, level_key, rollout_key = jax.random.split(state.key, 3)
    index = jnp.zeros((config.waiting, 1), jnp.int32)
    starts = rollout.draw_starts(world, schedule.stages, index, jnp.int32(0), level_key)
    arenas, path, ended = rollout.collect(
        program, state.learners, state.arenas, starts, rollout_key
    )
    learners = program.ppo.explore(state.learners, config.algo.rollout_length)
    still = jnp.zeros_like(path.action)
    mean = jax.vmap(program.ppo.act, in_axes=(0, 1, 1))(learners, path.observation, still)[0]
    found = {
        "square": jnp.sum((path.action[:, 0, 0, 0] - mean[0, :, 0, 0]) ** 2, axis=-1),
        "log_prob": path.log_prob[:, 0, 0, 0],
        "done": ended.episodes[:, 0],
        "arrived": ended.all_reached[:, 0],
        "cohort": ended.cohort[:, 0],
        "std": jnp.exp(learners.params["actor"]["log_std"][0, 0]),
    }
    return replace(state, learners=learners, arenas=arenas, key=key), found


def _check_run(config: TrainConfig, updates: int) -> None:
    """Drives one arena and compares every step with the replay."""
    steps = updates * config.algo.rollout_length
    found = _drive(config, updates)
    path = {name: found[name].reshape(-1) for name in ("square", "log_prob", "done", "arrived")}
    replay = _replay(config, steps, path["arrived"].astype(bool))
    assert np.flatnonzero(path["done"]).tolist() in (replay.ends, replay.ends[:-1])
    # The test needs both kinds of episode end. Every episode counts for the curriculum.
    assert 0 < path["arrived"].sum() < path["done"].sum()
    assert set(found["cohort"].ravel()) <= {-1, 0}
    # The density of a two-dimensional normal reveals the deviation. 2e-4 covers float32 rounding.
    std = replay.std
    log_prob = -path["square"] / (2 * std**2) - 2 * np.log(std) - np.log(2 * np.pi)
    np.testing.assert_allclose(path["log_prob"], log_prob, atol=2e-4)
    # Deviations are kept as logarithms in float32.
    np.testing.assert_allclose(found["std"], [std for _, std in replay.updates], rtol=1e-6)


def _config(scale: int) -> TrainConfig:
    """Returns the paper's settings for one robot near its target, with fewer steps.

    All numbers of steps are divided by `scale`.
    """
    algo = replace(PAPER.algo, rollout_length=6000 // scale, std_interval=250_000 // scale)
    return replace(
        PAPER,
        stage=(StageConfig(name="one", robots=1, side=0.4),),
        stage_name="one",
        task=replace(PAPER.task, step_limit=1500 // scale, target_radius=0.1),
        sim=SimConfig(impl="jax", max_robots=1, max_obstacles=0),
        algo=algo,
        budget=10**6 // scale,
    )


@pytest.mark.slow
def test_a_run_of_a_twentieth_of_the_steps() -> None:
    _check_run(_config(20), 166)


@pytest.mark.slow
def test_a_run_of_a_million_steps() -> None:
    _check_run(_config(1), 166)
