"""Tests the order of objects by distance, against NumPy's stable sort."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from swarmjax.task.nearest import nearest

# Few different distances, so that many are equal.
DISTANCES = arrays.arrays(
    np.float32,
    st.tuples(st.just(3), st.integers(1, 9)),
    elements=st.sampled_from([0, 1, 2, np.inf]),
)


@given(DISTANCES, st.data())
@pytest.mark.slow
def test_it_is_that_of_a_stable_sort(distance: np.ndarray, data: st.DataObject) -> None:
    count = data.draw(st.integers(1, distance.shape[1]))
    expected = np.argsort(distance, axis=-1, stable=True)[:, :count]
    np.testing.assert_array_equal(nearest(jnp.asarray(distance), count), expected)


# 64 objects are the most that are counted; 65 are sorted.
@pytest.mark.parametrize("objects", [64, 65])
def test_long_rows_have_the_same_order(objects: int) -> None:
    distance = np.random.default_rng(0).integers(0, 9, (2, objects)).astype(np.float32)
    expected = np.argsort(distance, axis=-1, stable=True)[:, :50]
    np.testing.assert_array_equal(jax.jit(lambda x: nearest(x, 50))(distance), expected)


def test_jax_gives_the_same_order() -> None:
    distance = np.float32([[0.3, 0.1, np.inf, 0.1], [2.0, 1.0, 0.5, 0.0]])
    found = jax.jit(lambda x: nearest(x, 3))(distance)
    np.testing.assert_array_equal(found, [[1, 3, 0], [3, 2, 1]])
