"""Point estimates and their intervals, with NumPy alone (`curves.py` has learning curves).

Evaluation, benchmarks and studies compute their reported figures here, after Agarwal et al. 2021,
"Deep Reinforcement Learning at the Edge of the Statistical Precipice": interquartile means (section
4.3) with percentile intervals of a bootstrap (section 4.1). Values are [runs, tasks]. A run is a
training seed, and a task is a level or a stage on which the run's policy was judged.

A bootstrap draws with replacement the part of the data that its interval is about, and takes the
rest as given. The right draw depends on how the values were produced:

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

Drawing dependent values independently makes an interval too narrow. For example, if all runs meet
the same levels, a hard level is hard for all of them, but `tasks_per_run` would average this
difficulty out over the runs. The last two draws err on the wide side, because they count the spread
of single values twice (Davison & Hinkley 1997, "Bootstrap Methods and their Application", section
3.8; Owen 2007, "The pigeonhole bootstrap"). The error is small if there are many tasks.

Values may be inf, for example the steps to a threshold that was never reached. Inf counts as larger
than every number. A mean that includes inf is inf, and an end of an interval is inf if too many
resamples are inf. No function here turns inf into nan: calls in which inf would become nan are
refused. Values of nan and -inf are refused too.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

BLOCK = 2**20  # values resampled at once: 8 MiB, and a few times as much for their indices
# With two runs, half of all resamples hold one run twice, so the interval would just span both.
LEAST_DRAWN = 3
_LAST_TWO = (-2, -1)

type RunDraw = Literal["runs_per_task", "runs"]
type SharedDraw = Literal["tasks", "runs_and_tasks"]
type Draw = RunDraw | SharedDraw | Literal["tasks_per_run", "runs_then_tasks"]
# How a draw treats runs and tasks. It may keep them, or draw them whole. It may also draw runs
# separately for each task, or tasks separately for each run.
_DRAWS = {
    "runs_per_task": ("each", "kept"),
    "runs": ("whole", "kept"),
    "tasks_per_run": ("kept", "each"),
    "tasks": ("kept", "whole"),
    "runs_then_tasks": ("whole", "each"),
    "runs_and_tasks": ("whole", "whole"),
}


class Statistic(Protocol):
    """A statistic for a bootstrap: `iqm`, `cvar`, `np.mean`, `np.median`, or a partial of these."""

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
    """Computes the interquartile mean: the mean without the lowest and highest quarter of values.

    A quarter is rounded down to whole values, as in `scipy.stats.trim_mean(x, 0.25)`. So three
    values or fewer are not trimmed. In rliable this mean is called the IQM.

    Args:
      x: [...] values in any unit; if more than a quarter of them are inf, the result is inf.
      axis: axes to reduce, all of them together as if they were one; None for all axes.

    Returns:
      [...] without the reduced axes, in the unit of x.

    Raises:
      ValueError: x is empty, or holds nan or -inf.
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
    """Computes the conditional value at risk: the mean of the worst share of the values.

    It follows Rockafellar & Uryasev 2000, "Optimization of conditional value-at-risk". The share is
    rounded up to whole values, so it is never empty. If each level was tried only once, the result
    is worse than a result from the levels' expected values, because it also reflects chance.

    Args:
      x: [...] of any unit.
      share: share of the values, above 0 and at most 1.
      axis: axes to reduce, all of them together as if they were one; None for all axes.
      lowest: whether low values are the bad ones; otherwise high values are.

    Returns:
      [...] without the reduced axes, in the unit of x.

    Raises:
      ValueError: share is out of range, or x is empty or holds nan or -inf.
    """
    if not 0 < share <= 1:
        raise ValueError(f"share is {share}: give more than 0, at most 1.")
    values = _flat(x, axis)
    count = values.shape[-1]
    # Rounded first: 0.07 * 100 is 7.000000000000001, but means seven values.
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
    """Computes a percentile interval of a statistic (Efron & Tibshirani 1993, chapter 13).

    `draw` names the part that is drawn with replacement; see the table at the top of the module.

    With few runs the interval is too narrow: an interval of 95 % for the mean of 3, 5 or 10 normal
    values holds the truth in 75, 84 or 90 % of cases. The ends of the interval are statistics of
    resamples. If a percentile falls between two resamples, the outer one is used.

    Args:
      values: [runs, tasks] values in any unit; at least three runs if runs are drawn, and at least
        three tasks if tasks are drawn.
      statistic: called as `statistic(x, axis=(-2, -1))` on x [..., runs, tasks].
      draw: the part to draw, and therefore what the interval is about.
      strata: sizes of groups of consecutive tasks; tasks are drawn within each group (Efron &
        Tibshirani 1993, section 8.3). None draws among all tasks.
      confidence: confidence of the interval, above 0 and below 1.
      resamples: number of resamples, so large that at least one lies beyond each end of the
        interval.
      seed: seed of the draws.

    Returns:
      Estimate and interval, in the unit of the statistic.

    Raises:
      ValueError: an argument is refused, or the statistic gives nan or another shape.
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
    """Computes the interval of a difference: the statistic of b minus the statistic of a.

    Both are resampled with the same draws, so that shared influences (a level, a policy) cancel in
    the difference. Values at the same place form a pair.

    Args:
      a: [runs, tasks] of any unit, finite.
      b: [runs, tasks] of the same unit, in the same order.
      statistic: as in `bootstrap`.
      draw: as in `bootstrap`.
      strata: as in `bootstrap`.
      confidence: as in `bootstrap`.
      resamples: as in `bootstrap`.
      seed: seed of the draws.

    Returns:
      Difference and interval, in the unit of the statistic.

    Raises:
      ValueError: as in `bootstrap`, and if the shapes differ or a value is inf.
    """
    before, after = checked_table("a", a, draw), checked_table("b", b, draw)
    if before.shape != after.shape:
        raise ValueError(f"a is {before.shape} and b is {after.shape}: give pairs of equal shapes.")
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
    """Computes the interval of the probability that a beats b: P(a > b) + P(a = b) / 2.

    The probability is averaged over tasks. On each task the probability is U / (n m) of the
    Mann-Whitney test, as in Agarwal et al. 2021, section 4.3. The runs of a and b are resampled
    independently; drawn tasks are the same for both. Only the order of values matters, so inf is a
    value like any other. If small values are good, exchange a and b.

    Args:
      a: [n, tasks] values in any unit; at least three runs if runs are drawn, and at least three
        tasks if tasks are drawn.
      b: [m, tasks] of the same unit.
      draw: `runs_per_task`, `runs`, `tasks` or `runs_and_tasks`, as in `bootstrap`.
      strata: as in `bootstrap`.
      confidence: as in `bootstrap`.
      resamples: as in `bootstrap`.
      seed: seed of the draws.

    Returns:
      Probability and interval, 0 to 1.

    Raises:
      ValueError: as in `bootstrap`, and if tasks differ in number or are drawn for each run.
    """
    if draw not in ("runs_per_task", "runs", "tasks", "runs_and_tasks"):
        raise ValueError(f"draw is '{draw}': give runs_per_task, runs, tasks or runs_and_tasks.")
    ours, theirs = checked_table("a", a, draw), checked_table("b", b, draw)
    if ours.shape[1] != theirs.shape[1]:
        raise ValueError(
            f"a has {ours.shape[1]} tasks and b has {theirs.shape[1]}: give the same number of "
            "tasks."
        )
    _check_resampling(confidence, resamples)
    _check_strata(strata, ours.shape[1])
    wins = (ours[:, None] > theirs) + 0.5 * (ours[:, None] == theirs)
    random = np.random.default_rng(seed)
    draws = []
    for count in _blocks(resamples, wins.size):
        mine, tasks = _indices(random, draw, count, ours.shape, strata)
        other, _ = _indices(random, draw, count, theirs.shape, strata)
        # Axes: resamples, runs of a, runs of b, tasks. An axis that is not drawn has one resample.
        found = wins[mine[..., :, None, :], other[..., None, :, :], _widen(tasks)]
        draws.append(found.mean(axis=(1, 2, 3)))
    return _interval(float(wins.mean()), np.concatenate(draws), confidence)


def checked(name: str, x: ArrayLike) -> np.ndarray:
    """Converts numbers to double precision; refuses empty arrays, nan and -inf."""
    values = np.asarray(x, np.float64)
    if not values.size:
        raise ValueError(f"{name} is empty: its shape is {values.shape}.")
    if np.isnan(values).any():
        raise ValueError(f"{name} holds nan: {np.isnan(values).sum()} of {values.size} values.")
    if (values == -np.inf).any():
        raise ValueError(f"{name} holds -inf: give finite values, or inf for never reached.")
    return values


def _flat(x: ArrayLike, axis: int | tuple[int, ...] | None) -> np.ndarray:
    """Converts numbers, and merges the axes to reduce into a last one."""
    values = checked("x", x)
    if axis is None:
        return values.ravel()
    axes = np.lib.array_utils.normalize_axis_tuple(axis, values.ndim)
    moved = np.moveaxis(values, axes, range(-len(axes), 0))
    return moved.reshape(*moved.shape[: values.ndim - len(axes)], -1)


def checked_table(name: str, x: ArrayLike, draw: str) -> np.ndarray:
    """Converts numbers [runs, tasks]; refuses too few runs or tasks to draw from."""
    if draw not in _DRAWS:
        raise ValueError(f"draw is '{draw}': give one of {', '.join(_DRAWS)}.")
    values = checked(name, x)
    if values.ndim != 2:
        raise ValueError(f"{name} has shape {values.shape}: give [runs, tasks].")
    for what, how, count in zip(("runs", "tasks"), _DRAWS[draw], values.shape, strict=True):
        if how != "kept" and count < LEAST_DRAWN:
            raise ValueError(
                f"{name} has {count} {what}: an interval over {what} needs {LEAST_DRAWN} or more."
            )
    return values


def _check_resampling(confidence: float, resamples: int) -> None:
    if not 0 < confidence < 1:
        raise ValueError(f"confidence is {confidence}: give more than 0 and less than 1.")
    # The small number allows for rounding: 20 * (1 - 0.9) is 1.9999999999999996.
    if resamples * (1 - confidence) < 2 - 1e-9:
        raise ValueError(
            f"resamples is {resamples}: too few for confidence {confidence}. Give more resamples "
            "or a lower confidence."
        )


def _blocks(resamples: int, cells: int) -> Iterator[int]:
    """Splits resamples, with the given number of values each, into blocks that fit the memory."""
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
    """Draws indices of values [runs, tasks]: two arrays that broadcast to [count, runs, tasks]."""
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
    """Returns the bounds of the group that each task is drawn from."""
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
    """Adds an axis for another table's runs to indices of tasks [tasks] or [count, 1, tasks]."""
    return tasks if tasks.ndim == 1 else tasks[:, :, None]


