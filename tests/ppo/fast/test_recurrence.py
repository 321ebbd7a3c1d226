"""Checks the memory kernels, run as ordinary JAX, against XLA's results and gradients of a GRU."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import learners
import numpy as np
import pytest

from swarmjax.ppo import dispatch, memory
from swarmjax.ppo.config import AlgoConfig
from swarmjax.ppo.fast import kernel, recurrence
from swarmjax.ppo.memory import Gru

STEPS, WIDTH, SIZE = 5, 7, 16
ROWS = 2 * recurrence.TILE + 3  # the last tile is not full
# Rounding of float32 sums of 16 to 67 products of about 1.
ROUND = 2e-6
# The GRU's input is rounded to the 8 bits of bfloat16 twice, and the slopes of the output with
# respect to it lie below 1.
BFLOAT16 = 2.0**-6


def _drawn(*shape: int, seed: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


@pytest.fixture(autouse=True)
def _interpret(monkeypatch: pytest.MonkeyPatch) -> None:
    learners.interpret_kernels(monkeypatch)


def _weights() -> recurrence._Weights:
    kernel = _drawn(SIZE, 3 * SIZE, seed=0) / 4.0
    return recurrence._Weights(kernel, _drawn(3 * SIZE, seed=1), _drawn(3 * SIZE, seed=2))


def _sequences() -> tuple[jax.Array, jax.Array, jax.Array]:
    begins = jnp.asarray(np.random.default_rng(3).random((STEPS, ROWS)) < 0.3)
    return _drawn(STEPS, ROWS, 3 * SIZE, seed=4), begins, jnp.tanh(_drawn(ROWS, SIZE, seed=5))


def _by_kernels(weights: recurrence._Weights, seen: Any, begins: Any, before: Any) -> jax.Array:
    flat = seen.reshape(-1, 3 * SIZE), begins.astype(jnp.float32).ravel(), before
    return recurrence._through(weights, recurrence._Sequences(*flat))


def _by_xla(weights: recurrence._Weights, seen: Any, begins: Any, before: Any) -> jax.Array:
    given = weights.kernel, weights.bias, seen + weights.bias_seen, begins, before
    return memory.remember_all(*given)


@pytest.fixture(
    params=[0, pytest.param(ROWS, marks=pytest.mark.slow)], ids=["large tiles", "small tiles"]
)
def tile(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets the kernels take large or small tiles."""
    monkeypatch.setattr(recurrence, "MOST_SMALL", request.param)


@pytest.mark.usefixtures("tile")
def test_memories_are_those_of_the_unit() -> None:
    found, expected = (f(_weights(), *_sequences()) for f in (_by_kernels, _by_xla))
    np.testing.assert_allclose(found, expected, rtol=0, atol=ROUND)


@pytest.mark.usefixtures("tile")
@pytest.mark.slow
def test_gradients_are_those_of_the_unit() -> None:
    seen, begins, before = _sequences()
    towards = _drawn(STEPS, ROWS, SIZE, seed=6)

    def slopes(through: Any) -> Any:
        def total(weights: Any, seen: Any, before: Any) -> jax.Array:
            return jnp.sum(towards * through(weights, seen, begins, before))

        return jax.grad(total, argnums=(0, 1, 2))(_weights(), seen, before)

    def agree(found: jax.Array, expected: jax.Array) -> None:
        largest = float(jnp.max(jnp.abs(expected)))
        np.testing.assert_allclose(found, expected, rtol=0, atol=ROUND * largest)

    jax.tree.map(agree, slopes(_by_kernels), slopes(_by_xla))


def _units() -> tuple[Gru, Gru, Any]:
    plain, fast = Gru(SIZE), Gru(SIZE, kernels=recurrence)
    seen, before = jnp.zeros((ROWS, WIDTH)), jnp.zeros((ROWS, SIZE))
    return plain, fast, plain.init(jax.random.key(0), seen, before)


