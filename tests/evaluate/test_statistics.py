"""Tests statistics by hand, against SciPy, and by the coverage that intervals promise."""

import math
import tracemalloc
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy import stats

from swarmjax.evaluate import statistics
from swarmjax.evaluate.statistics import (
    bootstrap,
    curve,
    cvar,
    iqm,
    paired,
    probability_of_improvement,
)

ROUNDING = 1e-12  # for sums of numbers up to 100 in double precision, added in another order
FINITE = st.floats(-100, 100, width=32)
LISTS = arrays(np.float64, st.integers(1, 40), elements=FINITE)
TABLES = arrays(np.float64, st.tuples(st.integers(3, 6), st.integers(1, 3)), elements=FINITE)
DRAWS = ("runs", "tasks", "runs_and_tasks")
few = settings(max_examples=30, deadline=None)


def _refusal(function, *arguments, **options) -> str:
    """Returns the message with which a call is refused; checks that it is one sentence."""
    with pytest.raises(ValueError, match=r"^[^\n]*\.$") as caught:
        function(*arguments, **options)
    return str(caught.value)


def _end_error(resamples: int, sd: float) -> float:
    """Returns four standard errors of an end of a 95 % interval over normal resamples.

    The 2.5th percentile of n draws has the sd sqrt(0.025 * 0.975 / n) / density. The normal density
    at this percentile is 0.0584 / sd.
    """
    return float(4 * math.sqrt(0.025 * 0.975 / resamples) / stats.norm.pdf(1.96) * sd)


def test_iqm_by_hand() -> None:
    # Of eight values, two are cut off at either end: (3 + 4 + 5 + 6) / 4.
    assert iqm([8.0, 1.0, 100.0, 3.0, 4.0, 5.0, 6.0, 2.0]) == 4.5
    # A quarter of seven values is 1.75, so one is cut off at either end: (2 + 3 + 4 + 5 + 6) / 5.
    assert iqm([7.0, 1.0, 6.0, 2.0, 5.0, 3.0, 4.0]) == 4.0
    # Of three values, none is cut off.
    assert iqm([0.0, 0.0, 9.0]) == 3.0
    assert iqm([True, True, False, False, True]) == pytest.approx(2 / 3, abs=ROUNDING)


@few
@given(arrays(np.float64, array_shapes(min_dims=2, max_dims=2, max_side=13), elements=FINITE))
def test_iqm_is_the_trimmed_mean_of_scipy(x: np.ndarray) -> None:
    for axis in (None, 0, 1):
        expected = stats.trim_mean(x, 0.25, axis=axis)
        np.testing.assert_allclose(iqm(x, axis=axis), expected, rtol=0, atol=ROUNDING)
    stack = np.stack([x, 2 * x])
    both = [stats.trim_mean(x, 0.25, axis=None), stats.trim_mean(2 * x, 0.25, axis=None)]
    np.testing.assert_allclose(iqm(stack, axis=(1, 2)), both, rtol=0, atol=ROUNDING)


@few
@given(LISTS, st.randoms(use_true_random=False))
def test_order_does_not_matter(x: np.ndarray, random) -> None:
    mixed = np.array(random.sample(x.tolist(), len(x)))
    assert iqm(mixed) == pytest.approx(iqm(x), abs=ROUNDING)
    assert cvar(mixed, 0.3) == pytest.approx(cvar(x, 0.3), abs=ROUNDING)


@pytest.mark.parametrize(
    ("infinite", "expected"),
    # Of eight values, two are cut off at either end. With two infinite values, 3, 4, 5 and 6 are
    # left.
    [(2, 4.5), (3, math.inf), (8, math.inf)],
)
def test_iqm_is_infinite_with_more_than_a_quarter(infinite: int, expected: float) -> None:
    assert iqm([*range(1, 9 - infinite), *[math.inf] * infinite]) == expected


