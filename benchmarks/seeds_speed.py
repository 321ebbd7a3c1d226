"""How much faster do several seeds train in one program than one seed alone?

`python -m benchmarks.seeds_speed [key=value ...]` takes the keys of `swarmjax.train`. `seeds` is 10
by default, and `arenas` is the number per seed. It alternates between a call that trains all seeds
and a call that trains one seed. It prints a JSON line with the transitions per second of both
programs, and with their ratio. These numbers are medians over `PAIRS` pairs of calls. The ratio
also has a 95 % interval from order statistics.
"""

import json
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from benchmarks.pairs import Arm, median
from swarmjax import command, provenance
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import dispatch

PAIRS = 10
CALL_SECONDS = 0.5  # s; approximate time of a call that trains one seed


def _speed(arm: Arm, updates: int) -> float:
    """Runs one call, and returns its transitions per second."""
    seconds = arm.time(updates)
    return arm.transitions / seconds


def result(settings: TrainConfig) -> dict[str, Any]:
    """Compiles both programs and times them alternately; returns the JSON line."""
    with ThreadPoolExecutor(2) as pool:
        one, all_ = pool.map(Arm, [replace(settings, seeds=1), settings])
    for arm in (one, all_):
        arm.time(1)
    updates = max(1, round(CALL_SECONDS / one.time(1)))
    pairs = [(_speed(one, updates), _speed(all_, updates)) for _ in range(PAIRS)]
    ratio, low, high = median([many / single for single, many in pairs])
    return {
        "benchmark": "seeds_speed",
        "seeds": settings.seeds,
        "seeds_by": settings.seeds_by,
        "arenas": settings.arenas,
        "speed_ratio": ratio,
        "speed_ratio_low": low,
        "speed_ratio_high": high,
        "pairs": PAIRS,
        "transitions_per_s_of_one": median([single for single, _ in pairs])[0],
        "transitions_per_s": median([many for _, many in pairs])[0],
        "compile_s_of_one": one.compile_s,
        "compile_s": all_.compile_s,
        "stages": settings.stage_names,
        "impl": dispatch.resolve_impl(settings.sim.impl),
        "device": provenance.device(),
        "versions": provenance.versions(),
        "commit": provenance.commit(),
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = load_train(["stage=s6", "seeds=10", *arguments])
    sys.stdout.write(json.dumps(result(settings)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(command.run("seeds_speed", main, TrainConfig))
