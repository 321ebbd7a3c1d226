"""Measures the episodes of a reproduction: success, when it becomes steady, and rolling means.

Where the paper can be read in two ways (docs/paper.md), each reading has its own function here. The
axes of arrays are those of `rows`. Needs no JAX.
"""

import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from swarmjax.evaluate.statistics import Interval
from swarmjax.reproduce.rows import Action, Reproduction, RunLog

WINDOW = 20  # episodes of a rolling mean: "an averaging window of 20 values" (Figure 7)
STEADY = 0.8  # share of successes in a steady window; the same share promotes to the next stage
KEPT = 0.5  # a later window below this share ends the steady state; see `steady` for why not 0.8

type Axis = Literal["episode", "steps"]
type Measure = Callable[[RunLog], np.ndarray]  # returns a value for each episode of a log, [E]

UNITS: dict[Axis, str] = {"episode": "episode number", "steps": "arena steps"}
AXES: dict[Axis, str] = {"episode": "episode of the run", "steps": "arena control steps"}


def first_reached(log: RunLog) -> np.ndarray:
    """Tells for each episode [E] whether robot 1 (the paper's "the robot") reached its target."""
    return log.reached[:, 0]


def all_reached(log: RunLog) -> np.ndarray:
    """Tells for each episode [E] whether every robot that was present reached its target."""
    return (log.reached | ~log.present).all(axis=1)


def targets(log: RunLog) -> np.ndarray:
    """Computes the share of targets reached in each episode [E]: the paper's success rate (3.2)."""
    return log.reached.sum(axis=1) / _robots(log)


def first_reward(log: RunLog) -> np.ndarray:
    """Returns the cumulative reward [E] of robot 1, m. The paper's Figure 7 is "for one robot"."""
    return log.reward[:, 0]


def mean_reward(log: RunLog) -> np.ndarray:
    """Computes the mean cumulative reward [E] of the robots that were present, m."""
    return log.reward.sum(axis=1) / _robots(log)


def sensed_share(log: RunLog) -> np.ndarray:
    """Computes the share [E] of robot steps with something in infrared range.

    The paper calls these steps collisions.
    """
    return log.sensed.sum(axis=1) / np.maximum(log.robot_steps.sum(axis=1), 1)


def contacts(log: RunLog) -> np.ndarray:
    """Computes the number of contacts [E] per robot that was present."""
    return log.contacts.sum(axis=1) / _robots(log)


def _robots(log: RunLog) -> np.ndarray:
    return log.present.sum(axis=1)


# Two ways to understand who "reaches the goal" in the paper's Figures 6 and 9.
SUCCESS: dict[str, Measure] = {
    "robot 1 reached its target": first_reached,
    "all robots reached their targets": all_reached,
}


