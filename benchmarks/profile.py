"""How is the time of an update divided among physics, sensors, policy and learning?

`python -m benchmarks.profile [top=40] [key=value ...]` takes the keys of `swarmjax.train`. It
traces three calls: physics alone, the environment including physics, and training including both.
For each call it prints a JSON line for all kernels together, and a line for each of the `top`
slowest kernels. A line has the microseconds per control step of all arenas. A kernel's line also
has the kernel's share of the time of all kernels.

On a GPU, the kernels are those of the GPU's streams. On a CPU, the kernels are XLA's operations,
and their times are summed over all threads. `busy` is the time of all kernels divided by the time
of the call. `busy` is above 1 if several threads or streams ran at once.
"""

import operator
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks import lines, steps_per_second
from swarmjax import command
from swarmjax.config import Section, about
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig

UPDATES = 2  # number of updates in the traced call of training
# Kernels run on the threads or streams whose names contain this text, by platform.
LINES = {"gpu": "Stream", "cpu": "tf_XLA"}
# Prefixes of events that are not counted: some only mark the end of a region, and a loop's contents
# are counted separately.
MARKERS = ("ThreadpoolListener", "ThunkExecutor", "end: ", "while")
KINDS = {
    "warp": ("_cuda_kernel", "wp_"),
    "matrix": ("gemm", "cutlass", "cublas", "dot", "xmma"),
    "sort": ("sort", "Sort"),
    "copy": ("memcpy", "Memcpy", "MemcpyD2D", "copy"),
}


@dataclass(frozen=True, kw_only=True)
class ProfileConfig(Section):
    """Settings: what to list."""

    top: int = field(default=40, metadata=about("kernels to list", 1, 10**6))


def kind(name: str) -> str:
    """Guesses a kernel's kind from the kernel's name: a key of `KINDS`, or `fusion`."""
    return next((k for k, marks in KINDS.items() if any(m in name for m in marks)), "fusion")


def kernels(call: Callable[[], Any]) -> tuple[dict[str, float], Counter[str], float]:
    """Traces a call that has been compiled and run before.

    Args:
      call: the function to call; it returns arrays.

    Returns:
      The seconds of each kernel, the number of runs of each kernel, and the seconds of the call.
    """
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            began = time.perf_counter()
            jax.block_until_ready(call())
            seconds = time.perf_counter() - began
        spent: defaultdict[str, float] = defaultdict(float)
        count: Counter[str] = Counter()
        for name, duration in _events(Path(folder)):
            spent[name] += duration
            count[name] += 1
    return spent, count, seconds


def _events(folder: Path) -> Iterator[tuple[str, float]]:
    """Yields the name and the seconds of each run of a kernel in a trace."""
    mark = LINES[jax.default_backend()]
    for path in folder.rglob("*.xplane.pb"):
        for plane in jax.profiler.ProfileData.from_file(str(path)).planes:
            for line in plane.lines:
                if mark in line.name:
                    yield from (
                        (event.name, 1e-9 * event.duration_ns)
                        for event in line.events
                        if not event.name.startswith(MARKERS)
                    )


def rows(given: dict[str, Any], call: Callable[[], Any], steps: int, top: int) -> list[lines.Line]:
    """Profiles a call.

    Args:
      given: entries that every line has.
      call: the function to call, which has run before; it returns arrays.
      steps: control steps per call.
      top: number of kernels to list.

    Returns:
      A line for all kernels together, with the share of each kind, and a line for each of the
      slowest kernels.
    """
    spent, count, seconds = kernels(call)
    total = sum(spent.values())
    by_kind: defaultdict[str, float] = defaultdict(float)
    for kernel, taken in spent.items():
        by_kind[kind(kernel)] += taken
    whole = {
        "us_per_control_step": 1e6 * seconds / steps,
        "busy": total / seconds,
        "kernels_per_control_step": sum(count.values()) / steps,
        "shares": {name: taken / total for name, taken in _most(by_kind)},
        **lines.made_with(),
    }
    each = [
        {
            "kernel": kernel,
            "kind": kind(kernel),
            "us_per_control_step": 1e6 * taken / steps,
            "runs_per_control_step": count[kernel] / steps,
            "share": taken / total,
        }
        for kernel, taken in _most(spent)[:top]
    ]
    return [given | one for one in (whole, *each)]


def _most(seconds: dict[str, float]) -> list[tuple[str, float]]:
    """Sorts kernels or kinds by their seconds, the slowest first."""
    return sorted(seconds.items(), key=operator.itemgetter(1), reverse=True)


def profile(settings: TrainConfig, top: int) -> Iterator[lines.Line]:
    """Profiles physics, environment and training, and yields their lines."""
    prepared = steps_per_second.prepare(settings)
    schedule, keys, rollout = prepared.schedule, prepared.keys, settings.algo.rollout_length
    given = {"arenas": settings.arenas, "robot": settings.robot.body}
    steps = steps_per_second.CONTROL_STEPS[settings.robot.body]
    for name, program, argument, count in (
        ("physics", prepared.physics, keys, steps),
        ("environment", prepared.environment, (schedule, keys), steps),
        ("training", prepared.training, np.int32(UPDATES), UPDATES * rollout),
    ):
        state = prepared.start(schedule)
        state = state if name == "training" else state.arenas
        state, _ = program.call(state, argument)
        call = partial(program.call, state, argument)
        yield from rows({"benchmark": f"profile.{name}", **given}, call, count, top)


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    given, words = lines.parse(ProfileConfig, arguments)
    settings = load_train(["stage=s6", "budget=1e10", *words])
    settings = replace(settings, stage=settings.stage[-1:])
    lines.write(profile(settings, given.top))
    return 0


if __name__ == "__main__":
    sys.exit(command.run("profile", main, ProfileConfig))
