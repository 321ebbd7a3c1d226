"""Checks that random draws differ: levels by rollout, noise by step, and sample order by epoch."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import learners
import numpy as np
import optax
import pytest

from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.networks import Sizes
from swarmjax.run.settings import TrainConfig
from swarmjax.task.stage_config import StageConfig
from swarmjax.training import loop, rollout
from swarmjax.training import program as programs
from swarmjax.training.loop import Metrics, TrainState
from swarmjax.training.rollout import Program

Update = Callable[[TrainState], tuple[TrainState, Metrics]]

ARENAS, STEPS = 8, 8  # arenas of the tiny configuration; control steps of a rollout


@pytest.fixture(scope="module")
def program(tiny_config: TrainConfig) -> Program:
    """Returns a program whose episodes all end with each rollout.

    The program has one robot in each arena, which compiles faster.
    """
    algo = replace(
        tiny_config.algo, hidden_sizes=(4,), epochs=1, num_minibatches=4, max_grad_norm=None
    )
    config = replace(
        tiny_config,
        stage=(StageConfig(name="alone", robots=1, side=0.5),),
        task=replace(tiny_config.task, step_limit=STEPS),
        algo=replace(algo, initialization="uniform"),
        sim=replace(tiny_config.sim, max_robots=1, max_obstacles=0),
    )
    return programs.build(config, programs.load_world(config))


@pytest.fixture(scope="module")
def start(program: Program) -> TrainState:
    return jax.jit(functools.partial(loop.init, program))(programs.schedule(program.config))


@pytest.fixture(scope="module")
def update(program: Program) -> Update:
    jitted = jax.jit(functools.partial(loop.update, program))
    return functools.partial(jitted, programs.schedule(program.config))


def _with_mean(state: TrainState, action: float) -> TrainState:
    """Returns the state with a policy of a constant mean action and of deviation 1."""
    params = state.learners.params
    actor: Any = jax.tree.map(jnp.zeros_like, params["actor"])
    actor["mean"]["bias"] += action
    return replace(state, learners=replace(state.learners, params=params | {"actor": actor}))


def _critic(state: TrainState) -> np.ndarray:
    """Returns all parameters of the critic as one vector."""
    leaves = jax.tree.leaves(state.learners.params["critic"])
    return np.concatenate([np.ravel(leaf) for leaf in leaves])


def test_every_rollout_draws_levels_of_its_own(start: TrainState, update: Update) -> None:
    """All episodes end with a rollout, so the next rollout plays the levels drawn for it."""
    state, starts = start, []
    for _ in range(3):
        state, _ = update(state)
        starts.append(state.arenas.level.start[:, 0, 0])
    assert len(np.unique(starts)) == 3 * ARENAS


def test_every_control_step_of_a_rollout_has_noise_of_its_own(
    program: Program, start: TrainState
) -> None:
    collect = jax.jit(functools.partial(rollout.collect, program))
    learners = _with_mean(start, 0.0).learners
    _, trajectory, _ = collect(learners, start.arenas, start.arenas, jax.random.key(0))
    # With mean 0 and deviation 1, an action equals its noise.
    actions = np.asarray(trajectory.action)
    assert actions.shape == (STEPS, 1, ARENAS, 1, 2)
    assert len(np.unique(actions)) == actions.size


def test_every_rollout_has_noise_of_its_own(start: TrainState, update: Update) -> None:
    """Both rollouts play the same levels, since newly drawn levels begin only after a rollout."""
    begun = _with_mean(start, 0.0)
    one, seen = update(begun)
    _, seen_too = update(replace(begun, key=one.key))  # the key of the next update
    assert seen["reward"] != seen_too["reward"]


def test_every_update_shuffles_in_an_order_of_its_own(start: TrainState, update: Update) -> None:
    """Robots move the same in both rollouts: an action near 100 is full speed with any noise."""
    begun = _with_mean(start, 100.0)
    one, seen = update(begun)
    other, seen_too = update(replace(begun, key=one.key))  # the key of the next update
    assert seen["robot_steps"] == seen_too["robot_steps"]
    assert seen["reward"] == seen_too["reward"]
    assert np.any(_critic(other) != _critic(one))


def test_every_epoch_shuffles_in_an_order_of_its_own() -> None:
    """Two of four groups are valid: an epoch takes one step if one minibatch has both, else two."""
    epochs, groups = 12, 4
    config = AlgoConfig(hidden_sizes=(4,), epochs=epochs, num_minibatches=2)
    ppo = learners.ppo(config, Sizes(3, 2), 1, "autodiff")
    learner = jax.jit(ppo.init)(jax.random.key(0))
    zeros = jnp.zeros((groups, 1))
    batch = Batch(
        observation=jnp.zeros((groups, 1, 3)),
        action=jnp.zeros((groups, 1, 2)),
        log_prob=zeros,
        advantage=zeros,
        return_=zeros,
        valid=jnp.array([[True], [True], [False], [False]]),
    )
    learned, _ = jax.jit(ppo.update)(learner, batch, jax.random.key(1))
    counts = optax.tree.get_all_with_path(learned.optimizer_state, "count")
    (steps,) = {int(count) for _, count in counts}
    # With the same order in every epoch, there would be 12 or 24 steps.
    assert epochs < steps < 2 * epochs