def test_cvar_by_hand() -> None:
    x = np.array([[5.0, 1.0, 4.0, 2.0, 3.0], [10.0, 30.0, 20.0, 50.0, 40.0]])
    np.testing.assert_array_equal(cvar(x, 0.4, axis=1), [1.5, 15.0])
    np.testing.assert_array_equal(cvar(x, 0.4, axis=1, lowest=False), [4.5, 45.0])
    # 0.41 * 5 = 2.05 is rounded up to three of five values, and 0.05 * 5 = 0.25 to one value.
    np.testing.assert_array_equal(cvar(x, 0.41, axis=1), [2.0, 20.0])
    np.testing.assert_array_equal(cvar(x, axis=1), [1.0, 10.0])
    # The lowest four of all ten values are 1, 2, 3 and 4.
    assert cvar(x, 0.4) == 2.5
    assert cvar(x, 1.0) == x.mean()
    # 0.07 * 100 is 7.000000000000001 in double precision, but counts as seven values, 0 to 6.
    assert cvar(np.arange(100.0), 0.07) == 3.0
    # At least one value is left, however small the share is.
    assert cvar(np.arange(1.0, 9.0), 1e-12) == 1.0


def test_cvar_finds_the_worst_of_many() -> None:
    x = np.random.default_rng(20).permutation(np.arange(10_000.0)).reshape(20, 500)
    # The lowest 500 values are 0, ..., 499, and the highest 500 values are 9500, ..., 9999.
    assert cvar(x) == 249.5
    assert cvar(x, lowest=False) == 9749.5


def test_cvar_takes_infinity_as_the_largest() -> None:
    x = [3.0, math.inf, 1.0, 2.0]
    assert cvar(x, 0.75) == 2.0
    assert cvar(x, 0.25, lowest=False) == math.inf


@pytest.mark.parametrize("function", [iqm, cvar])
def test_estimates_refuse(function) -> None:
    assert "x is empty" in _refusal(function, [])
    assert "x holds nan: 1 of 2 values" in _refusal(function, [math.nan, 1.0])
    assert "x holds -inf" in _refusal(function, [-math.inf, 1.0])


@pytest.mark.parametrize("share", [0.0, -0.1, 1.1, math.nan])
def test_cvar_refuses_a_share_of_nothing(share: float) -> None:
    assert f"share is {share}" in _refusal(cvar, [1.0, 2.0], share)


def test_interval_of_one_column_is_that_of_scipy() -> None:
    values = np.random.default_rng(1).exponential(size=40)
    found = bootstrap(values[:, None], iqm, resamples=20_000)
    expected = stats.bootstrap(
        (values,),
        partial(stats.trim_mean, proportiontocut=0.25),
        n_resamples=20_000,
        method="percentile",
        rng=2,
    )
    # Both intervals have a Monte Carlo error, so their difference has sqrt(2) times this error.
    error = math.sqrt(2) * _end_error(20_000, expected.standard_error)
    assert found.estimate == pytest.approx(stats.trim_mean(values, 0.25), abs=ROUNDING)
    assert found.low == pytest.approx(expected.confidence_interval.low, abs=error)
    assert found.high == pytest.approx(expected.confidence_interval.high, abs=error)
    # The error is a small part of the width, so the comparison is meaningful.
    assert 10 * error < found.high - found.low


def _variance(values: np.ndarray, draw: str) -> float:
    """Returns the variance of a resample's mean, worked out for each kind of draw.

    The mean of n draws from a set has the variance of the set divided by n. For `runs_and_tasks`,
    the weights of rows and columns are independent. So the residuals, without the
    effects of rows and columns, are drawn like n m values.
    """
    runs, tasks = values.shape
    by_run, by_task = values.mean(axis=1), values.mean(axis=0)
    rest = values - by_run[:, None] - by_task + values.mean()
    return {
        "runs": by_run.var() / runs,
        "tasks": by_task.var() / tasks,
        "runs_and_tasks": by_run.var() / runs + by_task.var() / tasks + rest.var() / values.size,
    }[draw]


@pytest.mark.parametrize("draw", DRAWS)
def test_each_draw_spreads_as_worked_out(draw) -> None:
    random = np.random.default_rng(5)
    rows, columns, rest = (random.normal(size=size) for size in ((15, 1), 12, (15, 12)))
    values = 1.2 * rows + columns + 3 * rest
    found = bootstrap(values, np.mean, draw=draw, resamples=20_000)
    sd = math.sqrt(_variance(values, draw))
    # With 20,000 draws a width is off by at most 0.03 (0.076 sd at each end of 3.92 sd), and by
    # another 0.01 because means of 12 draws or more are not quite normal. The widths of two kinds
    # of draw differ by at least 0.08.
    expected = pytest.approx(2 * 1.96 * sd, rel=0.04)
    assert found.high - found.low == expected
    others = [2 * 1.96 * math.sqrt(_variance(values, other)) for other in DRAWS if other != draw]
    assert not any(other == expected for other in others)


