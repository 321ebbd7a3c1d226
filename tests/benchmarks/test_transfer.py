"""Tests the intervals and paired differences of `transfer`, worked out by hand."""

import numpy as np
import pytest

from benchmarks import transfer
from swarmjax.config import ConfigError


def test_levels_are_drawn_for_all_seeds_alike() -> None:
    # Two seeds fail on the same half of 100 levels. Their mean thus spreads like the mean of 100
    # values of 0 or 1, not of 200 values. The percentiles of a binomial distribution with n = 100
    # and p = 1/2 are 0.40 and 0.60.
    levels = np.tile([0.0, 1.0], 50)
    found = dict.fromkeys(transfer.MEASURES, np.stack([levels, levels]))
    low, high = transfer.summarize(found, found, found)["targets_reached_interval"]
    # With 2,000 resamples a percentile has an sd of 0.05 * 2.7 / 45 = 0.003, and means come in
    # steps of 0.01.
    assert low == pytest.approx(0.40, abs=0.011)
    assert high == pytest.approx(0.60, abs=0.011)


def test_differences_are_paired_by_level() -> None:
    levels = np.random.default_rng(5).random((2, 30))
    first = dict.fromkeys(transfer.MEASURES, levels)
    found = dict.fromkeys(transfer.MEASURES, levels - 0.25)
    ideal = dict.fromkeys(transfer.MEASURES, levels - 0.5)
    result = transfer.summarize(found, first, ideal)
    for name in transfer.MEASURES:
        # Every level loses 0.25, so the difference has no spread, but the mean has.
        assert result[f"{name}_change"] == pytest.approx(-0.25)
        assert result[f"{name}_change_interval"] == pytest.approx((-0.25, -0.25))
        assert result[f"{name}_realism_change"] == pytest.approx(0.25)
        low, high = result[f"{name}_interval"]
        assert low < levels.mean() - 0.25 < high
    assert result["targets_reached_by_seed"] == pytest.approx((levels.mean(axis=1) - 0.25).tolist())


def test_a_suite_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^suite is 'stages', but worlds are compared on .*\.$"):
        transfer.main(["policies=x:none.npz", "suite=stages"])


@pytest.mark.parametrize("word", ["policies=a.npz", "policies=:a.npz", "policies=x:", "stage=s6"])
def test_policies_are_labelled(word: str) -> None:
    with pytest.raises(ConfigError, match="give label:file"):
        transfer.main([word])
