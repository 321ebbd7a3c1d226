"""Checks training with memory: the outputs that learners recompute, and runs bit for bit."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest

from swarmjax.curriculum.engine import Schedule
from swarmjax.ppo import gradients, ppo
from swarmjax.ppo.batch import Batch, Trajectory
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.ppo import LearnerState
from swarmjax.run.checkpoint import digest, to_leaves
from swarmjax.run.settings import TrainConfig
from swarmjax.training import loop, rollout
from swarmjax.training import program as programs
from swarmjax.training.loop import TrainState
from swarmjax.training.rollout import Arena, Program

SIZE, UPDATES = 4, 6


class Trained(NamedTuple):
    """A rollout of learners with random weights."""

    program: Program
    schedule: Schedule
    last: TrainState  # what the rollout began with
    arenas: Arena
    trajectory: Trajectory
    over: np.ndarray  # [T, A] whether the episode ended with the step
    batch: Batch


def _algo(config: TrainConfig, policy: str) -> AlgoConfig:
    algo = replace(config.algo, memory="gru", memory_size=SIZE)
    return AlgoConfig(**{**vars(algo), "policy": policy})


@pytest.fixture(
    scope="module", params=["shared", pytest.param("independent", marks=pytest.mark.slow)]
)
def trained(request: pytest.FixtureRequest, tiny_config: TrainConfig) -> Trained:
    config = replace(tiny_config, algo=_algo(tiny_config, request.param))
    program, schedule = programs.load(config)
    last = jax.jit(partial(loop.init, program))(schedule)
    last = replace(last, learners=learners.moved(last.learners))
    draw = jax.jit(partial(loop._draw, program, schedule, waiting=1))
    waiting = draw(last.curriculum, jax.random.key(1))
    collect = jax.jit(partial(rollout.collect, program))
    # The arenas are in the middle of their episodes, which end at 16 steps.
    before = replace(last.arenas, clock=jnp.array([0, 0, 9, 10, 11, 12, 13, 0], jnp.int32))
    arenas, trajectory, ended = collect(last.learners, before, waiting, jax.random.key(2))
    batch = jax.jit(partial(rollout.batch, program))(trajectory, before.recall, ended)
    over = np.asarray(ended.episodes) > 0
    return Trained(program, schedule, last, arenas, trajectory, over, batch)


def _one(learners: LearnerState) -> LearnerState:
    return jax.tree.map(lambda x: x[0], learners)


def test_what_is_recomputed_through_time_is_what_the_rollout_saw(trained: Trained) -> None:
    config, learners = trained.program.config.algo, trained.last.learners
    batch = jax.tree.map(lambda x: x[0], trained.batch)
    samples = ppo._samples(_one(learners), config, batch, ppo.ALONE)
    # The arenas are in another order, as in minibatches.
    rows = jnp.array([3, 0, 7, 1, 2, 6, 5, 4])
    minibatch = ppo._gather(samples, rows, config)
    nets = trained.program.ppo.learning.networks
    evaluate = jax.jit(gradients.evaluate, static_argnums=1)
    (mean, std, *_), value = evaluate(_one(learners).params, nets, minibatch)
    log_prob = gradients.log_density(mean, std, minibatch.action)
    valid = np.asarray(minibatch.valid)
    assert valid.sum() > 50
    assert trained.over.any()  # episodes end within the rollout
    tolerance = {"rtol": 0, "atol": 2e-6}  # float32; matrix products of another batch size
    np.testing.assert_allclose(log_prob[valid], minibatch.log_prob[valid], **tolerance)
    seen = np.asarray(trained.trajectory.value[:, 0])[:, rows].reshape(-1)
    np.testing.assert_allclose(value[valid], seen[valid], **tolerance)


def test_a_robot_forgets_where_its_episode_begins(trained: Trained) -> None:
    recall = trained.arenas.recall
    over = trained.over[-1]
    begun = np.asarray(trained.arenas.clock) == 0
    np.testing.assert_array_equal(begun, over)
    assert (np.asarray(recall.actor)[begun] == 0.0).all()
    assert (np.abs(recall.actor)[~begun].max(axis=(1, 2)) > 0.0).all()
    assert (np.asarray(recall.critic)[begun] == 0.0).all()


@pytest.mark.slow
def test_a_memory_is_trained(trained: Trained) -> None:
    chunk = jax.jit(partial(loop.train_chunk, trained.program))
    before = after = trained.last
    for _ in range(UPDATES):
        after = chunk(trained.schedule, after, np.int32(1))[0]
    at_once, _ = chunk(trained.schedule, before, np.int32(UPDATES))
    assert digest(to_leaves(at_once)) == digest(to_leaves(after))  # any chunk size
    first, last = to_leaves(before), to_leaves(after)
    for part in ("input", "recurrent"):
        for side in ("actor", "critic"):
            name = f"learners/params/{side}/memory/{part}/kernel"
            assert np.abs(last[name] - first[name]).max() > 1e-4, name
