"""Checks the initial learning rates, and the steps that the optimiser takes or skips."""

import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest

from swarmjax.ppo import gradients, optimizer
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.gradients import Learning


@pytest.mark.parametrize(
    ("updates", "schedule", "actor"),
    [
        (1, "linear", 3e-4),
        (1875, "linear", 3e-4),  # 15,000 gradient steps, 8 an update
        (3750, "linear", 1.5e-4),
        (14_648, "linear", 3e-4 * 15_000 / 117_184),
        (937, "constant", 3e-4),  # a constant rate sums to twice a linear one
        (3750, "constant", 0.75e-4),
    ],
)
def test_open_learning_rates_fall_with_the_gradient_steps(
    updates: int, schedule: str, actor: float
) -> None:
    config = AlgoConfig(epochs=1, num_minibatches=8, learning_rate_schedule=schedule)  # pyright: ignore[reportArgumentType]
    found = optimizer.learning_rates(config, updates)
    assert found == pytest.approx({"actor": actor, "critic": actor / 0.3}, rel=1e-12)


def test_given_learning_rates_are_kept() -> None:
    config = AlgoConfig(actor_learning_rate=1e-2)
    found = optimizer.learning_rates(config, 10**6)
    assert found["actor"] == 1e-2
    assert found["critic"] < 1e-3


def test_epochs_and_minibatches_count_as_gradient_steps() -> None:
    assert optimizer.gradient_steps(AlgoConfig(epochs=3, num_minibatches=5), 7) == 105


def test_means_are_those_of_the_steps_that_were_taken() -> None:
    metrics = {
        "loss": jnp.array([[1.0, 0.0, 0.0], [0.0, 2.0, 6.0]]),
        "taken_steps": jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]]),
        "skipped_steps": jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]),
    }
    found = gradients.mean_of_taken(metrics)
    assert found["loss"] == pytest.approx((1.0 + 2.0 + 6.0) / 3)
    assert found["skipped_steps"] == 1.0


def test_an_update_that_took_no_step_has_no_means_if_one_was_skipped() -> None:
    metrics = {
        "loss": jnp.zeros(3),
        "taken_steps": jnp.zeros(3),
        "skipped_steps": jnp.array([1.0, 0.0, 1.0]),
    }
    assert gradients.mean_of_taken(metrics)["loss"] == -np.inf
    nothing = metrics | {"skipped_steps": jnp.zeros(3)}
    assert gradients.mean_of_taken(nothing)["loss"] == 0.0


def test_one_broken_gradient_leaves_parameters_and_optimiser_as_they_are() -> None:
    config = AlgoConfig(epochs=1, num_minibatches=1)
    params = {"actor": {"w": jnp.ones(3)}, "critic": {"w": jnp.ones(2)}}
    adam = optimizer.make(config, 5)
    learning = Learning(config, learners.nets(config, 1, 1), adam)
    progress = (params, adam.init(params))
    gradient = {"actor": {"w": jnp.array([1.0, jnp.nan, 0.0])}, "critic": {"w": jnp.ones(2)}}
    loss = {"policy_loss": jnp.float32(jnp.nan)}
    found, metrics = gradients.take(learning, progress, (gradient, loss), jnp.array(True))
    jax.tree.map(np.testing.assert_array_equal, found, progress)
    assert metrics["skipped_steps"] == 1.0
    assert metrics["policy_loss"] == 0.0
