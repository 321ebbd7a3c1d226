"""Checks training with `task.arrival=hold`: the samples of a rollout, and that a swarm learns."""

import dataclasses
import functools
from pathlib import Path
from typing import NamedTuple

import holding
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import swarmjax
from swarmjax.run.settings import TrainConfig
from swarmjax.task import env
from swarmjax.task.episode import Ended
from swarmjax.task.goals import load as goals
from swarmjax.task.world import World
from swarmjax.training import program as programs
from swarmjax.training import rollout
from swarmjax.training.rollout import Arena, Trajectory

ALL, ONE, GOING = range(3)  # arenas
STEPS = 8  # control steps of a rollout in the tiny configuration, whose episodes end at 16


class Run(NamedTuple):
    """A rollout of three arenas: the trajectory, [T, 1, 3, R, ...], and ended episodes, [T, 3]."""

    trajectory: Trajectory
    ended: Ended


@pytest.fixture(scope="module")
def run(tiny_config: TrainConfig, tiny_world: World) -> Run:
    """Returns a rollout of three arenas.

    In the first arena, all robots are at their targets. In the other two, one robot is, and the
    first step of the second arena reaches the step limit.
    """
    task = dataclasses.replace(tiny_config.task, arrival="hold")
    config = dataclasses.replace(tiny_config, task=task)
    goal = goals.load(task, tiny_world.robot)
    world = dataclasses.replace(tiny_world, task=task, goal=goal)
    program = programs.build(config, world)
    scene = holding.level(robots=3, obstacles=2)
    there = scene.start[:, :2].copy()
    one = np.array([there[0], scene.target[1], there[2]])
    levels = [scene._replace(target=target) for target in (there, one, one)]
    stacked = jax.tree.map(lambda *fields: jnp.asarray(np.stack(fields)), *levels)
    begun = jax.jit(jax.vmap(functools.partial(env.reset, program.world)))(stacked)
    none = jnp.zeros(3, jnp.int32)
    starts = Arena(**vars(begun), stage=none, cohort=none)
    before = dataclasses.replace(starts, clock=jnp.array([0, 15, 0], jnp.int32))

    learners = jax.vmap(program.ppo.init)(jax.random.split(jax.random.key(1), 1))
    collect = jax.jit(functools.partial(rollout.collect, program))
    _, trajectory, ended = collect(learners, before, starts, jax.random.key(2))
    return Run(*jax.tree.map(np.asarray, (trajectory, ended)))


@pytest.mark.slow
def test_all_there_ends_the_episode_without_bootstrap(run: Run) -> None:
    found = run.trajectory
    assert found.terminated[0, 0, ALL].tolist() == [True, True, False]
    assert not found.truncated[0, 0, ALL].any()


def test_at_the_step_limit_whoever_is_there_is_cut_as_the_others_are(run: Run) -> None:
    found = run.trajectory
    assert found.truncated[0, 0, ONE].tolist() == [True, True, False]
    assert not found.terminated[:, 0, ONE].any()


def test_robots_at_their_targets_are_learned_from(run: Run) -> None:
    assert run.trajectory.valid[:, 0, GOING, :2].all()
    assert not run.trajectory.valid[..., 2].any()  # this robot is absent


def test_what_ended_counts_who_is_there_at_the_end(run: Run) -> None:
    ended = run.ended
    assert ended.episodes[0].tolist() == [1, 1, 0]
    assert ended.targets[0].tolist() == [2, 2, 0]
    assert ended.reached[0].tolist() == [2, 1, 0]
    assert ended.all_reached[0].tolist() == [1, 0, 0]
    # No robot had arrived when the episodes began, so each robot counts one step before arrival.
    assert ended.robot_steps[0].tolist() == [2, 2, 0]


@pytest.mark.slow
def test_a_swarm_learns_to_hold(tmp_path: Path) -> None:
    """Trains on the easiest stage, where the share of complete episodes begins near 0."""
    found = swarmjax.train_policy(
        {
            "stage": "s1",
            "task": {"arrival": "hold"},
            "arenas": 64,
            "budget": 400_000,
            "run": {"dir": str(tmp_path / "run"), "tensorboard": False},
        }
    )
    complete = [row["complete_by_stage"][0] for row in found.metrics]
    measured = [share for share in complete if share is not None]
    # With seeds 0 to 3, the share was 0.06 to 0.39 in the first whole cohort, and 0.98 to 0.99 in
    # the last.
    assert measured[0] < 0.5
    assert measured[-1] > 0.9
