"""Tests the statistics of two programs timed in turn, and the arms of `curriculum_cost`."""

import math

import numpy as np
import pytest

from benchmarks import curriculum_cost, pairs
from swarmjax.run.load_settings import load_train


class Clock:
    """Stands in for an arm; each call takes 1 s per update longer than the call before."""

    def __init__(self, calls: list[str], name: str) -> None:
        self.calls, self.name, self.count = calls, name, 0

    def time(self, updates: int) -> float:
        """Counts the call and returns its seconds."""
        self.calls.append(self.name)
        self.count += 1
        return float(updates * self.count)


def test_which_comes_first_alternates_and_the_first_call_is_not_counted() -> None:
    calls: list[str] = []
    one, other = Clock(calls, "a"), Clock(calls, "b")
    times = pairs.time_in_turn(one, other, 10, 3)  # type: ignore[arg-type]  # has what it takes
    assert "".join(calls) == "ab" + "ab" + "ba" + "ab"
    assert times == [(20.0, 20.0), (30.0, 30.0), (40.0, 40.0)]


@pytest.mark.parametrize(
    ("n", "rank"),
    # The rank is the largest k for which fewer than k heads in n throws have a probability of at
    # most 2.5 %. In 10 throws, 0 or 1 heads have 11 / 1024 = 1.1 %, and 0 to 2 heads have 5.5 %. In
    # 20 throws, 0 to 5 heads have 2.1 %. In 6 throws, 0 heads have 1.6 %.
    [(6, 1), (10, 2), (20, 6)],
)
def test_interval_of_a_median(n: int, rank: int) -> None:
    values = np.random.default_rng(0).permutation(np.arange(1.0, n + 1)).tolist()
    assert pairs.median(values) == ((n + 1) / 2, rank, n + 1 - rank)


def test_an_interval_holds_the_median_as_often_as_it_says() -> None:
    random = np.random.default_rng(1)
    held = 0
    for _ in range(400):
        _, low, high = pairs.median(random.exponential(size=20).tolist())
        held += low <= math.log(2) <= high
    # The interval holds the median with a probability of 95.9 % (20 values, ranks 6 to 15). Over
    # 400 draws, 4 sd of the share are 4 %.
    assert 0.919 <= held / 400 <= 0.999


def test_too_few_pairs_are_refused() -> None:
    with pytest.raises(ValueError, match="values are 5: give at least 6"):
        pairs.median([1.0] * 5)


@pytest.mark.parametrize("name", list(curriculum_cost.COPIES))
def test_an_arm_differs_from_the_single_stage_by_the_engine_alone(name: str) -> None:
    single = load_train(["stage=s6"])
    arm = curriculum_cost.curriculum(single, name)
    assert arm.curriculum.mode == name.removesuffix("-grid")
    assert len({stage.name for stage in arm.stage}) == curriculum_cost.COPIES[name]
    for stage in arm.stage:
        assert (stage.robots, stage.obstacles, stage.sides) == (5, 3, (1.2, 1.2))
    assert arm.arenas == single.arenas
