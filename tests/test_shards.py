"""Tests that statistics of arenas spread over devices equal those of all arenas on one device.

`jax.vmap` with the mesh's axis name stands in for the devices.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from swarmjax.ppo import batch
from swarmjax.ppo.networks import Normalizer
from swarmjax.shards import AXIS, Shards

TWO = Shards(devices=2, streams=2)


def _on_two(function: Callable[..., Any], *halves: np.ndarray) -> Any:
    """Calls a function on two devices, each with half of the arrays' first axis."""
    cut = [jnp.asarray(x).reshape(2, -1, *x.shape[1:]) for x in halves]
    return jax.vmap(function, axis_name=AXIS)(*cut)


@pytest.fixture
def samples() -> tuple[np.ndarray, np.ndarray]:
    """Returns values whose halves differ strongly, and which of the values are valid."""
    values = np.concatenate([np.linspace(0.0, 1.0, 8), np.linspace(50.0, 90.0, 8)])
    valid = np.arange(16) % 5 > 0
    return values.astype(np.float32), valid


def test_moments_are_of_all_observations(samples: tuple[np.ndarray, np.ndarray]) -> None:
    values, valid = samples
    begun = Normalizer.init(1)
    found = _on_two(lambda x, v: begun.update(x[:, None], v, TWO), values, valid)
    for device in range(2):
        assert found.count[device] == valid.sum()
        np.testing.assert_allclose(found.mean[device, 0], values[valid].mean(), rtol=1e-6)
        np.testing.assert_allclose(found.variance[device, 0], values[valid].var(), rtol=1e-5)


def test_returns_are_normalised_over_all_samples(samples: tuple[np.ndarray, np.ndarray]) -> None:
    values, valid = samples
    found = _on_two(
        lambda x, v: batch.normalize(x, v, TWO, ddof=1, epsilon=1e-7), values, valid
    ).ravel()
    expected = (values - values[valid].mean()) / (values[valid].std(ddof=1) + 1e-7)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_devices_take_their_arenas_and_put_them_together() -> None:
    arenas = jnp.arange(6)
    own = jax.vmap(lambda _: TWO.local(arenas), axis_name=AXIS)(jnp.zeros(2))
    np.testing.assert_array_equal(own, [[0, 1, 2], [3, 4, 5]])
    whole = jax.vmap(lambda x: TWO.gather(x, axis=0), axis_name=AXIS)(own)
    np.testing.assert_array_equal(whole, [arenas, arenas])


def test_what_is_true_on_one_device_is_known_to_all() -> None:
    found = jax.vmap(TWO.any, axis_name=AXIS)(jnp.array([False, True]))
    np.testing.assert_array_equal(found, [True, True])


@pytest.mark.parametrize("axis", [0, 1])
def test_streams_draw_the_same_on_any_number_of_devices(axis: int) -> None:
    key = jax.random.key(3)

    def sample(key: jax.Array) -> jax.Array:
        return jax.random.normal(key, (3, 3, 5))  # three arenas of a stream along `axis`

    alone = Shards(devices=1, streams=4).draw(key, sample, axis)
    spread = Shards(devices=2, streams=4)
    found = jax.vmap(lambda _: spread.draw(key, sample, axis), axis_name=AXIS)(jnp.zeros(2))
    np.testing.assert_array_equal(np.concatenate(list(found), axis), alone)
    # No two arenas draw the same.
    assert len(np.unique(np.asarray(alone))) == alone.size


def test_one_stream_draws_with_the_key_itself() -> None:
    key = jax.random.key(3)
    found = Shards().draw(key, lambda key: jax.random.normal(key, (4,)))
    np.testing.assert_array_equal(found, jax.random.normal(key, (4,)))


def test_keys_of_devices_differ() -> None:
    key = jax.random.key(0)
    found = jax.vmap(lambda _: jax.random.key_data(TWO.own_key(key)), axis_name=AXIS)(jnp.zeros(2))
    assert np.any(found[0] != found[1])
