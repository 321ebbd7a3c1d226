"""Point estimates and their intervals, with NumPy alone (of learning curves: `curves.py`).

What evaluation, benchmarks and studies report is worked out here, after Agarwal et al. 2021, "Deep
Reinforcement Learning at the Edge of the Statistical Precipice": interquartile means (section 4.3)
with percentile intervals of a bootstrap (section 4.1). Values are [runs, tasks]: a run is a seed
of the training, a task is a level or a stage that its policy was judged on.

A bootstrap draws anew, with replacement, what its interval speaks of; the rest is taken as given.
Which draw fits depends on how the values came about:

=================  ==========================================  ==================================
draw               each resample                               the interval is about
=================  ==========================================  ==================================
`runs_per_task`    draws runs for each task by itself, as      other runs, which train on each
                   rliable does (stratified by task)           task by itself
`runs`             draws runs with all their tasks             other runs, each judged on all
                                                               these tasks
`tasks_per_run`    draws tasks for each run by itself          these runs, each on other tasks of
                                                               its own
`tasks`            draws tasks with all their runs             these runs, all on the same other
                                                               tasks
`runs_then_tasks`  draws runs, then tasks for each by itself   other runs, each on other tasks of
                                                               its own
`runs_and_tasks`   draws runs, and tasks for all of them       other runs, all on the same other
                                                               tasks
=================  ==========================================  ==================================

To draw apart what hangs together makes an interval too narrow: where all runs meet the same
levels, a hard one is hard for all, and `tasks_per_run` would let that average out over the runs.
The last two err on the wide side: they meet the spread of single values twice (Davison & Hinkley
1997, "Bootstrap Methods and their Application", section 3.8; Owen 2007, "The pigeonhole
bootstrap"), which matters little where tasks are many.

Values may be inf, as the steps to a threshold are that was never reached. It sorts after every
number, a mean with it is inf, and an end of an interval is inf where too many resamples are.
Nothing here turns inf into nan; what would have to is refused, as are nan and -inf.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

BLOCK = 2**20  # values resampled at once: 8 MiB, and a few times as much for their indices
# Half of all resamples of two runs are one of them twice: the interval would just span the two.
LEAST_DRAWN = 3
_LAST_TWO = (-2, -1)

type RunDraw = Literal["runs_per_task", "runs"]
type SharedDraw = Literal["tasks", "runs_and_tasks"]
type Draw = RunDraw | SharedDraw | Literal["tasks_per_run", "runs_then_tasks"]
# How runs and tasks are taken: kept as they are, drawn whole, or drawn for each of the other.
_DRAWS = {
    "runs_per_task": ("each", "kept"),
    "runs": ("whole", "kept"),
    "tasks_per_run": ("kept", "each"),
    "tasks": ("kept", "whole"),
    "runs_then_tasks": ("whole", "each"),
    "runs_and_tasks": ("whole", "whole"),
}


class Statistic(Protocol):
    """What a bootstrap can judge: `iqm`, `cvar`, `np.mean`, `np.median`, or a partial of such."""

    def __call__(self, x: np.ndarray, /, *, axis: tuple[int, int]) -> Any:
        """Reduces two axes of x [..., runs, tasks]; returns [...]."""
        ...


class Interval[T](NamedTuple):
    """An estimate with its interval.

    Attributes:
      estimate: the statistic of the values themselves.
      low: lower end of the interval.
      high: upper end.
    """

    estimate: T
    low: T
    high: T


def iqm(x: ArrayLike, axis: int | tuple[int, ...] | None = None) -> np.float64 | np.ndarray:
    """Interquartile mean: what is left without the lowest and the highest quarter, in the mean.

    A quarter is rounded down to whole values, as in `scipy.stats.trim_mean(x, 0.25)`, which is
    what rliable calls the IQM. Three values or fewer are thus not trimmed.

    Args:
      x: [...] of any unit; with inf in more than a quarter of it, the result is inf.
      axis: to reduce, several as if they were one; None for all.

    Returns:
      [...] without the axes, in the unit of x.

    Raises:
      ValueError: If x is empty, or holds nan or -inf.
    """
    values = _flat(x, axis)
    count = values.shape[-1]
    cut = count // 4
    ordered = np.partition(values, (cut, count - cut - 1), axis=-1)
    return ordered[..., cut : count - cut].mean(axis=-1)


def cvar(
    x: ArrayLike,
    share: float = 0.05,
    axis: int | tuple[int, ...] | None = None,
    *,
    lowest: bool = True,
) -> np.float64 | np.ndarray:
    """Conditional value at risk: the mean of the worst share of the values.

    Rockafellar & Uryasev 2000, "Optimization of conditional value-at-risk", of a sample whose
    share is rounded up to whole values, so that it is never empty. It takes in the luck of each
    value too: over levels that were tried once, it lies below that of the levels' expectations.

    Args:
      x: [...] of any unit.
      share: of the values, above 0 to 1.
      axis: to reduce, several as if they were one; None for all.
      lowest: whether low values are the bad ones; else high ones.

    Returns:
      [...] without the axes, in the unit of x.

    Raises:
      ValueError: If share is out of range, or x is empty or holds nan or -inf.
    """
    if not 0 < share <= 1:
        raise ValueError(f"share is {share}: give more than 0, to 1.")
    values = _flat(x, axis)
    count = values.shape[-1]
    # Rounded first: 0.07 * 100 is 7.000000000000001, and no more than seven values.
    worst = math.ceil(round(share * count, 9)) or 1
    if lowest:
        return np.partition(values, worst - 1, axis=-1)[..., :worst].mean(axis=-1)
    return np.partition(values, count - worst, axis=-1)[..., count - worst :].mean(axis=-1)


def bootstrap(
    values: ArrayLike,
    statistic: Statistic,
    *,
    draw: Draw = "runs_per_task",
    strata: Sequence[int] | None = None,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval[float]:
    """Percentile interval of a statistic of [runs, tasks] (Efron & Tibshirani 1993, chapter 13).

    Drawn anew, with replacement, is what `draw` names; see the table at the top of the module.

    With few runs the interval is too narrow: about the mean of 3, 5 or 10 normal values, one of
    95 % holds the truth in 75, 84 or 90 % of cases. Its ends are statistics of resamples, the
    outer one where a percentile falls between two.

    Args:
      values: [runs, tasks] of any unit, at least three of what is drawn.
      statistic: called as `statistic(x, axis=(-2, -1))` on x [..., runs, tasks].
      draw: what is drawn, and so what the interval is about.
      strata: numbers of tasks, in their order, among which tasks are drawn (Efron & Tibshirani
        1993, section 8.3); None draws among all of them.
      confidence: of the interval, above 0 and below 1.
      resamples: how many, enough for one beyond either end of the interval.
      seed: of the draws.

    Returns:
      Estimate and interval, in the unit of the statistic.

    Raises:
      ValueError: If any of these is refused, or the statistic gives nan or another shape.
    """
    table = checked_table("values", values, draw)
    _check_resampling(confidence, resamples)
    _check_strata(strata, table.shape[1])
    draws = _distributions((table,), statistic, draw, resamples, seed, strata)[0]
    return _interval(float(_apply(statistic, table)), draws, confidence)


def paired(
    a: ArrayLike,
    b: ArrayLike,
    statistic: Statistic,
    *,
    draw: Draw = "runs_per_task",
    strata: Sequence[int] | None = None,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval[float]:
    """Interval of how much larger a statistic of b is than that of a: b - a.

    Both are resampled by the same draws, so that what they share (a level, a policy) drops out
    of the difference. Values are the same pair by the same place.

    Args:
      a: [runs, tasks] of any unit, finite.
      b: [runs, tasks] of the same, in the same order.
      statistic: as of `bootstrap`.
      draw: as of `bootstrap`.
      strata: as of `bootstrap`.
      confidence: as of `bootstrap`.
      resamples: as of `bootstrap`.
      seed: of the draws.

    Returns:
      Difference and interval, in the unit of the statistic.

    Raises:
      ValueError: As of `bootstrap`, and if the shapes differ or a value is inf.
    """
    before, after = checked_table("a", a, draw), checked_table("b", b, draw)
    if before.shape != after.shape:
        raise ValueError(f"a is {before.shape} and b is {after.shape}: pairs take equal shapes.")
    for name, table in (("a", before), ("b", after)):
        if np.isinf(table).any():
            raise ValueError(
                f"{name} holds inf, and inf - inf is no number: use probability_of_improvement."
            )
    _check_resampling(confidence, resamples)
    _check_strata(strata, before.shape[1])
    of_a, of_b = _distributions((before, after), statistic, draw, resamples, seed, strata)
    estimate = float(_apply(statistic, after)) - float(_apply(statistic, before))
    return _interval(estimate, of_b - of_a, confidence)


def probability_of_improvement(
    a: ArrayLike,
    b: ArrayLike,
    *,
    draw: RunDraw | SharedDraw = "runs_per_task",
    strata: Sequence[int] | None = None,
    confidence: float = 0.95,
    resamples: int = 2000,
    seed: int = 0,
) -> Interval[float]:
    """Interval of how likely a run of a is to beat one of b: P(a > b) + P(a = b) / 2.

    Averaged over tasks. On each it is U / (n m) of the Mann-Whitney test, as in Agarwal et al.
    2021, section 4.3; resamples of the runs of a and b are independent, tasks that are drawn are
    the same for both. Only the order of values counts, so that inf is a value like any other.
    Where small is good, exchange a and b.

    Args:
      a: [n, tasks] of any unit, at least three of what is drawn.
      b: [m, tasks] of the same.
      draw: `runs_per_task`, `runs`, `tasks` or `runs_and_tasks`, as of `bootstrap`.
      strata: as of `bootstrap`.
      confidence: as of `bootstrap`.
      resamples: as of `bootstrap`.
      seed: of the draws.

    Returns:
      Probability and interval, 0 to 1.

    Raises:
      ValueError: As of `bootstrap`, and if tasks differ in number or are drawn for each run.
    """
    if draw not in ("runs_per_task", "runs", "tasks", "runs_and_tasks"):
        raise ValueError(f"draw is '{draw}': give runs_per_task, runs, tasks or runs_and_tasks.")
    ours, theirs = checked_table("a", a, draw), checked_table("b", b, draw)
    if ours.shape[1] != theirs.shape[1]:
        raise ValueError(f"a has {ours.shape[1]} tasks and b has {theirs.shape[1]}: give the same.")
    _check_resampling(confidence, resamples)
    _check_strata(strata, ours.shape[1])
    wins = (ours[:, None] > theirs) + 0.5 * (ours[:, None] == theirs)
    random = np.random.default_rng(seed)
    draws = []
    for count in _blocks(resamples, wins.size):
        mine, tasks = _indices(random, draw, count, ours.shape, strata)
        other, _ = _indices(random, draw, count, theirs.shape, strata)
        # Axes: resamples, runs of a, runs of b, tasks; one that is not drawn has one resample.
        found = wins[mine[..., :, None, :], other[..., None, :, :], _widen(tasks)]
        draws.append(found.mean(axis=(1, 2, 3)))
    return _interval(float(wins.mean()), np.concatenate(draws), confidence)


def checked(name: str, x: ArrayLike) -> np.ndarray:
    """Takes numbers in double precision; refuses none at all, nan and -inf."""
    values = np.asarray(x, np.float64)
    if not values.size:
        raise ValueError(f"{name} is empty: its shape is {values.shape}.")
    if np.isnan(values).any():
        raise ValueError(f"{name} holds nan: {np.isnan(values).sum()} of {values.size} values.")
    if (values == -np.inf).any():
        raise ValueError(f"{name} holds -inf: only inf has a meaning here, never reached.")
    return values


def _flat(x: ArrayLike, axis: int | tuple[int, ...] | None) -> np.ndarray:
    """Takes numbers, with the axes that are to be reduced as the last one."""
    values = checked("x", x)
    if axis is None:
        return values.ravel()
    axes = np.lib.array_utils.normalize_axis_tuple(axis, values.ndim)
    moved = np.moveaxis(values, axes, range(-len(axes), 0))
    return moved.reshape(*moved.shape[: values.ndim - len(axes)], -1)


def checked_table(name: str, x: ArrayLike, draw: str) -> np.ndarray:
    """Takes numbers [runs, tasks]; refuses too few of what is to be drawn."""
    if draw not in _DRAWS:
        raise ValueError(f"draw is '{draw}': give one of {', '.join(_DRAWS)}.")
    values = checked(name, x)
    if values.ndim != 2:
        raise ValueError(f"{name} has shape {values.shape}: give [runs, tasks].")
    for what, how, count in zip(("runs", "tasks"), _DRAWS[draw], values.shape, strict=True):
        if how != "kept" and count < LEAST_DRAWN:
            raise ValueError(
                f"{name} has {count} {what}: an interval over {what} takes {LEAST_DRAWN} or more."
            )
    return values


def _check_resampling(confidence: float, resamples: int) -> None:
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}: give more than 0 and less than 1.")
    # The small number is for what rounding takes: 20 * (1 - 0.9) is 1.9999999999999996.
    if resamples * (1 - confidence) < 2 - 1e-9:
        raise ValueError(f"resamples is {resamples}: too few for confidence {confidence}.")


def _blocks(resamples: int, cells: int) -> Iterator[int]:
    """Splits resamples of so many values each into numbers of them that memory holds."""
    block = max(1, BLOCK // cells)
    for first in range(0, resamples, block):
        yield min(block, resamples - first)


def _indices(
    random: np.random.Generator,
    draw: str,
    count: int,
    shape: tuple[int, ...],
    strata: Sequence[int] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Draws where to take values [runs, tasks] from: two indices that fit [count, runs, tasks]."""
    by_run, by_task = _DRAWS[draw]
    runs, tasks = shape
    row, column = np.arange(runs)[:, None], np.arange(tasks)
    if by_run != "kept":
        row = random.integers(runs, size=(count, runs, tasks if by_run == "each" else 1))
    if by_task != "kept":
        low, high = _bounds(strata, tasks)
        size = (count, runs if by_task == "each" else 1, tasks)
        column = random.integers(low, high, size=size)
    return row, column


