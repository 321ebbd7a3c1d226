"""What is read out of the episodes of a reproduction: success, its steady state, rolling means.

Where the paper can be read in two ways (docs/paper.md), each reading is a function here. Axes as
in `rows`. No JAX.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from swarmjax.evaluate.statistics import Interval
from swarmjax.reproduce.rows import Reproduction, RunLog

WINDOW = 20  # episodes of a rolling mean: "an averaging window of 20 values" (Figure 7)
STEADY = 0.8  # share of a window that counts as success: what promotes from a stage, too
KEPT = 0.5  # share below which a later window loses it; why it is not 0.8, `steady` says

type Axis = Literal["episode", "steps"]
type Measure = Callable[[RunLog], np.ndarray]  # [E] of a log

UNITS: dict[Axis, str] = {"episode": "episode number", "steps": "arena steps"}
AXES: dict[Axis, str] = {"episode": "episode of the run", "steps": "arena control steps"}


def first_reached(log: RunLog) -> np.ndarray:
    """Whether [E] robot 1 reached its target: the paper's "the robot"."""
    return log.reached[:, 0]


def all_reached(log: RunLog) -> np.ndarray:
    """Whether [E] every robot that took part reached its target."""
    return (log.reached | ~log.present).all(axis=1)


def targets(log: RunLog) -> np.ndarray:
    """Share [E] of the targets that were reached: the paper's success rate (section 3.2)."""
    return log.reached.sum(axis=1) / _robots(log)


def first_reward(log: RunLog) -> np.ndarray:
    """Cumulative reward [E] of robot 1, m: Figure 7 is "for one robot"."""
    return log.reward[:, 0]


def mean_reward(log: RunLog) -> np.ndarray:
    """Cumulative reward [E], mean over the robots that took part, m."""
    return log.reward.sum(axis=1) / _robots(log)


def sensed_share(log: RunLog) -> np.ndarray:
    """Share [E] of robot steps with something within infrared range: the paper's collisions."""
    return log.sensed.sum(axis=1) / np.maximum(log.robot_steps.sum(axis=1), 1)


def contacts(log: RunLog) -> np.ndarray:
    """Contacts [E] per robot that took part."""
    return log.contacts.sum(axis=1) / _robots(log)


def _robots(log: RunLog) -> np.ndarray:
    return log.present.sum(axis=1)


# What it is that "reaches the goal" in Figures 6 and 9.
SUCCESS: dict[str, Measure] = {
    "robot 1 reached its target": first_reached,
    "all robots reached their targets": all_reached,
}


