"""Times compiled programs, and compares the training speed of two checkouts or two settings.

`python -m benchmarks.timing [before=DIR] [than='key=value ...'] [key=value ...]` takes the keys of
`swarmjax.train`. Two processes train in turn, `PAIRS` times: one with the code in `before`, a
checkout, and one with this tree's code and with the further settings `than`. Without `before` both
run this tree's code, and without `than` both have the same settings. The command prints a JSON line
with the ratio of this side's arena steps per second to the other side's, as a median with a 95 %
interval by order statistics. Examples are `than=seeds=10`, `than=realism=real` and
`than='devices=2 arenas=131072'`.
"""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import comb
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks import lines
from swarmjax import command, provenance
from swarmjax.config import ConfigError, Section, about
from swarmjax.run.compiled import compile_chunk
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.training import mesh
from swarmjax.training import program as programs

REPEATS = 5
PAIRS = 15
CALL_SECONDS = 0.7  # s; approximate time of a call of either side
# Program of both processes; each process runs it with its checkout as working directory. Trees up
# to d8b3078 have the class in another module.
_SIDE = """
import sys
try:
    from benchmarks.timing import Arm
except ImportError:
    from benchmarks.pairs import Arm
from swarmjax.run.load_settings import load_train
arm = Arm(load_train(sys.argv[1:]))
print(arm.compile_s, flush=True)
for line in sys.stdin:
    print(arm.time(int(line)), flush=True)
"""


class TimedProgram(NamedTuple):
    """A compiled program `(state, argument) -> (state, rest)` that donates the state.

    Attributes:
      call: the program.
      compile_s: seconds of tracing and compiling.
      size: bytes of device memory that a call needs, including arguments and results, from XLA's
        analysis; Warp's own allocations are not included.
    """

    call: Callable[[Any, Any], tuple[Any, Any]]
    compile_s: float
    size: int


def compile_program(call: Callable[[Any, Any], Any], state: Any, argument: Any) -> TimedProgram:
    """Compiles a program ahead of time.

    Args:
      call: `(state, argument) -> (state, rest)`.
      state: the state, or its shapes.
      argument: the argument, or its shapes.

    Returns:
      The program.
    """
    began = time.perf_counter()
    lowered = jax.jit(call, donate_argnums=0).lower(state, argument)
    compiled = lowered.compile(programs.compiler_options())
    seconds = time.perf_counter() - began
    memory = compiled.memory_analysis()
    assert memory is not None  # available on both CPU and GPU
    size = memory.argument_size_in_bytes + memory.temp_size_in_bytes
    size += memory.output_size_in_bytes - memory.alias_size_in_bytes
    return TimedProgram(compiled, seconds, size)


def time_program(
    program: TimedProgram, state: Any, argument: Any, repeats: int = REPEATS
) -> tuple[list[float], Any]:
    """Times calls after a warm-up call; each call continues with the state of the previous call.

    Args:
      program: the program to call.
      state: the first state; it is donated.
      argument: argument of every call.
      repeats: number of timed calls.

    Returns:
      Seconds of each timed call, and the rest that the last call returned.
    """
    taken, rest = [], None
    for _ in range(1 + repeats):
        began = time.perf_counter()
        state, rest = program.call(state, argument)
        jax.block_until_ready((state, rest))
        taken.append(time.perf_counter() - began)
    return taken[1:], rest


def time_calls(call: Callable[[], Any], repeats: int = REPEATS) -> list[float]:
    """Times calls of a function that waits for its results, after a warm-up call.

    Args:
      call: the function to call.
      repeats: number of timed calls.

    Returns:
      Seconds of each timed call.
    """
    taken = []
    for _ in range(1 + repeats):
        began = time.perf_counter()
        call()
        taken.append(time.perf_counter() - began)
    return taken[1:]


def spread(calls_s: list[float]) -> dict[str, Any]:
    """Returns the entries of a result line for the times of calls: all times and their median."""
    return {"calls_s": calls_s, "call_s": statistics.median(calls_s)}


def matmul_precision() -> str:
    """Returns the precision of JAX's matrix products; `default` may be TF32 on a GPU."""
    return jax.config.jax_default_matmul_precision or "default"


# Two sides in turn