@pytest.mark.parametrize(
    ("draw", "by_runs", "by_tasks"),
    [
        ("runs", True, False),
        ("tasks", False, True),
        ("runs_and_tasks", True, True),
    ],
)
def test_what_is_kept_spreads_nothing(draw, by_runs: bool, by_tasks: bool) -> None:
    runs = np.repeat([[0.0], [1.0], [2.0]], 4, axis=1)
    assert (bootstrap(runs, np.mean, draw=draw)[1:] != (1.0, 1.0)) is by_runs
    assert (bootstrap(runs.T, np.mean, draw=draw)[1:] != (1.0, 1.0)) is by_tasks


def test_ends_are_the_outer_draws() -> None:
    # With 81 resamples and 95 %, the percentiles are the sorted resamples 0.025 * 80 = 2 and 78.
    # With 90 resamples they are at 2.225 and 86.775, so 2 and 87 are taken. The statistic returns
    # the number of each resample.
    def number(x: np.ndarray, *, axis: tuple[int, int]) -> np.ndarray:
        return np.arange(len(x)) if x.ndim == 3 else np.mean(x, axis=axis)

    values = np.zeros((3, 1))
    assert bootstrap(values, number, resamples=81) == (0.0, 2.0, 78.0)
    assert bootstrap(values, number, resamples=90) == (0.0, 2.0, 87.0)


def test_interval_does_not_depend_on_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(7).normal(size=(6, 4))
    whole = bootstrap(values, iqm, resamples=1000)
    # A block has seven resamples, and the last block has six. The draws stay the same.
    monkeypatch.setattr(statistics, "BLOCK", 7 * 24)
    assert bootstrap(values, iqm, resamples=1000) == whole


def test_memory_is_bounded() -> None:
    values = np.random.default_rng(8).normal(size=(10, 1000))
    tracemalloc.start()
    try:
        bootstrap(values, iqm, draw="runs_and_tasks")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # All 2000 resamples at once would take 160 MB, and twice as much with their indices.
    assert peak < 100e6


def test_interval_covers_as_often_as_theory_says() -> None:
    """The percentile interval of a mean is about mean +- 1.96 sd / sqrt(n).

    This sd has no Bessel correction. The interval thus covers the true mean if |t|, with n - 1
    degrees of freedom, is below 1.96 sqrt((n - 1) / n).
    """
    random, runs, sets = np.random.default_rng(9), 10, 300
    covered = 0
    for _ in range(sets):
        values = random.normal(loc=2.0, size=(runs, 1))
        found = bootstrap(values, np.mean, resamples=500)
        covered += found.low <= 2.0 <= found.high
    share = 2 * stats.t.cdf(1.96 * math.sqrt((runs - 1) / runs), runs - 1) - 1
    assert share == pytest.approx(0.904, abs=0.001)
    # A binomial count of 300 sets lies beyond each of these two ends once in 10,000 times.
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], sets, share)
    assert low <= covered <= high


def test_shared_levels_take_draws_of_whole_tasks() -> None:
    # Three runs that agree on every level contain no more information about levels than one run.
    levels = np.random.default_rng(10).normal(size=400)
    shared = bootstrap(np.tile(levels, (3, 1)), np.mean, draw="tasks")
    alone = bootstrap(levels[None], np.mean, draw="tasks")
    assert shared == pytest.approx(alone, abs=ROUNDING)


@pytest.mark.parametrize("finite", [2, 7, 10])
def test_interval_of_infinite_values(finite: int) -> None:
    values = np.array([*range(1, 1 + finite), *[math.inf] * (10 - finite)])[:, None]
    for statistic in (iqm, np.median, np.mean):
        found = bootstrap(values, statistic)
        assert not np.isnan(found).any()
        assert found.low <= found.estimate <= found.high
    found = bootstrap(values, iqm)
    # Two of ten values are cut off at either end. With 2 finite values, a resample's mean is finite
    # if at least 8 of its values are finite, which has a probability of 8e-5. With 7 finite values,
    # it is infinite if at least 3 of its values are infinite, which has a probability of 0.62.
    assert math.isinf(found.low) is (finite == 2)
    assert math.isinf(found.estimate) is (finite != 10)
    assert math.isinf(found.high) is (finite != 10)


