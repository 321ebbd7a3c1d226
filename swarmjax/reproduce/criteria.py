"""When a claim holds: what a value, or a paired difference, must be beyond its interval."""

import numpy as np

from swarmjax.evaluate import statistics
from swarmjax.evaluate.statistics import Interval, iqm
from swarmjax.reproduce.measures import NUMBER, PLACE, SHARE, Unit

ABOUT = 0.5  # "approximately": within this share of the number
_ROUNDING = 1e-9  # what means lose: that of 0.95, 0.95 and 0.95 is less than 0.95


def at_least(*values: np.ndarray, least: float) -> tuple[bool | None, str]:
    """Tests whether all arms come to a share: their intervals lie at or above it.

    One that lies below contradicts it.
    """
    found = [_mean(each) for each in values]
    text = " and ".join(SHARE.interval(each) for each in found)
    if all(each.low >= least - _ROUNDING for each in found):
        return True, text
    return (False if any(each.high < least - _ROUNDING for each in found) else None), text


def below(values: np.ndarray, *, limit: float) -> tuple[bool | None, str]:
    """Tests whether an arm stays below a share: its interval does; one at or above contradicts."""
    found = _mean(values)
    text = SHARE.interval(found)
    return _side(limit - found.high, limit - found.low, text, touching=True)


def about(values: np.ndarray, *, number: float) -> tuple[bool | None, str]:
    """Tests whether an arm's interval lies within `ABOUT` of a number; one outside contradicts."""
    found, low, high = _mean(values), (1 - ABOUT) * number, (1 + ABOUT) * number
    text = PLACE.interval(found)
    if low <= found.low and found.high <= high:
        return True, text
    return (False if found.high < low or found.low > high else None), text


def higher(ours: np.ndarray, theirs: np.ndarray, *, unit: Unit) -> tuple[bool | None, str]:
    """Tests whether the first arm has more: the interval of the paired difference is above 0.

    One that lies below 0 contradicts it.
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
    """Tests whether the first arm gets somewhere earlier, where inf is never.

    It does if the interval of the probability that a seed of it does so lies above 0.5; one that
    lies below contradicts it.
    """
    chance = statistics.probability_of_improvement(theirs[:, None], ours[:, None])
    both = " against ".join(PLACE.value(float(iqm(each))) for each in (ours, theirs))
    text = f"{both}, probability of being earlier {NUMBER.interval(chance)}"
    return _side(chance.low - 0.5, chance.high - 0.5, text)


def above_zero(values: np.ndarray) -> tuple[bool | None, str]:
    """Tests whether a share is not 0: its interval is above; one that is 0 contradicts it."""
    found = _mean(values)
    return _side(found.low, found.high, SHARE.interval(found), touching=True)


def crowded(values: np.ndarray) -> tuple[bool | None, str]:
    """Tests whether the last to arrive senses no more than the first, which contradicts crowding.

    More of it is what crowding would bring about, but no proof of it: the reading stays open.
    """
    found = _mean(values)
    text = f"{NUMBER.difference(found)} steps"
    if found.high <= _ROUNDING:
        return False, text
    return None, f"{text}, which crowding would bring about, and other things too"


def _mean(values: np.ndarray) -> Interval[float]:
    """Interquartile mean over seeds [N], with its interval."""
    return statistics.bootstrap(values[:, None], iqm)


def _side(low: float, high: float, text: str, *, touching: bool = False) -> tuple[bool | None, str]:
    """Tells whether an interval lies above 0, below it (or at it, if `touching`), or straddles."""
    if low > _ROUNDING:
        return True, text
    beyond = _ROUNDING if touching else -_ROUNDING
    return (False if high < beyond else None), text
