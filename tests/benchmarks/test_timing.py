"""Tests the statistics of two programs timed in turn, and the words of a comparison."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from benchmarks import timing


def test_which_comes_first_alternates() -> None:
    calls: list[str] = []

    def one() -> int:
        calls.append("a")
        return len(calls)

    def other() -> int:
        calls.append("b")
        return len(calls)

    assert timing.in_turn(one, other, 3) == [(1, 2), (4, 3), (5, 6)]
    assert "".join(calls) == "ab" + "ba" + "ab"


@pytest.mark.parametrize(
    ("n", "rank"),
    # The rank is the largest k for which fewer than k heads in n throws have a probability of at
    # most 2.5 %. In 10 throws, 0 or 1 heads have 11 / 1024 = 1.1 %, and 0 to 2 heads have 5.5 %. In
    # 20 throws, 0 to 5 heads have 2.1 %. In 6 throws, 0 heads have 1.6 %.
    [(6, 1), (10, 2), (20, 6)],
)
def test_interval_of_a_median(n: int, rank: int) -> None:
    values = np.random.default_rng(0).permutation(np.arange(1.0, n + 1)).tolist()
    assert timing.median(values) == ((n + 1) / 2, rank, n + 1 - rank)


def test_an_interval_holds_the_median_as_often_as_it_says() -> None:
    random = np.random.default_rng(1)
    held = 0
    for _ in range(400):
        _, low, high = timing.median(random.exponential(size=20).tolist())
        held += low <= math.log(2) <= high
    # The interval holds the median with a probability of 95.9 % (20 values, ranks 6 to 15). Over
    # 400 draws, 4 sd of the share are 4 %.
    assert 0.919 <= held / 400 <= 0.999


def test_too_few_pairs_are_refused() -> None:
    with pytest.raises(ValueError, match="values are 5: give at least 6"):
        timing.median([1.0] * 5)


class Halves:
    """Stands in for a side; its words are kept, and a call takes half a second."""

    words: ClassVar[list[list[str]]] = []
    compile_s = 1.0

    def __init__(self, tree: Path, words: Sequence[str]) -> None:
        self.words.append([*words])

    def time(self, updates: int) -> float:
        """Returns the seconds of a call."""
        return 0.5

    def close(self) -> None:
        """Does nothing."""


def test_speeds_are_of_arena_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "Side", Halves)
    words = ["stage=s1", "arenas=8", "budget=1e6", "algo.rollout_length=4"]
    line = timing.compare(timing.SidesConfig(than="seeds=3 seed=7"), words)
    assert Halves.words == [words, [*words, "seeds=3", "seed=7"]]
    # 0.7 s are 3 updates of 0.25 s. Both sides take equally long, and this one trains three seeds.
    assert line["updates"] == 3
    assert line["arena_steps_per_s"] == [3 * 32 / 0.5, 9 * 32 / 0.5]
    assert line["speed_ratio"] == line["speed_ratio_low"] == line["speed_ratio_high"] == 3.0