@few
@given(TABLES)
def test_interval_moves_and_stretches_with_the_values(values: np.ndarray) -> None:
    found = np.array(bootstrap(values, iqm, resamples=200))
    moved = bootstrap(2 * values + 3, iqm, resamples=200)
    np.testing.assert_allclose(moved, 2 * found + 3, rtol=0, atol=10 * ROUNDING)
    assert values.min() - ROUNDING <= found.min()
    assert found.max() <= values.max() + ROUNDING


@pytest.mark.parametrize(
    ("shape", "options", "expected"),
    [
        ((5,), {}, "values has shape (5,): give an array of shape [runs, tasks]"),
        ((0, 3), {}, "values is empty"),
        ((2, 9), {}, "values has 2 runs: an interval over runs needs 3 or more"),
        ((9, 2), {"draw": "tasks"}, "values has 2 tasks"),
    ],
)
def test_bootstrap_refuses(shape, options, expected: str) -> None:
    assert expected in _refusal(bootstrap, np.ones(shape), np.mean, **options)


def test_bootstrap_takes_the_least_there_may_be() -> None:
    assert bootstrap(np.ones((3, 1)), np.mean, resamples=40) == (1, 1, 1)
    assert bootstrap(np.ones((1, 3)), np.mean, draw="tasks", resamples=40) == (1, 1, 1)


def test_paired_is_what_scipy_pairs() -> None:
    random = np.random.default_rng(11)
    a = random.normal(size=50)
    b = a + random.exponential(0.3, size=50)

    def difference(x: np.ndarray, y: np.ndarray, axis: int) -> np.ndarray:
        return stats.trim_mean(y, 0.25, axis=axis) - stats.trim_mean(x, 0.25, axis=axis)

    found = paired(a[:, None], b[:, None], iqm, resamples=20_000)
    expected = stats.bootstrap(
        (a, b),
        difference,
        paired=True,
        vectorized=True,
        n_resamples=20_000,
        method="percentile",
        rng=12,
    )
    error = math.sqrt(2) * _end_error(20_000, expected.standard_error)
    assert found.estimate == pytest.approx(difference(a, b, 0), abs=ROUNDING)
    assert found.low == pytest.approx(expected.confidence_interval.low, abs=error)
    assert found.high == pytest.approx(expected.confidence_interval.high, abs=error)
    assert 10 * error < found.high - found.low


@pytest.mark.parametrize("draw", DRAWS)
def test_pairs_share_their_draws(draw) -> None:
    a = np.random.default_rng(13).normal(size=(4, 5))
    # Every value gains 0.25, so the difference has no spread for any draw.
    assert paired(a, a + 0.25, iqm, draw=draw) == pytest.approx((0.25, 0.25, 0.25), abs=ROUNDING)


def test_paired_refuses() -> None:
    a, b = np.ones((3, 2)), np.ones((3, 2))
    b[1, 1] = math.inf
    assert "b holds inf" in _refusal(paired, a, b, iqm)
    assert "a holds inf" in _refusal(paired, b, a, iqm)
    assert "a is (3, 2) and b is (4, 2)" in _refusal(paired, a, np.ones((4, 2)), iqm)
    assert "b has 2 runs" in _refusal(paired, a, a[:2], iqm)


def test_improvement_by_hand() -> None:
    a = np.array([[1.0, 5.0], [2.0, 5.0], [3.0, 5.0]])
    b = np.array([[2.0, 4.0], [2.0, 5.0], [0.0, 6.0], [9.0, 6.0]])
    # On the first task 1 beats 0, 2 beats 0 and ties twice, and 3 beats 2, 2 and 0:
    # (1 + 2 + 3) / 12. On the second task each 5 beats 4 and ties once: 3 * 1.5 / 12.
    found = probability_of_improvement(a, b)
    assert found.estimate == pytest.approx((6 / 12 + 4.5 / 12) / 2, abs=ROUNDING)
    assert 0 <= found.low < found.estimate < found.high <= 1


