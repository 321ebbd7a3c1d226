"""What transfers: intervals and paired differences, worked out by hand and against SciPy."""

import numpy as np
import pytest
from scipy import stats

from benchmarks import transfer
from swarmjax.config import ConfigError


def test_interval_is_that_of_a_percentile_bootstrap() -> None:
    values = np.random.default_rng(3).exponential(size=(1, 400))
    low, high = transfer.interval(values)
    found = stats.bootstrap((values[0],), np.mean, n_resamples=20_000, method="percentile", rng=4)
    expected = found.confidence_interval
    # 2,000 resamples place a percentile of these means (sd 0.05) to within 0.05 * 2.7 / 45 = 3e-3
    # at one sd (2.7: density of the normal at its 2.5th percentile, 0.058, against 0.156).
    assert low == pytest.approx(expected.low, abs=0.01)
    assert high == pytest.approx(expected.high, abs=0.01)


def test_interval_draws_within_each_seed() -> None:
    # Seeds that differ while their levels do not: no level can change the mean.
    assert transfer.interval(np.repeat([[0.0], [1.0]], 50, axis=1)) == (0.5, 0.5)


def test_differences_are_paired_by_level() -> None:
    levels = np.random.default_rng(5).random((2, 30))
    first = dict.fromkeys(transfer.MEASURES, levels)
    found = dict.fromkeys(transfer.MEASURES, levels - 0.25)
    result = transfer.summarize(found, first)
    for name in transfer.MEASURES:
        # Every level loses a quarter, so the difference has no spread, and the mean has.
        assert result[f"{name}_change"] == pytest.approx(-0.25)
        assert result[f"{name}_change_interval"] == pytest.approx((-0.25, -0.25))
        low, high = result[f"{name}_interval"]
        assert low < levels.mean() - 0.25 < high
    assert result["targets_reached_by_seed"] == pytest.approx((levels.mean(axis=1) - 0.25).tolist())


@pytest.mark.parametrize("word", ["policies=a.npz", "policies=:a.npz", "policies=x:", "stage=s6"])
def test_policies_are_labelled(word: str) -> None:
    with pytest.raises(ConfigError, match="give label:file"):
        transfer.main([word])
