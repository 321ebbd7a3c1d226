"""Tests whether a claim holds: whether the interval of a value or difference is beyond a limit."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from swarmjax.evaluate import statistics
from swarmjax.evaluate.statistics import iqm
from swarmjax.reproduce.measures import NUMBER, PLACE, SHARE, Unit

# A function that takes the values [N] of each arm of a reading. It returns whether the claim holds
# (None if undecided), and the numbers as text.
type Criterion = Callable[..., tuple[bool | None, str]]

ABOUT = 0.5  # we read "approximately X" as X plus or minus this share of X
# A difference is found with a probability of 0.8 if it is (1.96 + 0.84) standard errors from 0. The
# 95 % interval is 2 * 1.96 standard errors wide.
_POWER = (1.96 + 0.84) / (2 * 1.96)
_ROUNDING = 1e-9  # rounding error of a mean: the mean of 0.95, 0.95 and 0.95 is less than 0.95


def within(
    *values: np.ndarray, low: float, high: float = math.inf, unit: Unit = SHARE
) -> tuple[bool | None, str]:
    """Tests whether the intervals of all arms lie between `low` and `high`, which are included.

    An interval that lies wholly outside contradicts the claim.
    """
    low, high = low - _ROUNDING, high + _ROUNDING
    means = [statistics.bootstrap(each[:, None], iqm) for each in values]
    text = " and ".join(map(unit.interval, means))
    if all(low <= mean.low and mean.high <= high for mean in means):
        return True, text
    return (False if any(mean.high < low or mean.low > high for mean in means) else None), text


def about(number: float) -> Criterion:
    """Makes the criterion that values, such as episode numbers, are approximately this number."""
    return partial(within, low=(1 - ABOUT) * number, high=(1 + ABOUT) * number, unit=PLACE)


def opposite(criterion: Criterion) -> Criterion:
    """Makes a criterion that holds where the given one is contradicted, and the other way round."""

    def test(*values: np.ndarray) -> tuple[bool | None, str]:
        holds, text = criterion(*values)
        return None if holds is None else not holds, text

    return test


def higher(ours: np.ndarray, theirs: np.ndarray, *, unit: Unit) -> tuple[bool | None, str]:
    """Tests whether the first arm has higher values than the second.

    The claim holds if the interval of the paired difference lies above 0. The claim is contradicted
    if the interval lies below 0.
    """
    more = statistics.paired(theirs[:, None], ours[:, None], iqm)
    both = " against ".join(unit.value(float(iqm(each))) for each in (ours, theirs))
    least = f"{unit.number(_POWER * (more.high - more.low))}{unit.apart}"
    text = f"{both}, difference {unit.difference(more)}; {least} would be found in 8 of 10 studies"
    return _sign(more.low, more.high), text


def earlier(ours: np.ndarray, theirs: np.ndarray) -> tuple[bool | None, str]:
    """Tests whether the first arm reaches a goal earlier; inf stands for never.

    The test estimates the probability that a seed of the first arm is earlier than a seed of the
    second arm. The claim holds if the interval of this probability lies above 0.5. The claim is
    contradicted if the interval lies below 0.5.
    """
    chance = statistics.probability_of_improvement(theirs[:, None], ours[:, None])
    both = " against ".join(PLACE.value(float(iqm(each))) for each in (ours, theirs))
    text = f"{both}, probability of being earlier {NUMBER.interval(chance)}"
    return _sign(chance.low - 0.5, chance.high - 0.5), text


def crowded(values: np.ndarray) -> tuple[bool | None, str]:
    """Tests for crowding, from the results of `measures.crowding`.

    Crowding is contradicted if the last robot to arrive has no more steps with something in range
    than the first robot. If the last robot has more, crowding is possible but not proven, so the
    reading stays open.
    """
    mean = statistics.bootstrap(values[:, None], iqm)
    text = f"{NUMBER.difference(mean)} steps"
    if mean.high <= _ROUNDING:
        return False, text
    return None, f"{text}, which crowding would cause, but other things would too"


def _sign(low: float, high: float) -> bool | None:
    """Tells whether an interval lies above 0 (True), below 0 (False), or touches 0 (None)."""
    return True if low > _ROUNDING else False if high < -_ROUNDING else None