def test_improvement_is_certain_where_all_are_better() -> None:
    a, b = np.array([[4.0], [5.0], [6.0]]), np.array([[1.0], [2.0], [3.0]])
    assert probability_of_improvement(a, b) == (1, 1, 1)
    assert probability_of_improvement(b, a) == (0, 0, 0)
    # Infinite steps (never reached) are more than any number of steps, and tie with each other.
    never = np.full((3, 1), math.inf)
    assert probability_of_improvement(never, a) == (1, 1, 1)
    assert probability_of_improvement(never, never) == (0.5, 0.5, 0.5)


@few
@given(
    arrays(np.float64, st.tuples(st.integers(3, 6), st.just(2)), elements=st.integers(0, 5)),
    arrays(np.float64, st.tuples(st.integers(3, 6), st.just(2)), elements=st.integers(0, 5)),
)
def test_improvement_is_the_u_of_mann_and_whitney(a: np.ndarray, b: np.ndarray) -> None:
    found = probability_of_improvement(a, b, resamples=50).estimate
    u = [stats.mannwhitneyu(a[:, i], b[:, i], method="asymptotic")[0] for i in range(2)]
    assert found == pytest.approx(np.mean(u) / (len(a) * len(b)), abs=ROUNDING)
    reverse = probability_of_improvement(b, a, resamples=50).estimate
    assert found + reverse == pytest.approx(1, abs=ROUNDING)


def test_improvement_interval_is_that_of_scipy() -> None:
    random = np.random.default_rng(14)
    a, b = random.normal(0.5, size=15), random.normal(size=20)

    def improvement(x: np.ndarray, y: np.ndarray, axis: int) -> np.ndarray:
        x, y = np.moveaxis(x, axis, -1), np.moveaxis(y, axis, -1)
        return (x[..., :, None] > y[..., None, :]).mean(axis=(-2, -1))

    found = probability_of_improvement(a[:, None], b[:, None], resamples=20_000)
    # No value of a is a value of b, so resamples have no ties.
    expected = stats.bootstrap(
        (a, b), improvement, vectorized=True, n_resamples=20_000, method="percentile", rng=15
    )
    # Means over 15 * 20 pairs are multiples of 1 / 300, and an end is one of these multiples.
    error = math.sqrt(2) * _end_error(20_000, expected.standard_error) + 1 / 300
    assert found.low == pytest.approx(expected.confidence_interval.low, abs=error)
    assert found.high == pytest.approx(expected.confidence_interval.high, abs=error)
    assert 10 * error < found.high - found.low


def test_improvement_does_not_depend_on_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(17)
    a, b = random.normal(size=(4, 2)), random.normal(size=(5, 2))
    whole = probability_of_improvement(a, b)
    monkeypatch.setattr(statistics, "BLOCK", 1)
    one_by_one = probability_of_improvement(a, b)
    assert one_by_one.estimate == whole.estimate
    # The draws of a and b alternate, so other blocks give other draws from the same distribution.
    # Each end is off by its Monte Carlo error; the sd is a quarter of the width.
    error = math.sqrt(2) * _end_error(2000, (whole.high - whole.low) / 4)
    assert one_by_one[1:] == pytest.approx(whole[1:], abs=error + 1 / 40)


def test_improvement_refuses() -> None:
    three = np.ones((3, 2))
    assert "b has 2 runs" in _refusal(probability_of_improvement, three, three[:2])
    assert "a has 2 tasks and b has 1" in _refusal(probability_of_improvement, three, three[:, :1])
    found = _refusal(probability_of_improvement, three, three, draw="tasks")
    assert "a has 2 tasks" in found
    assert "a holds nan" in _refusal(probability_of_improvement, three * math.nan, three)


def test_improvement_over_levels_is_a_bootstrap_of_their_shares() -> None:
    """With one run of each on shared levels, P is the mean of 1, 1/2 or 0 over the levels."""
    random = np.random.default_rng(19)
    a, b = random.integers(3, size=(1, 60)), random.integers(3, size=(1, 60))
    found = probability_of_improvement(a, b, draw="tasks")
    wins = (a > b) + 0.5 * (a == b)
    assert found == bootstrap(wins, np.mean, draw="tasks")


