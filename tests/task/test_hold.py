"""Tests `task.arrival=hold`: robots keep driving, and all must be at their targets at once."""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import holding
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from holding import ENTERS, LEAVES, OTHER, PACE, RETURNS
from hypothesis import given
from hypothesis import strategies as st

from swarmjax.sim import physics
from swarmjax.task import env, reward
from swarmjax.task.config import Arrival, RewardConfig
from swarmjax.task.env import EnvState, TimeStep
from swarmjax.task.goals import load as goals
from swarmjax.task.world import World

ROBOTS, OBSTACLES = 3, 2  # of the tiny configuration
PAID = RewardConfig(progress=1.0, arrival=8.0, contact=0.0, step_penalty=-0.25)


class Episode(NamedTuple):
    """States [65, ...] and steps [64, ...] of the scene of `holding`, without any reset."""

    state: EnvState
    came: TimeStep
    traces: int


Play = Callable[..., Episode]


def _stack[Tree](trees: list[Tree]) -> Tree:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


@pytest.fixture(scope="module")
def play(tiny_world: World) -> Play:
    """Returns a function that plays the scene with a rule, step limit and actions [64, 3, 2]."""

    @functools.cache
    def compiled(rule: Arrival, limit: int) -> tuple[World, Callable, list[int]]:
        task = dataclasses.replace(tiny_world.task, arrival=rule, step_limit=limit, reward=PAID)
        world, traces = (
            dataclasses.replace(tiny_world, task=task, goal=goals.load(task, tiny_world.robot)),
            [],
        )

        def step(state: EnvState, action: jax.Array) -> tuple[EnvState, TimeStep]:
            traces.append(1)
            return env.step(world, state, action)

        return world, jax.jit(step), traces

    def play(rule: Arrival = "hold", limit: int = 100, chosen: np.ndarray | None = None) -> Episode:
        world, step, traces = compiled(rule, limit)
        level = jax.tree.map(jnp.asarray, holding.level(ROBOTS, OBSTACLES))
        state = jax.jit(env.reset, static_argnums=0)(world, level)
        state = dataclasses.replace(state, sim=physics.unpack(world.physics, state.sim))
        states, steps = [state], []
        for action in holding.actions(ROBOTS) if chosen is None else chosen:
            state, came = step(state, jnp.asarray(action))
            states.append(state)
            steps.append(came)
        slim = [dataclasses.replace(each, sim=physics.pack(each.sim)) for each in states]
        return Episode(_stack(slim), _stack(steps), len(traces))

    return play


@pytest.fixture(scope="module")
def episode(play: Play) -> Episode:
    return play()


def test_a_robot_has_arrived_while_it_is_within_its_target(episode: Episode) -> None:
    np.testing.assert_array_equal(episode.state.arrived[1:, :2], holding.arrived())
    assert not episode.state.arrived[0].any()
    assert not episode.state.arrived[:, 2].any()  # robot 2 is absent
    # Robot 0 is where `holding` says, so the steps worked out there apply. 1e-6 m covers float32.
    for step, away in ((ENTERS, 0.06 - 3 * PACE), (LEAVES, 28 * PACE - 0.06)):
        assert episode.state.distance[step, 0] == pytest.approx(away, abs=1e-6)


def test_a_robot_within_its_target_drives_on(episode: Episode) -> None:
    place = episode.state.sim.qpos.reshape(RETURNS + 1, ROBOTS, 3)[:, 0, 0]
    expected = PACE * np.arange(holding.STOPS + 1)
    # 1e-6 m covers float32.
    np.testing.assert_allclose(place[: holding.STOPS + 1], expected, atol=1e-6)


def test_the_episode_is_complete_when_all_are_there_at_once(episode: Episode) -> None:
    came = episode.came
    assert np.flatnonzero(came.done).tolist() == [RETURNS - 1]
    for robot in (0, 1):
        assert np.flatnonzero(came.terminated[:, robot]).tolist() == [RETURNS - 1]
    assert not came.terminated[:, 2].any()
    assert not came.truncated.any()


