"""Tests that verdicts reverse when the data are reversed, and stay open where data are unclear."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from reproductions import log, reproduction

from swarmjax.reproduce import claims
from swarmjax.reproduce.claims import CLAIMS
from swarmjax.reproduce.config import ARMS
from swarmjax.reproduce.criteria import about, crowded, earlier, higher, opposite, within
from swarmjax.reproduce.measures import NUMBER, SHARE
from swarmjax.reproduce.rows import EXPANDED, LAST, Reproduction

BY_NAME = {claim.name: claim for claim in CLAIMS}


def _three(*values: float) -> np.ndarray:
    """Returns the values of three seeds, all equal if one value is given."""
    return np.array(values if len(values) == 3 else values * 3)


def _steady_from(number: int) -> list:
    """Returns logs of three seeds with 60 episodes each that succeed from episode `number` on."""
    return [log([False] * (number - 1) + [True] * (61 - number))] * 3


def _outcome(data: Reproduction, name: str) -> str:
    return claims.verdict(data, BY_NAME[name]).outcome


# With three seeds the interval of an interquartile mean goes from the lowest to the highest value,
# since one of 27 resamples holds the lowest value three times, and one the highest.
@pytest.mark.parametrize(
    ("values", "holds"),
    [
        ([_three(0.8), _three(0.9)], True),
        ([_three(0.7, 0.8, 0.9), _three(0.9)], None),
        ([_three(0.7), _three(0.9)], False),
        ([_three(0.9), _three(0.79)], False),
        ([_three(0.8), _three(0.1 + 0.7)], True),  # 0.7999999999999999
    ],
)
def test_all_arms_come_to_a_share(values: list[np.ndarray], holds: bool | None) -> None:
    assert within(*values, low=0.8)[0] is holds


def test_the_numbers_are_said() -> None:
    _, text = within(_three(0.7, 0.8, 0.9), _three(1.0), low=0.8)
    assert text == "80.0 % (70.0 to 90.0) and 100.0 % (100.0 to 100.0)"
    _, text = higher(_three(0.75), _three(0.25, 0.5, 0.25), unit=SHARE)
    # The interquartile mean of three values is their mean. The difference of the means is
    # 0.75 - 1 / 3, and its interval goes from 0.75 - 0.5 to 0.75 - 0.25.
    # The interval is 25 points wide, so a standard error is 25 / 3.92, and 2.8 of them are 17.9.
    assert text == (
        "75.0 % against 33.3 %, difference +41.7 points (+25.0 to +50.0); 17.9 points would be "
        "found in 8 of 10 studies"
    )
    _, text = earlier(_three(300.0), _three(math.inf))
    assert text == "300 against never, probability of being earlier 1 (1 to 1)"


@pytest.mark.parametrize(
    ("values", "holds"),
    [(_three(0.4), True), (_three(0.4, 0.5, 0.6), None), (_three(0.5), False)],
)
def test_an_arm_stays_below_a_share(values: np.ndarray, holds: bool | None) -> None:
    assert opposite(partial(within, low=0.5))(values)[0] is holds


@pytest.mark.parametrize(
    ("values", "holds"),
    [
        (_three(300.0, 600.0, 900.0), True),
        (_three(200.0, 600.0, 600.0), None),
        (_three(600.0, 600.0, math.inf), None),
        (_three(299.0), False),
        (_three(math.inf), False),
    ],
)
def test_about_six_hundred_is_three_hundred_to_nine_hundred(
    values: np.ndarray, holds: bool | None
) -> None:
    assert about(600)(values)[0] is holds


@pytest.mark.parametrize(
    ("ours", "theirs", "holds"),
    [
        (_three(0.9), _three(0.8), True),
        # Seeds are compared in pairs: each has 0.1 more, although the ranges of the arms overlap.
        (_three(0.2, 0.5, 0.9), _three(0.1, 0.4, 0.8), True),
        (_three(0.2, 0.5, 0.9), _three(0.3, 0.4, 0.8), None),
        (_three(0.8), _three(0.8), None),
        # Both arms have the same values in different orders, so their sums differ only in the last
        # digit.
        (_three(0.7, 0.1, 0.2), _three(0.2, 0.7, 0.1), None),
        (_three(0.7), _three(0.8), False),
    ],
)
def test_a_difference_counts_where_its_interval_excludes_none(
    ours: np.ndarray, theirs: np.ndarray, holds: bool | None
) -> None:
    assert higher(ours, theirs, unit=NUMBER)[0] is holds
    turned = None if holds is None else not holds
    assert opposite(partial(higher, unit=NUMBER))(ours, theirs)[0] is turned


@pytest.mark.parametrize(
    ("ours", "theirs", "holds"),
    [
        (_three(300.0), _three(600.0, math.inf, math.inf), True),
        (_three(300.0, 300.0, math.inf), _three(200.0, 400.0, math.inf), None),
        (_three(math.inf), _three(math.inf), None),
        (_three(math.inf), _three(600.0), False),
    ],
)
def test_one_that_never_gets_there_is_later_than_all(
    ours: np.ndarray, theirs: np.ndarray, holds: bool | None
) -> None:
    assert earlier(ours, theirs)[0] is holds


@pytest.mark.parametrize(
    ("values", "holds"), [(_three(0.1), True), (_three(0, 0.1, 0.1), None), (_three(0.0), False)]
)
def test_collisions_that_are_none(values: np.ndarray, holds: bool | None) -> None:
    assert opposite(partial(within, low=0.0, high=0.0))(values)[0] is holds


@pytest.mark.parametrize(("more", "holds"), [(-2.0, False), (0.0, False), (2.0, None)])
def test_crowding_is_contradicted_but_never_proven(more: float, holds: bool | None) -> None:
    assert crowded(_three(more))[0] is holds


@pytest.mark.parametrize("turned", [False, True])
def test_verdicts_turn_with_the_data(turned: bool) -> None:
    """Makes the curriculum better in every measure, and with `turned` the baseline."""
    good = {"targets_reached": 0.9, "sensed_share": 0.1, "contacts_per_robot": 1.0}
    bad = {"targets_reached": 0.4, "sensed_share": 0.2, "contacts_per_robot": 2.0}
    ours, theirs = (bad, good) if turned else (good, bad)
    cruder = [
        log([True] * 15 + [False] * 45, sensed=np.full((60, 2), 20), contacts=np.full((60, 2), 9))
    ] * 3
    logs = {"curriculum": _steady_from(20), "baseline": cruder}
    if turned:
        logs = {"curriculum": cruder, "baseline": _steady_from(20)}
    tuned = {f"{arm}_expanded": logs[arm] for arm in logs}
    data = reproduction(
        logs | tuned,
        {
            (f"{arm}{suffix}", stage): values
            for arm, values in (("curriculum", ours), ("baseline", theirs))
            for suffix, stage in (("", LAST), ("", EXPANDED), ("_expanded", EXPANDED))
        },
    )
    expected = "not reproduced" if turned else "reproduced"
    for name in (
        "faster_goal",
        "higher_success",
        "fewer_collisions",
        "expanded_better",
        "traditional_fails",
        "expanded_converges",
        "unseen",
    ):
        assert _outcome(data, name) == expected, name
    assert _outcome(data, "both") == "not reproduced"
    assert _outcome(data, "collisions_remain") == "reproduced"


@pytest.mark.parametrize(
    ("name", "arm", "number"),
    [("six_hundred", "baseline", 600), ("three_hundred", "curriculum", 300)],
)
def test_the_numbers_of_the_paper_are_looked_for_in_their_arms(
    name: str, arm: str, number: int
) -> None:
    right = log([False] * number + [True] * 100)
    wrong = log([False] * 20 + [True] * 100)
    other = "curriculum" if arm == "baseline" else "baseline"
    assert _outcome(reproduction({arm: [right] * 3, other: [wrong] * 3}), name) == "reproduced"
    assert _outcome(reproduction({arm: [wrong] * 3, other: [right] * 3}), name) == "not reproduced"


def test_the_reward_is_compared_from_the_beginning_of_the_run() -> None:
    def rewarded(*values: float) -> np.ndarray:
        return np.repeat(np.repeat(values, 40)[:, None], 2, axis=1)

    fast = [log([True] * 80, reward=rewarded(1.0, 1.0))] * 3
    slow = [log([True] * 80, reward=rewarded(0.0, 1.0))] * 3
    assert _outcome(reproduction({"curriculum": fast, "baseline": slow}), "faster_reward") == (
        "reproduced"
    )
    assert _outcome(reproduction({"curriculum": slow, "baseline": fast}), "faster_reward") == (
        "not reproduced"
    )
    # This run has the same high reward from the start, but it reaches the last stage late.
    stage = np.array(["paper1"] * 40 + [LAST] * 40)
    late = [log([True] * 80, reward=rewarded(1.0, 1.0), stage=stage)] * 3
    assert _outcome(reproduction({"curriculum": late, "baseline": fast}), "faster_reward") == (
        "not reproduced"
    )


def test_sampled_actions_decide_and_other_readings_are_shown() -> None:
    reached = {"targets_reached": 0.9}
    data = reproduction({"curriculum": _steady_from(20), "baseline": [log([False] * 60)] * 3})
    judged = {("curriculum", LAST, "mean"): reached, ("baseline", LAST, "sampled"): reached}
    found = claims.verdict(reproduction(data.logs, judged), BY_NAME["higher_success"])
    assert [each.holds for each in found.findings] == [False, True, True]
    assert (found.outcome, found.reason) == ("not reproduced", "")


@pytest.mark.parametrize(("key", "value"), [("budget", 999_999), ("fine_tune", 6000)])
def test_runs_shorter_than_the_papers_have_no_verdict(key: str, value: int) -> None:
    data = reproduction({arm: _steady_from(20) for arm in ARMS})
    short = replace(data, settings=replace(data.settings, **{key: value}))
    for claim in CLAIMS:
        found = claims.verdict(short, claim)
        assert (found.outcome, found.reason) == ("no verdict", "too short")
        assert {each.holds for each in found.findings} == {None}
        assert claims.verdict(data, claim).outcome != "no verdict"


def test_a_missing_arm_decides_nothing_and_is_named() -> None:
    shares = {("curriculum", EXPANDED): {"targets_reached": 0.9}, ("baseline", EXPANDED): {}}
    found = claims.verdict(reproduction(judged=shares), BY_NAME["expanded_better"])
    assert [each.holds for each in found.findings] == [None, None, True, True]
    assert found.findings[0].text == "lacks curriculum_expanded and baseline_expanded"
    assert (found.outcome, found.reason) == ("undecidable", "an arm is missing")


def test_too_few_episodes_leave_a_reading_open() -> None:
    data = reproduction({"curriculum": [log([True] * 19)] * 3, "baseline": [log([True] * 60)] * 3})
    sampled = claims.verdict(data, BY_NAME["higher_success"]).findings[2]
    assert (sampled.holds, sampled.text) == (None, "a seed has too few episodes for it")


def test_every_claim_needs_arms_that_there_are() -> None:
    assert len(BY_NAME) == len(CLAIMS)
    for claim in CLAIMS:
        assert claim.readings
        assert {arm for reading in claim.readings for arm in reading.arms} <= set(ARMS)
        names = [reading.name for reading in claim.readings]
        assert len(set(names)) == len(names)