def test_improvement_over_runs_and_levels_spreads_as_both() -> None:
    """If all runs are equal, only levels cause spread; if all levels are equal, only runs do."""
    random = np.random.default_rng(20)
    levels = random.normal(size=(1, 50))
    a, b = levels.repeat(3, axis=0), np.zeros((4, 50))
    both = probability_of_improvement(a, b, draw="runs_and_tasks")
    alone = probability_of_improvement(a[:1], b[:1], draw="tasks")
    # The draws differ but have the same distribution. The sd is a quarter of the width, and values
    # come in steps of 1/50.
    error = math.sqrt(2) * _end_error(2000, (alone.high - alone.low) / 4)
    assert both[1:] == pytest.approx(alone[1:], abs=error + 1 / 50)
    runs = random.normal(size=(7, 1)).repeat(50, axis=1)
    both = probability_of_improvement(runs, b, draw="runs_and_tasks")
    kept = probability_of_improvement(runs, b, draw="runs")
    error = math.sqrt(2) * _end_error(2000, (kept.high - kept.low) / 4)
    assert both[1:] == pytest.approx(kept[1:], abs=error + 1 / 7)


# --- strata


def test_tasks_are_drawn_within_their_strata() -> None:
    """If the values within each stratum are equal, the interval has no width.

    This holds however far apart the strata are.
    """
    values = np.repeat([0.0, 5.0, 7.0], [4, 3, 5])[None]
    found = bootstrap(values, np.mean, draw="tasks", strata=[4, 3, 5])
    assert found == pytest.approx((values.mean(),) * 3)
    assert bootstrap(values, np.mean, draw="tasks").low < values.mean() - 0.5


def test_the_spread_over_strata_is_that_of_scipy() -> None:
    random = np.random.default_rng(21)
    first, second = random.normal(size=30), 3.0 * random.normal(size=50)

    def mean(x: np.ndarray, y: np.ndarray, axis: int = -1) -> np.ndarray:
        return (x.sum(axis=axis) + y.sum(axis=axis)) / (x.shape[axis] + y.shape[axis])

    theirs = stats.bootstrap(
        (first, second), mean, n_resamples=20_000, method="percentile", rng=1
    ).confidence_interval
    values = np.concatenate([first, second])[None]
    mine = bootstrap(values, np.mean, draw="tasks", strata=[30, 50], resamples=20_000)
    error = math.sqrt(2) * _end_error(20_000, (mine.high - mine.low) / 4)
    assert mine[1:] == pytest.approx(tuple(theirs), abs=error)


def test_pairs_and_improvement_take_strata() -> None:
    a = np.repeat([0.0, 5.0], [4, 6])[None]
    b = a + np.repeat([1.0, -2.0], [4, 6])
    found = paired(a, b, np.mean, draw="tasks", strata=[4, 6])
    assert found == pytest.approx((-0.8,) * 3)
    chance = probability_of_improvement(a, b, draw="tasks", strata=[4, 6])
    assert chance == pytest.approx((0.6,) * 3)


def test_curve_is_an_interval_at_each_point() -> None:
    values = np.random.default_rng(18).normal(size=(7, 4))
    found = curve(values, np.mean, resamples=500)
    np.testing.assert_allclose(found.estimate, values.mean(axis=0), rtol=0, atol=ROUNDING)
    for i in range(4):
        alone = bootstrap(values[:, i : i + 1], np.mean, resamples=500)
        assert (found.low[i], found.high[i]) == (alone.low, alone.high)


def test_curve_draws_runs_with_all_their_points() -> None:
    # In every run the second point is twice the first, so each end of its band is also twice the
    # first point's end.
    values = np.random.default_rng(19).normal(size=(6, 1)) * [1.0, 2.0]
    found = curve(values)
    assert found.low[1] == pytest.approx(2 * found.low[0], abs=ROUNDING)
    assert found.high[1] == pytest.approx(2 * found.high[0], abs=ROUNDING)
    assert found.estimate[0] == pytest.approx(stats.trim_mean(values[:, 0], 0.25), abs=ROUNDING)


def test_curve_refuses() -> None:
    assert "values has shape (3,)" in _refusal(curve, np.ones(3))
    assert "values has 2 runs" in _refusal(curve, np.ones((2, 5)))
    assert "values is empty" in _refusal(curve, np.ones((5, 0)))
