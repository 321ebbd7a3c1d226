"""Times two programs alternately, and gives intervals for the ratio of their times."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from math import comb

import jax
import numpy as np

from swarmjax.run import trainer
from swarmjax.run.settings import TrainConfig
from swarmjax.training import mesh
from swarmjax.training import program as programs


class Arm:
    """A training program with its state; every call continues the training.

    Attributes:
      settings: the program's config.
      compile_s: compile time, s.
      transitions: number of robot steps in the last call, summed over all seeds.
    """

    def __init__(self, settings: TrainConfig) -> None:
        program, schedule = programs.load(settings)
        self.settings = settings
        self._state = jax.jit(mesh.init(program))(schedule)
        compiled = trainer.compile_chunk(program, schedule, self._state)
        self._train = partial(compiled.call, schedule)
        self.compile_s = compiled.seconds
        self.transitions = 0

    def time(self, updates: int) -> float:
        """Trains for some updates and returns the seconds that this took."""
        began = time.perf_counter()
        self._state, metrics = self._train(self._state, np.int32(updates))
        jax.block_until_ready(metrics)
        seconds = time.perf_counter() - began
        self.transitions = int(np.asarray(metrics["transitions"])[:, :updates].sum(dtype=np.int64))
        return seconds


def time_in_turn(one: Arm, other: Arm, updates: int, pairs: int) -> list[tuple[float, float]]:
    """Times calls of two arms alternately, after one warm-up call of each.

    Args:
      one: an arm.
      other: another arm.
      updates: number of updates per call.
      pairs: number of pairs of calls; the arm that comes first alternates.

    Returns:
      Seconds of `one` and `other` for each pair.
    """
    for each in (one, other):
        each.time(updates)
    return in_turn(partial(one.time, updates), partial(other.time, updates), pairs)


def in_turn[T](one: Callable[[], T], other: Callable[[], T], pairs: int) -> list[tuple[T, T]]:
    """Calls two functions in pairs, and swaps their order from pair to pair.

    Args:
      one: a function.
      other: another function.
      pairs: number of pairs of calls.

    Returns:
      Results of `one` and `other` for each pair.
    """
    found = []
    for i in range(pairs):
        first, second = (one, other) if i % 2 == 0 else (other, one)
        a, b = first(), second()
        found.append((a, b) if i % 2 == 0 else (b, a))
    return found


def median(values: Sequence[float]) -> tuple[float, float, float]:
    """Returns the median and an interval with at least 95 % probability for the true median.

    If the n values are independent, the number of values below the true median is distributed like
    the number of heads in n coin tosses. This holds for any distribution of the values. The
    interval runs from the k-th smallest to the k-th largest value. Here k is the largest number for
    which the true median lies beyond either end with a probability of at most 2.5 %.

    Args:
      values: at least 6 values.

    Returns:
      The median, and the lower and the upper end of the interval.
    """
    ordered, n = sorted(values), len(values)
    below = np.cumsum([comb(n, heads) / 2**n for heads in range(n + 1)])
    k = int(np.searchsorted(below, 0.025, side="right"))
    if k < 1:
        raise ValueError(f"values are {n}: give at least 6 for an interval of 95 %.")
    return float(np.median(ordered)), ordered[k - 1], ordered[n - k]
