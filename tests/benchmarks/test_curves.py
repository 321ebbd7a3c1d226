"""Tests figures of learning curves."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks.curves import area_under, steps_to
from swarmjax.evaluate.statistics import iqm

ROUNDING = 1e-12  # for sums of numbers up to 100 in double precision, added in another order
FINITE = st.floats(-100, 100, width=32)
few = settings(max_examples=30, deadline=None)


def _refusal(function, *arguments) -> str:
    """Returns the message with which a call is refused; checks that it is one sentence."""
    with pytest.raises(ValueError, match=r"^[^\n]*\.$") as caught:
        function(*arguments)
    return str(caught.value)


def test_area_by_hand() -> None:
    # From 1 to 3 in 4 steps the area is 8, and from 3 to 0 in 6 steps it is 9: 17 over 10 steps.
    values = [[1.0, 3.0, 0.0], [2.0, 2.0, 2.0]]
    np.testing.assert_allclose(area_under([0, 4, 10], values), [1.7, 2.0], rtol=0, atol=ROUNDING)
    assert area_under([100, 104, 110], values[0]) == pytest.approx(1.7, abs=ROUNDING)


def test_steps_to_by_hand() -> None:
    # A curve may fall below 0.6 again after it has first reached 0.6.
    curves = [
        [0.0, 0.4, 0.8, 0.2],  # 0.6 is half way from 0.4 to 0.8: 10 + 0.5 * 20.
        [0.0, 0.6, 0.6, 0.6],  # At the point itself.
        [0.7, 0.0, 0.0, 0.9],  # From the first step on.
        [0.0, 0.1, 0.2, 0.3],  # Never.
        [0.5, 0.5, 0.5, 0.7],  # 0.6 is half way from 0.5 to 0.7: 30 + 0.5 * 10
    ]
    found = steps_to([0, 10, 30, 40], curves, 0.6)
    np.testing.assert_allclose(found, [20, 10, 0, math.inf, 35], rtol=0, atol=ROUNDING)
    # Of 0, 10, 20, 35 and inf, one value is cut off at either end: (10 + 20 + 35) / 3.
    assert iqm(found) == pytest.approx(65 / 3, abs=ROUNDING)


@few
@given(arrays(np.float64, st.integers(2, 12), elements=FINITE), st.floats(-110, 110))
def test_steps_to_is_where_the_curve_first_is_at_the_threshold(values, threshold: float) -> None:
    steps = np.arange(len(values)) ** 2 + 5.0
    found = float(steps_to(steps, values, threshold))
    if found == math.inf:
        assert values.max() < threshold
    else:
        assert (values[steps < found - ROUNDING * 100] < threshold).all()
        # Steps go up to 126 and slopes up to 200 per step, so an error of 1e-14 of the steps is
        # multiplied by 200.
        height = np.interp(found, steps, values)
        expected = max(threshold, values[0])
        assert height == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("steps", "values", "expected"),
    [
        ([0], [1.0], "steps of shape (1,)"),
        ([0, 0], [1.0, 2.0], "steps of shape (2,) must be two or more numbers that rise"),
        ([[0, 1], [2, 3]], [[1.0, 2.0], [3.0, 4.0]], "steps of shape (2, 2)"),
        ([0, 1], [1.0, 2.0, 3.0], "values has shape (3,): give [..., 2]"),
        ([0, 1], 1.0, "values has shape (): give [..., 2]"),
        ([0, 1], [math.nan, 1.0], "values holds nan"),
        ([0, 1], [math.inf, 1.0], "values holds inf"),
        ([0, math.inf], [1.0, 1.0], "steps holds inf"),
    ],
)
def test_curves_are_refused(steps, values, expected: str) -> None:
    assert expected in _refusal(area_under, steps, values)
    assert expected in _refusal(steps_to, steps, values, 0.5)


@pytest.mark.parametrize("threshold", [math.nan, math.inf])
def test_steps_to_refuses_a_threshold_that_is_none(threshold: float) -> None:
    assert "threshold is" in _refusal(steps_to, [0, 1], [0.0, 1.0], threshold)
