"""Checks which backend computes an update, and that autodiff replaces missing faster backends."""

from types import SimpleNamespace

import jax
import learners
import pytest

from swarmjax.ppo import dispatch
from swarmjax.ppo.config import AlgoConfig

OBSERVATION, ACTION = 10, 2


def _on(monkeypatch: pytest.MonkeyPatch, **device: str) -> None:
    monkeypatch.setattr(jax, "devices", lambda: [SimpleNamespace(**device)])


def _resolve(config: AlgoConfig, observation: int = OBSERVATION) -> str:
    nets = learners.nets(config, observation, ACTION)
    return dispatch.resolve(config, nets, nets.actor.sizes)


@pytest.mark.parametrize(
    ("device", "choice"),
    [
        ({}, "autodiff"),
        ({"compute_capability": "gfx942"}, "autodiff"),
        ({"compute_capability": "7.5"}, "autodiff"),
        ({"compute_capability": "8.0"}, "fused"),
        ({"compute_capability": "12.0"}, "fused"),
    ],
)
def test_auto_is_fused_on_an_nvidia_gpu_where_the_layers_fit(
    device: dict[str, str], choice: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _on(monkeypatch, **device)
    assert _resolve(AlgoConfig()) == choice
    assert _resolve(AlgoConfig(update_backend="autodiff")) == "autodiff"
    assert _resolve(AlgoConfig(hidden_sizes=(8,))) == "autodiff"


def test_a_whole_batch_is_taken_in_blocks_on_a_cpu_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = AlgoConfig(num_minibatches=1)
    assert _resolve(whole) == "blocks"
    assert _resolve(AlgoConfig(num_minibatches=2)) == "autodiff"
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert _resolve(whole) == "autodiff"
    _on(monkeypatch, compute_capability="9.0")
    assert _resolve(whole) == "fused"


def test_full_precision_is_left_to_autodiff(monkeypatch: pytest.MonkeyPatch) -> None:
    _on(monkeypatch, compute_capability="9.0")
    with jax.default_matmul_precision("highest"):
        assert _resolve(AlgoConfig()) == "autodiff"
    with jax.default_matmul_precision("tensorfloat32"):
        assert _resolve(AlgoConfig()) == "fused"


def test_an_observation_too_large_for_the_chip_has_autodiff(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _on(monkeypatch, compute_capability="9.0")
    # The kernels take at most 128 numbers, after padding.
    assert _resolve(AlgoConfig()) == "fused"
    assert _resolve(AlgoConfig(), 13 * OBSERVATION) == "autodiff"


def test_a_critic_that_sees_the_state_has_autodiff(monkeypatch: pytest.MonkeyPatch) -> None:
    _on(monkeypatch, compute_capability="9.0")
    assert _resolve(AlgoConfig()) == "fused"
    assert _resolve(AlgoConfig(critic="state")) == "autodiff"


def test_a_memory_is_trained_in_sequences_on_any_device(monkeypatch: pytest.MonkeyPatch) -> None:
    config = AlgoConfig(memory="gru", num_minibatches=1)
    asked = AlgoConfig(memory="gru", update_backend="autodiff")
    assert _resolve(config) == "sequences"
    assert _resolve(asked) == "autodiff"
    _on(monkeypatch, compute_capability="9.0")
    assert _resolve(config) == "sequences"
    assert _resolve(asked) == "autodiff"


def test_each_faster_way_has_its_code() -> None:
    for backend in ("blocks", "fused", "sequences"):
        assert callable(dispatch.find(backend))