def rolling(values: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Means of each value and the ones before it.

    Args:
      values: [E] of any unit.
      window: values of a mean.

    Returns:
      [E - window + 1], the first one at value `window`; none if there are fewer values.
    """
    if len(values) < window:
        return np.zeros(0)
    return np.lib.stride_tricks.sliding_window_view(values, window).mean(axis=-1)


def steady(success: np.ndarray, window: int = WINDOW, share: float = STEADY) -> int | None:
    """Finds where success becomes steady.

    That is the first episode from which on a window of episodes has at least the share of
    successes, so have all episodes to the end of the run, and no later window has less than `KEPT`.

    To ask the share of every later window would measure how long a run is: a policy that succeeds
    in nine of ten episodes has fewer than 16 in one window of 23, and so near the end of any run.

    Args:
      success: [E] whether an episode succeeded.
      window: episodes of a window.
      share: that a window must have.

    Returns:
      Index of the episode; None if there is none.
    """
    # Counts, since 16 / 20 and 0.8 are compared; the small number is for what rounding takes.
    counts = rolling(success.astype(float), window) * window
    left = np.arange(len(success), 0, -1)
    rest = np.cumsum(success[::-1])[::-1] >= share * left - 1e-9
    good = (counts >= share * window - 1e-9) & rest[: len(counts)]
    lost = np.flatnonzero(counts < KEPT * window - 1e-9)
    good[: lost[-1] + 1 if len(lost) else 0] = False
    return int(good.argmax()) if good.any() else None


def along(log: RunLog, axis: Axis) -> np.ndarray:
    """Where [E] episodes are: their numbers in the run, or the arena steps at which they ended."""
    return log.number if axis == "episode" else log.arena_steps


def steady_at(
    data: Reproduction, arm: str, *, success: Measure, axis: Axis, stage: str | None
) -> np.ndarray:
    """Where success becomes steady, by seed.

    Args:
      data: of the reproduction.
      arm: a finished one.
      success: [E] of a log.
      axis: in which it is told, counted from the beginning of the run.
      stage: whose episodes alone are looked at; None for all.

    Returns:
      [N] episode numbers or arena steps; inf for a seed that does not get there.
    """
    found = []
    for log in data.logs[arm]:
        chosen = log.on(stage)
        at = steady(success(chosen))
        found.append(math.inf if at is None else float(along(chosen, axis)[at]))
    return np.array(found)


def late(data: Reproduction, arm: str, *, of: Measure, stage: str) -> np.ndarray:
    """Mean of a measure over the last episodes on a stage, by sampled actions.

    Args:
      data: of the reproduction.
      arm: a finished one.
      of: [E] of a log.
      stage: whose last `WINDOW` episodes are taken.

    Returns:
      [N] by seed; nan for one with fewer episodes on the stage.
    """
    means = [rolling(np.asarray(of(log.on(stage)), float)) for log in data.logs[arm]]
    return np.array([each[-1] if len(each) else np.nan for each in means])


def judged(data: Reproduction, arm: str, *, key: str, stage: str) -> np.ndarray:
    """What [N] final policies came to on a stage, by their mean actions."""
    return data.judged[arm, stage][key]


def crowding(data: Reproduction, arm: str, *, stage: str) -> np.ndarray:
    """How many more steps the last robot to arrive sensed something than the first one.

    The first finds no other at the targets, the last finds all others that arrive.

    Args:
      data: of the reproduction.
      arm: a finished one.
      stage: whose last `WINDOW` episodes are taken, those of them with two arrivals or more.

    Returns:
      [N] robot steps a pair, mean by seed; nan for a seed without such an episode.
    """
    found = []
    for log in data.logs[arm]:
        chosen = log.on(stage)
        chosen = chosen.where(np.arange(len(chosen)) >= len(chosen) - WINDOW)
        chosen = chosen.where(chosen.reached.sum(axis=1) > 1)
        rows = np.arange(len(chosen))
        first = np.where(chosen.reached, chosen.robot_steps, np.inf).argmin(axis=1)
        last = np.where(chosen.reached, chosen.robot_steps, -np.inf).argmax(axis=1)
        more = chosen.sensed[rows, last] - chosen.sensed[rows, first]
        found.append(more.mean() if len(more) else np.nan)
    return np.array(found)


def reward_reached(
    data: Reproduction, arm: str, *, of: Measure, axis: Axis, rivals: Sequence[str], stage: str
) -> np.ndarray:
    """Where the rolling mean of the reward first comes to 0.9 of the best one of all rivals.

    Args:
      data: of the reproduction.
      arm: one of the rivals.
      of: reward [E] of a log.
      axis: in which it is told, counted from the beginning of the run.
      rivals: finished arms whose seeds are searched for the best.
      stage: whose episodes alone are looked at.

    Returns:
      [N] episode numbers or arena steps; inf for a seed that does not get there.
    """
    means = {rival: [rolling(of(log.on(stage))) for log in data.logs[rival]] for rival in rivals}
    best = max((m.max() for ms in means.values() for m in ms if len(m)), default=np.inf)
    found = []
    for log, mean in zip(data.logs[arm], means[arm], strict=True):
        there = np.flatnonzero(mean >= 0.9 * best)
        at = along(log.on(stage), axis)[WINDOW - 1 :]
        found.append(float(at[there[0]]) if len(there) and best > 0 else math.inf)
    return np.array(found)


def on_grid(
    curves: Sequence[tuple[np.ndarray, np.ndarray]], points: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Takes curves at points that all of them have, each holding until its next value.

    Args:
      curves: of each seed, places [E] that do not fall and values [E].
      points: at most.

    Returns:
      Places [P], whole numbers, and values [N, P]; None if a curve is empty or they share no place.
    """
    if not all(len(at) for at, _ in curves):
        return None
    begin, end = max(at[0] for at, _ in curves), min(at[-1] for at, _ in curves)
    if begin > end:
        return None
    grid = np.unique(np.linspace(begin, end, points).round())
    taken = [values[np.searchsorted(at, grid, side="right") - 1] for at, values in curves]
    return grid, np.array(taken)


@dataclass(frozen=True)
class Unit:
    """How values of a unit are written.

    Attributes:
      number: writes a value without its unit.
      suffix: the unit.
      apart: the unit of a difference of two.
    """

    number: Callable[[float], str]
    suffix: str = ""
    apart: str = ""

    def value(self, value: float) -> str:
        """Writes a value."""
        return f"{self.number(value)}{self.suffix}"

    def interval(self, found: Interval[float]) -> str:
        """Writes an estimate with its interval in brackets."""
        low, high = self.number(found.low), self.number(found.high)
        return f"{self.value(found.estimate)} ({low} to {high})"

    def difference(self, found: Interval[float]) -> str:
        """Writes a difference with its interval, each with its sign."""
        estimate, low, high = map(self._signed, found)
        return f"{estimate}{self.apart} ({low} to {high})"

    def _signed(self, value: float) -> str:
        """Writes a difference with its sign; none where the text is all zeros."""
        plain = self.number(abs(value))
        if not any(digit in plain for digit in "123456789"):
            return plain
        return ("+" if value > 0 else "\N{MINUS SIGN}") + plain


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def _place(place: float) -> str:
    return "never" if math.isinf(place) else f"{place:,.0f}"


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"


SHARE = Unit(_percent, " %", " points")
PLACE = Unit(_place)  # an episode number or arena steps; inf is never
NUMBER = Unit(_number)
