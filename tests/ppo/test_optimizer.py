"""The learning rates that a run begins with."""

import pytest

from swarmjax.ppo import optimizer
from swarmjax.ppo.config import AlgoConfig


@pytest.mark.parametrize(
    ("updates", "schedule", "actor"),
    [
        (1, "linear", 3e-4),
        (1875, "linear", 3e-4),  # 15,000 gradient steps of 8 minibatches
        (3750, "linear", 1.5e-4),
        (14_648, "linear", 3e-4 * 15_000 / 117_184),
        (937, "constant", 3e-4),  # a constant rate sums to twice as much
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
