"""What does realism cost in training speed, all of it and each factor alone?

`python -m benchmarks.realism_cost [arms=real,webots,...] [key=value ...]` takes the keys of
`swarmjax.train` and trains pairs of programs in turn, one of them ideal: a call of each, `PAIRS`
times, after one that is not counted. It prints a JSON line for each factor: the median ratio of
its time to the ideal one's, with the interval between the second smallest and the second largest
of the pairs, which holds the median with 97.9 % (10 pairs, binomial), whatever its distribution.
"""

import dataclasses
import json
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np

from swarmjax import command, config, loop, provenance
from swarmjax.config import ConfigError, RealismConfig, TrainConfig
from swarmjax.sim import physics

PAIRS = 10
CALL_SECONDS = 0.5  # of the ideal program, about
THREADS = 8  # programs that are compiled side by side
PRESETS = ("real", "webots")
_NO_FACTOR = ("name", "infrared", "stall_time")


class Arm:
    """One program with its state, that trains on with every call."""

    def __init__(self, settings: TrainConfig) -> None:
        program, schedule = loop.load(settings)
        self.settings = settings
        self._state = jax.jit(partial(loop.init, program))(schedule)
        began = time.perf_counter()
        train = jax.jit(partial(loop.train_chunk, program, schedule), donate_argnums=0)
        self._train = train.lower(self._state, np.int32(1)).compile()
        self.compile_s = time.perf_counter() - began

    def time(self, updates: int) -> float:
        """Trains for some updates and returns the seconds that took."""
        began = time.perf_counter()
        self._state, metrics = self._train(self._state, np.int32(updates))
        jax.block_until_ready(metrics)
        return time.perf_counter() - began


def arms() -> dict[str, RealismConfig]:
    """The realism of each arm: the presets, the response alone, and each factor of `real` alone."""
    presets = {name: config.load_train([f"realism={name}"]).realism for name in PRESETS}
    real = presets["real"]
    alone = {"infrared": RealismConfig(infrared=real.infrared)}
    for item in dataclasses.fields(RealismConfig):
        if item.name not in _NO_FACTOR:
            # What acts on counts costs what it does on top of a response that has any.
            base = alone["infrared"] if item.name in config.COUNTED else RealismConfig()
            alone[item.name] = replace(base, **{item.name: getattr(real, item.name)})
    return presets | alone


def compare(ideal: Arm, arm: Arm, updates: int) -> dict[str, Any]:
    """Times two arms in turn.

    Returns:
      The median ratio of the arm's seconds to the ideal one's, its interval, and both medians.
    """
    for each in (ideal, arm):
        each.time(updates)
    pairs = [(ideal.time(updates), arm.time(updates)) for _ in range(PAIRS)]
    ratios = sorted(mine / theirs for theirs, mine in pairs)
    steps = updates * ideal.settings.arenas * ideal.settings.algo.rollout
    plain, mine = (statistics.median(times) for times in zip(*pairs, strict=True))
    return {
        "time_ratio": statistics.median(ratios),
        "time_ratio_low": ratios[1],
        "time_ratio_high": ratios[-2],
        "pairs": PAIRS,
        "ideal_arena_steps_per_s": steps / plain,
        "arena_steps_per_s": steps / mine,
    }


def results(settings: TrainConfig, chosen: dict[str, RealismConfig]) -> Iterator[dict[str, Any]]:
    """Compiles all arms, then compares each with the ideal one; yields a line each."""
    ideal = Arm(replace(settings, realism=RealismConfig()))
    ideal.time(1)
    updates = max(1, round(CALL_SECONDS / ideal.time(1)))
    programs = [replace(settings, realism=realism) for realism in chosen.values()]
    with ThreadPoolExecutor(THREADS) as pool:
        built = dict(zip(chosen, pool.map(Arm, programs), strict=True))
    for name, arm in built.items():
        yield {
            "benchmark": "realism_cost",
            "factor": name,
            **compare(ideal, arm, updates),
            "robot": settings.robot.body,
            "impl": physics.resolve_impl(settings.sim.impl),
            "arenas": settings.arenas,
            "robots": settings.stage[-1].robots,
            "compile_s": arm.compile_s,
            "device": provenance.device(),
            "versions": provenance.versions(),
            "commit": provenance.commit(),
        }


def _choose(words: Sequence[str]) -> tuple[dict[str, RealismConfig], list[str]]:
    """Takes `arms=...` out of the words of the command line."""
    every = arms()
    given = [word.partition("=")[2] for word in words if word.startswith("arms=")]
    names = given[-1].split(",") if given else list(every)
    for name in names:
        if name not in every:
            raise ConfigError(f"arms holds '{name}': give any of {', '.join(every)}.")
    rest = [word for word in words if not word.startswith("arms=")]
    return {name: every[name] for name in names}, rest


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    chosen, rest = _choose(arguments)
    settings = config.load_train(["stage=s6", *rest])
    for line in results(replace(settings, stage=settings.stage[-1:]), chosen):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("realism_cost", main, TrainConfig))