def test_a_network_may_use_them_for_sequences() -> None:
    plain, fast, params = _units()
    _, begins, before = _sequences()
    given = _drawn(STEPS, ROWS, WIDTH, seed=7), before, begins
    found, expected = (unit.apply(params, *given) for unit in (fast, plain))
    np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=BFLOAT16)
    np.testing.assert_array_equal(found[1], found[0][-1])


@pytest.mark.parametrize("axes", [(ROWS,), (3, 4)])
def test_a_network_may_use_them_for_one_step(axes: tuple[int, ...]) -> None:
    plain, fast, params = _units()
    given = _drawn(*axes, WIDTH, seed=8), jnp.tanh(_drawn(*axes, SIZE, seed=9))
    found, expected = (unit.apply(params, *given)[0] for unit in (fast, plain))
    np.testing.assert_allclose(found, expected, rtol=0, atol=BFLOAT16)


def test_a_step_is_the_first_of_a_sequence() -> None:
    """Compares all bits, so that the probability ratio of a sample is 1 before any learning."""
    _, fast, params = _units()
    features, before = _drawn(1, ROWS, WIDTH, seed=7), jnp.tanh(_drawn(ROWS, SIZE, seed=9))
    whole = fast.apply(params, features, before, jnp.zeros((1, ROWS), bool))[0]
    np.testing.assert_array_equal(fast.apply(params, features[0], before)[0], whole[0])


def test_learners_have_kernels_of_their_own() -> None:
    weights = jax.tree.map(lambda x: jnp.stack([x, 2.0 * x]), _weights())
    given = _sequences()
    found = jax.vmap(lambda own: _by_kernels(own, *given))(weights)
    second = jax.tree.map(lambda x: 2.0 * x, _weights())
    np.testing.assert_allclose(found[1], _by_kernels(second, *given), rtol=0, atol=ROUND)


def test_only_many_sequences_take_large_tiles() -> None:
    assert [recurrence._tile(count) for count in (1, 8192, 8193)] == [16, 16, 32]


@pytest.mark.parametrize(
    ("size", "capability", "steps"),
    # A memory of 64 units takes 131,072 bytes, and the inputs of two further steps 73,728.
    [(64, "9.0", 3), (64, "8.0", 1), (32, "8.0", 3)],
)
def test_a_small_chip_has_one_step_in_flight(size: int, capability: str, steps: int) -> None:
    assert recurrence._stages(size, kernel._MORE_SHARED_MEMORY[capability]) == steps


class TestWhereTheyAreUsed:
    """Tests of `dispatch.memory_kernels`."""

    CONFIG = AlgoConfig(memory="gru", memory_size=32)

    def bound(self, monkeypatch: pytest.MonkeyPatch, config: AlgoConfig, gpu: bool) -> Any:
        capability = "9.0" if gpu else ""
        monkeypatch.setattr(
            jax, "devices", lambda: [SimpleNamespace(compute_capability=capability)]
        )
        return dispatch.memory_kernels(config)

    def test_on_a_gpu(self, monkeypatch: pytest.MonkeyPatch) -> None:
        assert self.bound(monkeypatch, self.CONFIG, gpu=True) is recurrence

    def test_not_elsewhere(self, monkeypatch: pytest.MonkeyPatch) -> None:
        assert self.bound(monkeypatch, self.CONFIG, gpu=False) is None

    @pytest.mark.parametrize(
        "config",
        [
            AlgoConfig(),
            AlgoConfig(memory="gru", memory_size=48),
            AlgoConfig(memory="gru", update_backend="autodiff"),
        ],
    )
    def test_not_for_what_they_do_not_take(
        self, monkeypatch: pytest.MonkeyPatch, config: AlgoConfig
    ) -> None:
        assert self.bound(monkeypatch, config, gpu=True) is None

    def test_not_in_full_precision(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with jax.default_matmul_precision("highest"):
            assert self.bound(monkeypatch, self.CONFIG, gpu=True) is None