def test_what_robots_do_within_their_targets_is_learned_from(episode: Episode) -> None:
    assert episode.came.valid[:, :2].all()
    assert not episode.came.valid[:, 2].any()


def test_the_way_and_the_time_outside_are_paid_and_the_end_once(episode: Episode) -> None:
    # Robot 0 begins steps 1 to 3 and 29 to 64 outside its target, and robot 1 steps 1 to 40.
    outside = np.array([ENTERS + RETURNS - LEAVES, OTHER])
    assert outside.tolist() == [39, 40]
    way = episode.state.distance[0, :2] - episode.state.distance[-1, :2]
    # 1e-5 covers float32 sums of 64 numbers of up to 8.
    np.testing.assert_allclose(
        episode.came.reward.sum(axis=0)[:2], way - 0.25 * outside + 8.0, atol=1e-5
    )
    assert (episode.came.reward[-1, :2] > 7.0).all()
    assert (episode.came.reward[:-1] < 1.0).all()
    np.testing.assert_array_equal(episode.state.episode.moving[-1, :2], outside)


def test_at_the_step_limit_all_are_truncated_wherever_they_are(play: Play) -> None:
    found = play(limit=50)
    assert found.state.arrived[50, :2].tolist() == [False, True]
    assert found.came.truncated[49].tolist() == [True, True, False]
    assert not found.came.truncated[:49].any()
    assert not found.came.terminated[:50].any()
    assert np.flatnonzero(found.came.done[:50]).tolist() == [49]


def test_a_robot_that_left_and_stays_away_is_not_complete(play: Play) -> None:
    found = play(chosen=holding.actions(ROBOTS, drives_on=True))
    assert found.state.arrived[-1, :2].tolist() == [False, True]
    assert not found.came.done.any()


def test_by_latch_it_would_have_stopped_and_been_over(play: Play) -> None:
    came = play("latch").came
    assert np.flatnonzero(came.terminated[:, 0]).tolist() == [ENTERS - 1]
    assert np.flatnonzero(came.done)[0] == OTHER - 1


def test_every_step_is_of_one_trace(play: Play) -> None:
    again = play()
    assert again.traces == 1


# --- the reward by itself


def _step(before: float, now: float, *, was_there: bool) -> reward.Step:
    """Returns a control step of one robot that touches nothing and does not end the episode."""
    return reward.Step(
        distance_before=jnp.array([before]),
        distance=jnp.array([now]),
        infrared=jnp.full((1, 8), 0.01),
        sensor_range=0.04,
        arrives=jnp.zeros(1, bool),
        contact_begins=jnp.zeros((1, 3), bool),
        touching=jnp.zeros((1, 3), bool),
        outside=jnp.array([not was_there]),
    )


@given(st.lists(st.floats(0.0, 0.25, width=32), min_size=1, max_size=20))
def test_leaving_and_coming_back_earns_nothing(way: list[float]) -> None:
    """Checks that leaving the target and coming back never earns more than waiting there."""
    path, weights = [0.02, *way, 0.02], RewardConfig(proximity=-0.001, arrival=8.0)
    total = sum(
        float(reward.total(_step(before, now, was_there=before <= 0.05), weights)[0])
        for before, now in itertools.pairwise(path)
    )
    outside = sum(distance > 0.05 for distance in path)
    # A step outside the target costs 0.002, and 0.001 more because something is in range. 1e-6
    # covers 21 differences in float32.
    assert total == pytest.approx(-0.003 * outside, abs=1e-6)


def test_who_waits_within_the_target_pays_nothing_for_its_neighbours() -> None:
    for name in ("proximity", "step_penalty"):
        paid = [reward.TERMS[name](_step(0.1, 0.1, was_there=there))[0] for there in (True, False)]
        assert paid == [0.0, 1.0], name
