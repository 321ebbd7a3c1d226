"""Point estimates and their intervals, with NumPy alone.

Evaluation, benchmarks and studies compute their reported numbers here, after Agarwal et al. 2021,
"Deep Reinforcement Learning at the Edge of the Statistical Precipice": interquartile means (section
4.3) with percentile intervals of a bootstrap (section 4.1). Values have shape [runs, tasks]. A
run is a training seed, and a task is a level or a stage on which the run's policy was evaluated.

A bootstrap draws with replacement the part of the data to which its interval generalises, and keeps
the rest fixed. Which part to draw depends on how the values were produced:

=================  ==========================================  ==================================
draw               each resample                               the interval is about
=================  ==========================================  ==================================
`runs`             draws runs with all their tasks             other runs, each tested on all
                                                               these tasks
`tasks`            draws tasks with all their runs             these runs, all on the same other
                                                               tasks
`runs_and_tasks`   draws runs, and tasks for all of them       other runs, all on the same other
                                                               tasks
=================  ==========================================  ==================================

Drawing dependent values independently makes an interval too narrow. For example, if all runs meet
the same levels, a hard level is hard for all of them, and drawing levels for each run would average
this difficulty out. Intervals of `runs_and_tasks` are too wide, because they count the spread of
single values twice (Owen 2007, "The pigeonhole bootstrap"). With many tasks the error is small.

Values may be inf, for example the steps to a threshold that was never reached. Inf is larger than
every number. A mean that includes inf is inf, and an end of an interval is inf if too many
resamples are inf. The functions refuse values of nan and -inf, and calls in which inf would become
nan.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

BLOCK = 2**20  # values resampled at once: 8 MiB, and a few times as much for their indices
# With two runs, half of all resamples hold one run twice, so the interval would span both runs.
LEAST_DRAWN = 3
CONFIDENCE = 0.95  # level of every interval
RESAMPLES = 2000

type Draw = Literal["runs", "tasks", "runs_and_tasks"]
# Reduces two axes of x [..., runs, tasks], as `iqm`, `cvar`, `np.mean` and partials of these do.
type Statistic = Callable[..., Any]


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

    A quarter is rounded down to whole values, as in `scipy.stats.trim_mean(x, 0.25)`. So of three
    values or fewer, none is left out. The library rliable calls this mean the IQM.

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
    rounded up to whole values, so it is never empty. If each level was tried only once, the worst
    results include bad luck.

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
        raise ValueError(f"share is {share}: give a number above 0 and at most 1.")
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
    draw: Draw = "runs",
    strata: Sequence[int] | None = None,
    resamples: int = RESAMPLES,
) -> Interval[float]:
    """Computes a percentile interval of a statistic (Efron & Tibshirani 1993, chapter 13).

    `draw` names the part that is drawn with replacement; see the table at the top of the module.

    With few runs the interval is too narrow: a 95 % interval for the mean of 3, 5 or 10 normal
    values contains the true mean in 75, 84 or 90 % of cases. If a percentile falls between the
    statistics of two resamples, the interval ends at the outer one.

    Args:
      values: [runs, tasks] values in any unit; at least three runs if runs are drawn, and at least
        three tasks if tasks are drawn.
      statistic: called as `statistic(x, axis=(-2, -1))` on x [..., runs, tasks].
      draw: the part to draw, to which the interval generalises.
      strata: sizes of groups of consecutive tasks; tasks are drawn within each group (Efron &
        Tibshirani 1993, section 8.3). None draws among all tasks.
      resamples: number of resamples; 40 or more, so that one lies beyond each end of the interval.

    Returns:
      Estimate and interval, in the unit of the statistic.

    Raises:
      ValueError: the values are empty, too few, or hold nan or -inf.
    """
    table = _table("values", values, draw)
    how = _How(draw, strata, resamples, table.size)
    return _resampled(lambda at: statistic(table[at], axis=(-2, -1)), how, table.shape)


def paired(
    a: ArrayLike,
    b: ArrayLike,
    statistic: Statistic,
    *,
    draw: Draw = "runs",
    strata: Sequence[int] | None = None,
    resamples: int = RESAMPLES,
) -> Interval[float]:
    """Computes the interval of a difference: the statistic of b minus the statistic of a.

    Both are resampled with the same draws, so that influences of a level or a seed on both cancel
    in the difference. Values at the same place form a pair.

    Args:
      a: [runs, tasks] of any unit, finite.
      b: [runs, tasks] of the same unit, in the same order.
      statistic: as in `bootstrap`.
      draw: as in `bootstrap`.
      strata: as in `bootstrap`.
      resamples: as in `bootstrap`.

    Returns:
      Difference and interval, in the unit of the statistic.

    Raises:
      ValueError: as in `bootstrap`, and if the shapes differ or a value is inf.
    """
    before, after = _table("a", a, draw), _table("b", b, draw)
    if before.shape != after.shape:
        raise ValueError(f"a is {before.shape} and b is {after.shape}: give equal shapes.")
    for name, table in (("a", before), ("b", after)):
        if np.isinf(table).any():
            raise ValueError(
                f"{name} holds inf, and inf - inf is not defined: use probability_of_improvement."
            )

    def difference(at: _Index) -> np.ndarray:
        of_b, of_a = (statistic(table[at], axis=(-2, -1)) for table in (after, before))
        return of_b - of_a

    return _resampled(difference, _How(draw, strata, resamples, before.size), before.shape)


def probability_of_improvement(
    a: ArrayLike,
    b: ArrayLike,
    *,
    draw: Draw = "runs",
    strata: Sequence[int] | None = None,
    resamples: int = RESAMPLES,
) -> Interval[float]:
    """Computes the interval of the probability that a beats b: P(a > b) + P(a = b) / 2.

    The probability is averaged over tasks. On each task the probability is U / (n m) of the
    Mann-Whitney test, as in Agarwal et al. 2021, section 4.3. Runs of a and runs of b are drawn
    independently; drawn tasks are the same for both. Only the order of values matters, so inf is a
    value like any other. If small values are good, exchange a and b.

    Args:
      a: [n, tasks] values in any unit; at least three runs if runs are drawn, and at least three
        tasks if tasks are drawn.
      b: [m, tasks] of the same unit.
      draw: as in `bootstrap`.
      strata: as in `bootstrap`.
      resamples: as in `bootstrap`.

    Returns:
      Probability and interval, 0 to 1.

    Raises:
      ValueError: as in `bootstrap`, and if a and b have different numbers of tasks.
    """
    ours, theirs = _table("a", a, draw), _table("b", b, draw)
    if ours.shape[1] != theirs.shape[1]:
        raise ValueError(
            f"a has {ours.shape[1]} tasks and b has {theirs.shape[1]}: give the same number of "
            "tasks."
        )
    wins = (ours[:, None] > theirs) + 0.5 * (ours[:, None] == theirs)

    def chance(at: _Index, other: _Index) -> np.ndarray:
        (mine, tasks), (their, _) = at, other
        # Axes: resamples, runs of a, runs of b, tasks. An axis that is not drawn has one resample.
        drawn = wins[mine[..., :, None, :], their[..., None, :, :], tasks[..., None, :]]
        return drawn.mean(axis=(-3, -2, -1))

    return _resampled(chance, _How(draw, strata, resamples, wins.size), ours.shape, theirs.shape)


def curve(
    values: ArrayLike, statistic: Statistic = iqm, *, resamples: int = RESAMPLES
) -> Interval[np.ndarray]:
    """Computes the interval of a statistic over runs at each point of their curves.

    All points use the same draws, so each drawn run contributes its whole curve. The confidence
    holds for each point by itself, not for all points at once.

    Args:
      values: [runs, points] values in any unit, of at least three runs.
      statistic: as in `bootstrap`, called on [..., runs, 1].
      resamples: as in `bootstrap`.

    Returns:
      Estimates and intervals [points].

    Raises:
      ValueError: As in `bootstrap`.
    """
    columns = _table("values", values, "runs").T[..., None]
    points = [bootstrap(each, statistic, resamples=resamples) for each in columns]
    return Interval(*np.array(points).T)


def checked(name: str, x: ArrayLike) -> np.ndarray:
    """Converts numbers to double precision; refuses empty arrays, nan and -inf."""
    values = np.asarray(x, np.float64)
    if not values.size:
        raise ValueError(f"{name} is empty: its shape is {values.shape}.")
    if np.isnan(values).any():
        raise ValueError(f"{name} holds nan: {np.isnan(values).sum()} of {values.size} values.")
    if (values == -np.inf).any():
        raise ValueError(f"{name} holds -inf: give numbers, or inf if never reached.")
    return values


def _flat(x: ArrayLike, axis: int | tuple[int, ...] | None) -> np.ndarray:
    """Converts numbers to double precision, and merges the axes to reduce into one last axis."""
    values = checked("x", x)
    if axis is None:
        return values.ravel()
    axes = np.lib.array_utils.normalize_axis_tuple(axis, values.ndim)
    moved = np.moveaxis(values, axes, range(-len(axes), 0))
    return moved.reshape(*moved.shape[: values.ndim - len(axes)], -1)


def _table(name: str, x: ArrayLike, draw: str) -> np.ndarray:
    """Converts numbers [runs, tasks] to double precision; refuses too few to draw from."""
    values = checked(name, x)
    if values.ndim != 2:
        raise ValueError(f"{name} has shape {values.shape}: give an array of shape [runs, tasks].")
    for what, count in zip(("runs", "tasks"), values.shape, strict=True):
        if what in draw and count < LEAST_DRAWN:
            raise ValueError(
                f"{name} has {count} {what}: an interval over {what} needs {LEAST_DRAWN} or more."
            )
    return values


# Rows and columns of values, which broadcast to [runs, tasks] or to [count, runs, tasks].
type _Index = tuple[np.ndarray, np.ndarray]


class _How(NamedTuple):
    """How values [runs, tasks] are drawn; `size` is the number of values in a resample."""

    draw: Draw
    strata: Sequence[int] | None
    resamples: int
    size: int

    def indices(self, random: np.random.Generator, count: int, shape: tuple[int, ...]) -> _Index:
        """Draws indices of `count` resamples."""
        runs, tasks = shape
        row, column = _all(shape)
        if "runs" in self.draw:
            row = random.integers(runs, size=(count, runs, 1))
        if "tasks" in self.draw:
            strata = self.strata or [tasks]
            ends = np.repeat(np.cumsum(strata), strata)
            column = random.integers(ends - np.repeat(strata, strata), ends, (count, 1, tasks))
        return row, column


def _all(shape: tuple[int, ...]) -> _Index:
    """Returns the indices of the values themselves."""
    runs, tasks = shape
    return np.arange(runs)[:, None], np.arange(tasks)[None]


def _resampled(
    compute: Callable[..., np.ndarray], how: _How, *shapes: tuple[int, ...]
) -> Interval[float]:
    """Computes the percentile interval of a statistic of tables with these shapes.

    The interval's ends are the statistics of resamples, never interpolated between two of them,
    because interpolating between inf and inf would give nan.
    """
    random, draws = np.random.default_rng(0), []
    block = max(1, BLOCK // how.size)  # resamples that fit the memory
    for first in range(0, how.resamples, block):
        count = min(block, how.resamples - first)
        draws.append(compute(*(how.indices(random, count, shape) for shape in shapes)))
    last = how.resamples - 1
    low = math.floor((1 - CONFIDENCE) / 2 * last)
    ordered = np.partition(np.concatenate(draws), (low, last - low))
    estimate = compute(*map(_all, shapes))
    return Interval(float(estimate), float(ordered[low]), float(ordered[last - low]))