def rolling(values: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Computes rolling means: each value together with the values before it.

    Args:
      values: [E] in any unit.
      window: number of values per mean.

    Returns:
      [E - window + 1] means. The first is that of the first `window` values. Empty if there are
      fewer values than `window`.
    """
    if len(values) < window:
        return np.zeros(0)
    return np.lib.stride_tricks.sliding_window_view(values, window).mean(axis=-1)


def steady(success: np.ndarray, window: int = WINDOW, share: float = STEADY) -> int | None:
    """Finds where success becomes steady.

    Success is steady from the first episode that meets three conditions. In the window that starts
    with this episode, at least `share` of the episodes succeed. The same holds for all episodes
    from this one to the end of the run, taken together. In no later window do fewer than `KEPT` of
    them succeed.

    Later windows need not reach `share`, because such a rule would measure the length of the run: a
    policy that succeeds in nine of ten episodes has fewer than 16 successes in one of 23 windows,
    so some window near the end of any run would break the rule.

    Args:
      success: [E] whether an episode succeeded.
      window: number of episodes per window.
      share: share of successes that a window must have.

    Returns:
      Index of that episode; None if success never becomes steady.
    """
    # Compares counts, since 16 / 20 must equal 0.8; the small number absorbs rounding.
    counts = rolling(success.astype(float), window) * window
    left = np.arange(len(success), 0, -1)
    rest = np.cumsum(success[::-1])[::-1] >= share * left - 1e-9
    good = (counts >= share * window - 1e-9) & rest[: len(counts)]
    lost = np.flatnonzero(counts < KEPT * window - 1e-9)
    good[: lost[-1] + 1 if len(lost) else 0] = False
    return int(good.argmax()) if good.any() else None


def along(log: RunLog, axis: Axis) -> np.ndarray:
    """Returns where each episode [E] is in the run: its number, or the arena steps at its end."""
    return log.number if axis == "episode" else log.arena_steps


def steady_at(
    data: Reproduction, arm: str, *, success: Measure, axis: Axis, stage: str | None
) -> np.ndarray:
    """Finds for each seed where its success becomes steady.

    Args:
      data: the reproduction's data.
      arm: a finished arm.
      success: takes [E] successes from a log.
      axis: whether to count training in episodes or in arena control steps.
      stage: uses only the episodes of this stage; None for all.

    Returns:
      [N] episode numbers or arena steps; inf for a seed that never becomes steady.
    """
    places = []
    for log in data.logs[arm]:
        chosen = log.on(stage)
        at = steady(success(chosen))
        places.append(math.inf if at is None else float(along(chosen, axis)[at]))
    return np.array(places)


def late(data: Reproduction, arm: str, *, of: Measure, stage: str) -> np.ndarray:
    """Averages a measure over the last training episodes on a stage, with sampled actions.

    Args:
      data: the reproduction's data.
      arm: a finished arm.
      of: takes the measure [E] from a log.
      stage: the stage; its last `WINDOW` episodes are used.

    Returns:
      [N] means; nan for a seed with fewer than `WINDOW` episodes on the stage.
    """
    means = [rolling(np.asarray(of(log.on(stage)), float)) for log in data.logs[arm]]
    return np.array([each[-1] if len(each) else np.nan for each in means])


def judged(
    data: Reproduction, arm: str, *, key: str, stage: str, action: Action = "sampled"
) -> np.ndarray:
    """Returns one measure of an arm's final policies on a stage, by seed [N]."""
    return data.judged[arm, stage, action][key]


def crowding(data: Reproduction, arm: str, *, stage: str) -> np.ndarray:
    """Counts how many more steps with something in range the last robot had than the first robot.

    First and last refer to the order of arrival. The first robot finds no other robot at the
    targets, and the last robot finds all others that arrived.

    Args:
      data: the reproduction's data.
      arm: a finished arm.
      stage: the stage. Of the last `WINDOW` episodes, those with two or more arrivals are used.

    Returns:
      [N] difference in robot steps, mean over the seed's episodes that are used; nan if none is.
    """
    differences = []
    for log in data.logs[arm]:
        chosen = log.on(stage)
        chosen = chosen.where(np.arange(len(chosen)) >= len(chosen) - WINDOW)
        chosen = chosen.where(chosen.reached.sum(axis=1) > 1)
        rows = np.arange(len(chosen))
        first = np.where(chosen.reached, chosen.robot_steps, np.inf).argmin(axis=1)
        last = np.where(chosen.reached, chosen.robot_steps, -np.inf).argmax(axis=1)
        more = chosen.sensed[rows, last] - chosen.sensed[rows, first]
        differences.append(more.mean() if len(more) else np.nan)
    return np.array(differences)


def reward_reached(
    data: Reproduction, arm: str, *, of: Measure, axis: Axis, rivals: Sequence[str], stage: str
) -> np.ndarray:
    """Finds where an arm's rolling mean of the reward first reaches 0.9 of the best rolling mean.

    Args:
      data: the reproduction's data.
      arm: one of the rivals.
      of: takes the reward [E] from a log.
      axis: whether to count training in episodes or in arena control steps.
      rivals: finished arms. The best rolling mean is the highest one of all their seeds.
      stage: uses only the episodes of this stage.

    Returns:
      [N] episode numbers or arena steps; inf for a seed that never reaches it.
    """
    means = {rival: [rolling(of(log.on(stage))) for log in data.logs[rival]] for rival in rivals}
    best = max((m.max() for ms in means.values() for m in ms if len(m)), default=np.inf)
    places = []
    for log, mean in zip(data.logs[arm], means[arm], strict=True):
        there = np.flatnonzero(mean >= 0.9 * best)
        at = along(log.on(stage), axis)[WINDOW - 1 :]
        places.append(float(at[there[0]]) if len(there) and best > 0 else math.inf)
    return np.array(places)


def on_grid(
    curves: Sequence[tuple[np.ndarray, np.ndarray]], points: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Samples curves at common places. Between two places of a curve, the earlier value holds.

    Args:
      curves: non-decreasing places [E] and values [E] of each seed.
      points: maximum number of points.

    Returns:
      Places [P], whole numbers, and values [N, P]. None if a curve is empty, or if the curves do
      not overlap.
    """
    if not all(len(at) for at, _ in curves):
        return None
    begin, end = max(at[0] for at, _ in curves), min(at[-1] for at, _ in curves)
    if begin > end:
        return None
    grid = np.unique(np.linspace(begin, end, points).round())
    taken = [values[np.searchsorted(at, grid, side="right") - 1] for at, values in curves]
    return grid, np.array(taken)


class Unit(NamedTuple):
    """Writes values with their unit.

    Attributes:
      number: writes a value without its unit.
      suffix: the unit to write after a value.
      apart: the unit to write after a difference of two values.
    """

    number: Callable[[float], str]
    suffix: str = ""
    apart: str = ""

    def value(self, value: float) -> str:
        """Writes a value."""
        return f"{self.number(value)}{self.suffix}"

    def interval(self, of: Interval[float]) -> str:
        """Writes an estimate with its interval in brackets."""
        return f"{self.value(of.estimate)} ({self.number(of.low)} to {self.number(of.high)})"

    def difference(self, of: Interval[float]) -> str:
        """Writes a difference with its interval, each number with its sign."""
        estimate, low, high = map(self._signed, of)
        return f"{estimate}{self.apart} ({low} to {high})"

    def _signed(self, value: float) -> str:
        """Writes a difference with its sign, or without a sign if it is rounded to 0."""
        plain = self.number(abs(value))
        if not any(digit in plain for digit in "123456789"):
            return plain
        return ("+" if value > 0 else "\N{MINUS SIGN}") + plain


SHARE = Unit(lambda share: f"{100 * share:.1f}", " %", " points")
# Writes an episode number or a number of arena steps. inf means never.
PLACE = Unit(lambda place: "never" if math.isinf(place) else f"{place:,.0f}")
NUMBER = Unit(lambda value: f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}")
# The measures of `JUDGED` in the table of final policies, each with its heading and unit.
FINAL: dict[str, tuple[str, Unit]] = {
    "targets_reached": ("targets reached", SHARE),
    "all_reached": ("episodes in which all arrived", SHARE),
    "sensed_share": ("steps within infrared range", SHARE),
    "contacts_per_robot": ("contacts per robot and episode", NUMBER),
}