class Arm:
    """A training program with its state; every call continues the training.

    Attributes:
      compile_s: compile time, s.
    """

    def __init__(self, settings: TrainConfig) -> None:
        program, schedule = programs.load(settings)
        self._state = jax.jit(mesh.init(program))(schedule)
        compiled = compile_chunk(program, schedule, self._state)
        self._train = partial(compiled.call, schedule)
        self.compile_s = compiled.seconds

    def time(self, updates: int) -> float:
        """Trains for some updates and returns the seconds that this took."""
        began = time.perf_counter()
        self._state, metrics = self._train(self._state, np.int32(updates))
        jax.block_until_ready(metrics)
        return time.perf_counter() - began


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
    the number of heads in n coin tosses. The interval is valid for any distribution of the values.
    The interval runs from the k-th smallest to the k-th largest value. Here k is the largest number
    for which the true median lies beyond either end with a probability of at most 2.5 %.

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


@dataclass(frozen=True, kw_only=True)
class SidesConfig(Section):
    """Settings: what to compare."""

    before: str = field(default=".", metadata=about("checkout to compare with this one"))
    than: str = field(
        default="", metadata=about("settings only for this side, with spaces between them")
    )


class Side:
    """A process that trains with the code of a checkout, on request.

    Attributes:
      compile_s: seconds of compiling.
    """

    def __init__(self, tree: Path, words: Sequence[str]) -> None:
        paths = [str(tree), *filter(None, [os.environ.get("PYTHONPATH")])]
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SIDE, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=tree,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        )
        self.compile_s = self._read()

    def time(self, updates: int) -> float:
        """Trains for some updates and returns the seconds that this took."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{updates}\n")
        self._process.stdin.flush()
        return self._read()

    def close(self) -> None:
        """Ends the process."""
        self._process.communicate()

    def _read(self) -> float:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise ConfigError("one side ended before it was timed: see its output for the reason.")
        return float(line)


def steps(settings: TrainConfig) -> int:
    """Returns the arena steps of an update, in all seeds together."""
    return settings.seeds * settings.arenas * settings.algo.rollout_length


def compare(settings: SidesConfig, words: Sequence[str]) -> lines.Line:
    """Times both sides alternately.

    Args:
      settings: settings of the two sides.
      words: `key=value` training arguments for both sides.

    Returns:
      The JSON line.

    Raises:
      ConfigError: if one side cannot train.
    """
    mine = [*words, *settings.than.split()]
    work = steps(load_train(words)), steps(load_train(mine))
    tree = Path(settings.before).resolve()
    sides = Side(tree, words), Side(Path.cwd(), mine)
    sides[0].time(2)
    updates = max(2, round(CALL_SECONDS / (sides[0].time(2) / 2)))
    sides[1].time(updates)
    timed = in_turn(*(partial(side.time, updates) for side in sides), pairs=PAIRS)
    for side in sides:
        side.close()
    speeds = [[updates * n / s for n, s in zip(work, pair, strict=True)] for pair in timed]
    ratio, low, high = median([own / theirs for theirs, own in speeds])
    return {
        "benchmark": "timing",
        "words": list(words),
        "than": settings.than,
        "speed_ratio": ratio,
        "speed_ratio_low": low,
        "speed_ratio_high": high,
        "arena_steps_per_s": [statistics.median(each) for each in zip(*speeds, strict=True)],
        "pairs": PAIRS,
        "updates": updates,
        "seconds": [list(pair) for pair in timed],
        "compile_s": [side.compile_s for side in sides],
        **lines.made_with(),
        "commits": [_commit(tree), provenance.commit()],
    }


def _commit(tree: Path) -> str | None:
    """Reads a checkout's commit from its file `commit` if there is one, else from git."""
    if (tree / "commit").is_file():
        return (tree / "commit").read_text().strip()
    words = ["git", "-C", str(tree), "rev-parse", "--short=12", "HEAD"]
    found = subprocess.run(words, capture_output=True, text=True, check=False)
    return found.stdout.strip() or None


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings, words = lines.parse(SidesConfig, arguments)
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # three processes share a device
    lines.write([compare(settings, words)])
    return 0


if __name__ == "__main__":
    sys.exit(command.run("timing", main, TrainConfig))
