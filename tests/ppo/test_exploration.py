"""Checks the schedule of exploration, and the learner that follows it."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest

from swarmjax.ppo import exploration
from swarmjax.ppo.batch import Batch
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.networks import Sizes
from swarmjax.ppo.ppo import LearnerState

SCHEDULED = AlgoConfig(
    hidden_sizes=(8,),
    num_minibatches=1,
    exploration="scheduled",
    std_interval=100,
    entropy_cost=0.01,
)


def test_levels_by_hand() -> None:
    expected = (0.6, 0.55, 0.5, 0.45, 0.4, 0.35, 0.3, 0.25, 0.2, 0.15, 0.1)
    assert exploration.scheduled_stds(SCHEDULED) == expected  # exact, since rounded to four digits
    # The second level is 0.5 - 0.3 = 0.2, and the third is the floor, 0.15, instead of -0.1.
    steep = replace(SCHEDULED, initial_std=0.5, std_decrement=0.3, std_floor=0.15)
    assert exploration.scheduled_stds(steep) == (0.5, 0.2, 0.15)
    assert exploration.scheduled_stds(replace(SCHEDULED, initial_std=0.1)) == (0.1,)
    # A decrement that rounds to 0 never lowers the deviation.
    assert exploration.scheduled_stds(replace(SCHEDULED, std_decrement=1e-5)) == (0.6,)


def test_each_level_holds_for_an_interval_and_the_last_for_ever() -> None:
    steps = jnp.array([0, 99, 100, 199, 200, 999, 1000, 2**31 - 1])
    found = exploration.scheduled_std(SCHEDULED, steps)
    expected = np.array([0.6, 0.6, 0.55, 0.55, 0.5, 0.15, 0.1, 0.1], np.float32)
    np.testing.assert_array_equal(found, expected)


PPO_ = learners.ppo(SCHEDULED, Sizes(3, 2), 5, "blocks")


def _std(state: LearnerState) -> np.ndarray:
    return np.exp(np.asarray(state.params["actor"]["log_std"]))


def test_a_learner_explores_with_the_level_of_its_last_step() -> None:
    state = jax.jit(PPO_.init)(jax.random.key(0))
    for steps, explored, std in ((100, 100, 0.6), (1, 101, 0.55), (99, 200, 0.55), (60, 260, 0.5)):
        state = PPO_.explore(state, steps)
        assert state.explored == explored
        # float32 rounding of a logarithm and an exponential.
        np.testing.assert_allclose(_std(state), [std, std], rtol=1e-6)
    begun = PPO_.begin_again(state, optimizer=False, exploration=True)
    assert begun.explored == 0
    np.testing.assert_allclose(_std(begun), [0.6, 0.6], rtol=1e-6)


def test_the_count_of_steps_does_not_wrap() -> None:
    state = jax.jit(PPO_.init)(jax.random.key(0))
    state = replace(state, explored=jnp.int32(2**31 - 50))
    for _ in range(2):
        state = PPO_.explore(state, 100)
        assert state.explored == 2**31 - 1
        np.testing.assert_allclose(_std(state), [0.1, 0.1], rtol=1e-6)  # float32, as above


def test_without_a_schedule_a_learner_stays_as_it_is() -> None:
    learned = AlgoConfig(hidden_sizes=(8,), num_minibatches=1)
    made = learners.ppo(learned, Sizes(3, 2), 5)
    state = made.init(jax.random.key(0))
    assert state.explored is None
    assert made.explore(state, 10) is state


@pytest.mark.slow
def test_an_update_leaves_a_scheduled_deviation_alone() -> None:
    state = PPO_.explore(jax.jit(PPO_.init)(jax.random.key(0)), 150)
    observation, action = jax.random.normal(jax.random.key(1), (2, 4, 6, 3))
    action = action[..., :2]
    batch = Batch(
        observation=observation,
        action=action,
        log_prob=jnp.full((4, 6), -1.0),
        advantage=observation[..., 0],
        return_=observation[..., 1],
        valid=jnp.ones((4, 6), bool),
    )
    updated, metrics = PPO_.update(state, batch, jax.random.key(2))
    np.testing.assert_array_equal(
        updated.params["actor"]["log_std"], state.params["actor"]["log_std"]
    )
    assert updated.explored == state.explored
    moved = updated.params["actor"]["mean"]["kernel"] - state.params["actor"]["mean"]["kernel"]
    assert jnp.abs(moved).max() > 1e-5
    np.testing.assert_allclose(metrics["std"], 0.55, rtol=1e-6)  # float32
