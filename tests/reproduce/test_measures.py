"""Tests success, its steady state and rolling means against numbers computed by hand."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reproductions import log, reproduction

from swarmjax.evaluate.statistics import Interval
from swarmjax.reproduce import measures
from swarmjax.reproduce.rows import LAST

THREE_ROBOTS = log(
    [True] * 3,
    present=np.array([[1, 1, 0], [1, 1, 1], [1, 1, 1]], bool),
    reached=np.array([[1, 1, 0], [0, 1, 1], [1, 0, 0]], bool),
    reward=np.array([[1.0, 0.5, 0.0], [0.25, 0.25, 1.0], [-1.0, 0.5, 0.5]]),
    robot_steps=np.array([[50, 150, 0], [100, 100, 200], [0, 0, 0]]),
    sensed=np.array([[10, 40, 0], [0, 0, 100], [0, 0, 0]]),
    contacts=np.array([[3, 1, 0], [0, 0, 3], [0, 0, 0]]),
)


def test_measures_of_an_episode() -> None:
    found = {
        "first_reached": [1, 0, 1],
        "all_reached": [1, 0, 0],
        "targets": [2 / 2, 2 / 3, 1 / 3],
        "first_reward": [1.0, 0.25, -1.0],
        "mean_reward": [1.5 / 2, 1.5 / 3, 0.0],
        "sensed_share": [50 / 200, 100 / 400, 0.0],  # a share of no robot steps is 0
        "contacts": [4 / 2, 3 / 3, 0.0],
    }
    for name, expected in found.items():
        np.testing.assert_array_equal(getattr(measures, name)(THREE_ROBOTS), expected)


def test_rolling_means() -> None:
    np.testing.assert_array_equal(
        measures.rolling(np.array([1.0, 3.0, 5.0, 1.0]), 2), [2.0, 4.0, 3.0]
    )
    assert measures.rolling(np.ones(19)).shape == (0,)
    assert measures.rolling(np.ones(20)).shape == (1,)


@pytest.mark.parametrize(
    ("success", "expected"),
    [
        # Windows of 4 episodes hold 2, 3, 3, 3, 3, 3 and 3 successes, and three are enough.
        ([0, 1, 1, 0, 1, 1, 1, 0, 1, 1], 1),
        ([1, 1, 1, 1], 0),
        # Windows hold 4, 3, 2, 2 and 2 successes. A window with two of four does not end the steady
        # state, and six successes in all eight episodes are enough.
        ([1, 1, 1, 1, 0, 0, 1, 1], 0),
        # From the first window to the end five of eight episodes succeed, and from the second
        # window four of seven. Both are too few.
        ([1, 1, 1, 1, 0, 0, 1, 0], None),
        # Windows hold 4, 3, 2, 1, 1, 2 and 3 successes. A window with one of four ends the steady
        # state, so the good beginning does not count.
        ([1, 1, 1, 1, 0, 0, 0, 1, 1, 1], 6),
        ([1, 1, 1, 1, 0, 0, 0, 1, 1], None),
        ([1, 1, 1], None),
        ([], None),
    ],
)
def test_steady_success_by_hand(success: list[int], expected: int | None) -> None:
    assert measures.steady(np.array(success, bool), window=4, share=0.75) == expected


def test_sixteen_of_twenty_are_enough() -> None:
    success = np.array([0] * 4 + [1] * 16, bool)
    assert measures.steady(success) == 0
    success[-1] = False
    assert measures.steady(success) is None


def test_rare_failures_do_not_make_a_long_run_late() -> None:
    # Nine of ten episodes succeed, but near the end four fail in a row. A window with 15 successes
    # of 20 does not end the steady state.
    success = np.arange(1000) % 10 > 0
    success[:300], success[980:984] = False, False
    # Four of the first twenty episodes may fail: here 298, 299, 300 and 310.
    assert measures.steady(success) == 298


@given(st.lists(st.booleans(), max_size=40))
@settings(max_examples=60)
def test_steady_is_a_good_window_with_a_good_rest(success: list[bool]) -> None:
    def good(start: int) -> bool:
        windows = [sum(success[i : i + 5]) for i in range(start, len(success) - 4)]
        rest = success[start:]
        # The first five episodes need a success of 0.8, and so do all episodes to the end. Every
        # later window needs a success of 0.5, which is three of five episodes.
        kept = bool(windows) and windows[0] >= 4 and min(windows) >= 3
        return kept and 5 * sum(rest) >= 4 * len(rest)

    expected = next((i for i in range(len(success)) if good(i)), None)
    assert measures.steady(np.array(success, bool), window=5) == expected


def test_steady_places_count_from_the_beginning_of_the_run() -> None:
    # Ten episodes succeed on another stage. On the last stage five fail, and then 25 succeed.
    stage = np.array(["paper1"] * 10 + [LAST] * 30)
    slow = log([True] * 10 + [False] * 5 + [True] * 25, every=50, stage=stage)
    never = log([False] * 40)
    data = reproduction({"curriculum": [slow, slow, never]})
    find = {"success": measures.first_reached}
    # The window that starts with the second failure, episode 12, holds four failures. 16 successes
    # of 20 are enough.
    everything = measures.steady_at(data, "curriculum", axis="episode", stage=None, **find)
    np.testing.assert_array_equal(everything, [12, 12, math.inf])
    on_last = measures.steady_at(data, "curriculum", axis="steps", stage=LAST, **find)
    np.testing.assert_array_equal(on_last, [600, 600, math.inf])


def test_the_end_of_training_is_its_last_twenty_episodes() -> None:
    stage = np.array(["paper1"] * 5 + [LAST] * 25)
    long = log([False] * 15 + [True] * 15, stage=stage)
    short = log([True] * 24, stage=np.array(["paper1"] * 5 + [LAST] * 19))
    data = reproduction({"curriculum": [long, long, short]})
    found = measures.late(data, "curriculum", of=measures.targets, stage=LAST)
    np.testing.assert_array_equal(found, [0.75, 0.75, np.nan])


def test_crowding_compares_the_last_to_arrive_with_the_first() -> None:
    steps = np.tile([300, 100, 500], (22, 1))
    sensed = np.tile([7, 2, 12], (22, 1))
    reached = np.ones((22, 3), bool)
    reached[2, 2] = False  # Here robot 0 arrives last: 7 - 2.
    reached[3, 1:] = False  # Here only robot 0 arrives.
    sensed[:2] = 1000  # These come before the last twenty episodes.
    present = np.ones((22, 3), bool)
    one = log([True] * 22, robot_steps=steps, sensed=sensed, reached=reached, present=present)
    nothing = log([False] * 22)
    data = reproduction({"curriculum": [one, one, nothing]})
    found = measures.crowding(data, "curriculum", stage=LAST)
    # The difference is 12 - 2 in 18 episodes and 7 - 2 in one. The mean is exact except for its
    # last digit.
    np.testing.assert_allclose(found, [(18 * 10 + 5) / 19] * 2 + [np.nan], rtol=1e-15)


def test_a_reward_near_the_best_is_searched_for_among_the_rivals() -> None:
    def rewarded(*values: float) -> np.ndarray:
        return np.repeat(np.repeat(values, 20)[:, None], 2, axis=1)

    best = log([True] * 40, reward=rewarded(0.0, 1.0))
    good = log([True] * 40, reward=rewarded(0.95, 0.95), every=50)
    poor = log([True] * 40, reward=rewarded(0.5, 0.85))
    data = reproduction({"curriculum": [best] * 3, "baseline": [good, good, poor]})
    find = {"of": measures.mean_reward, "rivals": ("curriculum", "baseline"), "stage": LAST}
    # The rolling mean of `best` is k / 20 after 20 + k episodes, so it is 0.9 at episode 38.
    found = measures.reward_reached(data, "curriculum", axis="episode", **find)
    np.testing.assert_array_equal(found, [38] * 3)
    # `good` is above 0.9 from its first window on, which ends with episode 20. The 0.85 of `poor`
    # is too low.
    found = measures.reward_reached(data, "baseline", axis="steps", **find)
    np.testing.assert_array_equal(found, [1000, 1000, math.inf])


def test_curves_are_taken_where_all_of_them_are() -> None:
    curves = [
        (np.array([1, 2, 4]), np.array([10.0, 20.0, 40.0])),
        (np.array([2, 3, 6]), np.array([1.0, 2.0, 3.0])),
    ]
    found = measures.on_grid(curves, points=100)
    assert found is not None
    grid, values = found
    np.testing.assert_array_equal(grid, [2, 3, 4])
    # Each curve keeps its value until its next point.
    np.testing.assert_array_equal(values, [[20.0, 20.0, 40.0], [1.0, 2.0, 2.0]])
    assert measures.on_grid([*curves, (np.zeros(0), np.zeros(0))], points=9) is None
    assert measures.on_grid([*curves, (np.array([5]), np.array([1.0]))], points=9) is None


def test_numbers_are_written_with_their_units() -> None:
    assert measures.SHARE.interval(Interval(0.5, 0.25, 0.755)) == "50.0 % (25.0 to 75.5)"
    assert measures.PLACE.interval(Interval(1234.4, 900.0, math.inf)) == "1,234 (900 to never)"
    assert measures.NUMBER.value(1234567.0) == "1,234,567"
    found = Interval(-0.125, -0.25, 0.0001)
    assert (
        measures.SHARE.difference(found) == "\N{MINUS SIGN}12.5 points (\N{MINUS SIGN}25.0 to 0.0)"
    )
    assert measures.NUMBER.difference(found).endswith("to +0.0001)")
