"""Tests whether a claim holds: is the interval of a value or a difference beyond a limit?"""

import numpy as np

from swarmjax.evaluate import statistics
from swarmjax.evaluate.statistics import Interval, iqm
from swarmjax.reproduce.measures import NUMBER, PLACE, SHARE, Unit

ABOUT = 0.5  # "approximately": within this share of the number
_ROUNDING = 1e-9  # rounding error of a mean: the mean of 0.95, 0.95 and 0.95 is less than 0.95


def at_least(*values: np.ndarray, least: float) -> tuple[bool | None, str]:
    """Tests whether all arms reach a share: their intervals lie at or above it.

    An interval below the share contradicts the claim.
    """
    found = [_mean(each) for each in values]
    text = " and ".join(SHARE.interval(each) for each in found)
    if all(each.low >= least - _ROUNDING for each in found):
        return True, text
    return (False if any(each.high < least - _ROUNDING for each in found) else None), text


def below(values: np.ndarray, *, limit: float) -> tuple[bool | None, str]:
    """Tests whether an arm's interval lies below a share; an interval at or above contradicts."""
    found = _mean(values)
    text = SHARE.interval(found)
    return _side(limit - found.high, limit - found.low, text, touching=True)


def about(values: np.ndarray, *, number: float) -> tuple[bool | None, str]:
    """Tests whether an arm's interval lies within `ABOUT` of a number; outside it contradicts."""
    found, low, high = _mean(values), (1 - ABOUT) * number, (1 + ABOUT) * number
    text = PLACE.interval(found)
    if low <= found.low and found.high <= high:
        return True, text
    return (False if found.high < low or found.low > high else None), text


def higher(ours: np.ndarray, theirs: np.ndarray, *, unit: Unit) -> tuple[bool | None, str]:
    """Tests whether the first arm has more: the interval of the paired difference is above 0.

    An interval below 0 contradicts the claim.
    """
    more = statistics.paired(theirs[:, None], ours[:, None], iqm)
    both = f"{unit.value(float(iqm(ours)))} against {unit.value(float(iqm(theirs)))}"
    text = f"{both}, difference {unit.difference(more)}"
    return _side(more.low, more.high, text)


def lower(ours: np.ndarray, theirs: np.ndarray, *, unit: Unit) -> tuple[bool | None, str]:
    """Tests whether the first arm has less, as `higher` does."""
    holds, text = higher(ours, theirs, unit=unit)
    return (None if holds is None else not holds), text


def earlier(ours: np.ndarray, theirs: np.ndarray) -> tuple[bool | None, str]:
    """Tests whether the first arm reaches a goal earlier, where inf means never.

    It takes the probability that a seed of the first arm is earlier than a seed of the second. The
    claim holds if the interval of this probability lies above 0.5. It is contradicted if the
    interval lies below 0.5.
    """
    chance = statistics.probability_of_improvement(theirs[:, None], ours[:, None])
    both = " against ".join(PLACE.value(float(iqm(each))) for each in (ours, theirs))
    text = f"{both}, probability of being earlier {NUMBER.interval(chance)}"
    return _side(chance.low - 0.5, chance.high - 0.5, text)


def above_zero(values: np.ndarray) -> tuple[bool | None, str]:
    """Tests whether the interval of a share lies above 0; a share of 0 contradicts the claim."""
    found = _mean(values)
    return _side(found.low, found.high, SHARE.interval(found), touching=True)


def crowded(values: np.ndarray) -> tuple[bool | None, str]:
    """Tests for crowding; contradicted if the last robot to arrive senses no more than the first.

    If it senses more, crowding is possible but not proven, so the reading stays open.
    """
    found = _mean(values)
    text = f"{NUMBER.difference(found)} steps"
    if found.high <= _ROUNDING:
        return False, text
    return None, f"{text}, which crowding would cause, but other things would too"


def _mean(values: np.ndarray) -> Interval[float]:
    """Takes the interquartile mean over seeds [N], with its interval."""
    return statistics.bootstrap(values[:, None], iqm)


def _side(low: float, high: float, text: str, *, touching: bool = False) -> tuple[bool | None, str]:
    """Tells whether an interval lies above 0, below 0 (or at 0, if `touching`), or straddles 0."""
    if low > _ROUNDING:
        return True, text
    beyond = _ROUNDING if touching else -_ROUNDING
    return (False if high < beyond else None), text