def _bounds(strata: Sequence[int] | None, tasks: int) -> tuple[Any, Any]:
    """From where to where each of the tasks is drawn."""
    if strata is None:
        return 0, tasks
    ends = np.cumsum(strata)
    return np.repeat(ends - strata, strata), np.repeat(ends, strata)


def _check_strata(strata: Sequence[int] | None, tasks: int) -> None:
    if strata is not None and (min(strata, default=0) < LEAST_DRAWN or sum(strata) != tasks):
        raise ValueError(
            f"strata is {list(strata)}: give numbers of {LEAST_DRAWN} or more that add up to "
            f"{tasks}."
        )


def _widen(tasks: np.ndarray) -> np.ndarray:
    """Gives indices of tasks [tasks] or [count, 1, tasks] an axis for the runs of another table."""
    return tasks if tasks.ndim == 1 else tasks[:, :, None]


def _distributions(
    tables: tuple[np.ndarray, ...],
    statistic: Statistic,
    draw: str,
    resamples: int,
    seed: int,
    strata: Sequence[int] | None = None,
) -> np.ndarray:
    """Statistics [tables, resamples] of tables of one shape, resampled by the same draws."""
    random = np.random.default_rng(seed)
    found = []
    for count in _blocks(resamples, tables[0].size):
        index = _indices(random, draw, count, tables[0].shape, strata)
        found.append([_apply(statistic, table[index]) for table in tables])
    return np.concatenate(found, axis=1)


def _apply(statistic: Statistic, x: np.ndarray) -> np.ndarray:
    """Statistics [...] of x [..., runs, tasks]."""
    found = np.asarray(statistic(x, axis=_LAST_TWO))
    if found.shape != x.shape[:-2]:
        raise ValueError(f"statistic of {x.shape} has shape {found.shape}: give {x.shape[:-2]}.")
    if np.isnan(found).any():
        raise ValueError("statistic gives nan of values that hold none.")
    return found


def _interval(estimate: float, draws: np.ndarray, confidence: float) -> Interval[float]:
    """Percentile interval of draws [resamples].

    Its ends are draws, rather than mixtures of two, which between inf and inf are nan.
    """
    last = len(draws) - 1
    low = math.floor((1 - confidence) / 2 * last)
    ordered = np.partition(draws, (low, last - low))
    return Interval(estimate, float(ordered[low]), float(ordered[last - low]))