def _distributions(
    tables: tuple[np.ndarray, ...],
    statistic: Statistic,
    draw: str,
    resamples: int,
    seed: int,
    strata: Sequence[int] | None = None,
) -> np.ndarray:
    """Computes statistics [tables, resamples] of tables of one shape, all with the same draws."""
    random = np.random.default_rng(seed)
    found = []
    for count in _blocks(resamples, tables[0].size):
        index = _indices(random, draw, count, tables[0].shape, strata)
        found.append([_apply(statistic, table[index]) for table in tables])
    return np.concatenate(found, axis=1)


def _apply(statistic: Statistic, x: np.ndarray) -> np.ndarray:
    """Computes statistics [...] of x [..., runs, tasks]."""
    found = np.asarray(statistic(x, axis=_LAST_TWO))
    if found.shape != x.shape[:-2]:
        raise ValueError(
            f"statistic of values of shape {x.shape} has shape {found.shape}: give {x.shape[:-2]}."
        )
    if np.isnan(found).any():
        raise ValueError("statistic gives nan for values without nan.")
    return found


def _interval(estimate: float, draws: np.ndarray, confidence: float) -> Interval[float]:
    """Computes the percentile interval of draws [resamples].

    The interval's ends are draws, never mixtures of two draws, because a mixture of inf and inf
    would be nan.
    """
    last = len(draws) - 1
    low = math.floor((1 - confidence) / 2 * last)
    ordered = np.partition(draws, (low, last - low))
    return Interval(estimate, float(ordered[low]), float(ordered[last - low]))
