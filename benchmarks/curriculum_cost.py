"""How much training speed does the curriculum's engine cost?

`python -m benchmarks.curriculum_cost [key=value ...]` takes the keys of `swarmjax.train`. For each
mode it trains two programs alternately. The first program trains on one stage alone. The second
trains on a curriculum of `COPIES` copies of this stage, in the given mode. Both programs simulate
the same mix of arenas and differ only in the curriculum's engine. The command prints a JSON line
for each mode. The line has the median ratio of the mode's speed to the speed of the single stage,
and the 95 % interval of this median. The interval is computed from order statistics, without
assuming a distribution.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from benchmarks.pairs import Arm, median, time_in_turn
from swarmjax import command, provenance
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import dispatch

PAIRS = 20
COPIES = {"sequential": 6, "mixed": 6, "adaptive": 6, "adaptive-grid": 48}
CALL_SECONDS = 0.7  # approximate time per training call


def curriculum(settings: TrainConfig, name: str) -> TrainConfig:
    """Makes the config of an arm: `COPIES` copies of the config's stage, in the arm's mode."""
    stage = settings.stage[-1]
    copies = tuple(replace(stage, name=f"{stage.name}-{i}") for i in range(COPIES[name]))
    words = [f"curriculum.mode={name.removesuffix('-grid')}"]
    options = load_train(words).curriculum
    return replace(settings, stage=copies, stage_name=name, curriculum=options)


def results(settings: TrainConfig) -> Iterator[dict[str, Any]]:
    """Compiles all arms, then compares each with the single stage; yields one line per arm."""
    single = replace(settings, stage=settings.stage[-1:])
    programs = [single, *(curriculum(settings, name) for name in COPIES)]
    with ThreadPoolExecutor(len(programs)) as pool:
        baseline, *arms = pool.map(Arm, programs)
    baseline.time(1)
    updates = max(1, round(CALL_SECONDS / baseline.time(1)))
    for name, arm in zip(COPIES, arms, strict=True):
        times = time_in_turn(baseline, arm, updates, PAIRS)
        ratio, low, high = median([theirs / mine for theirs, mine in times])
        yield {
            "benchmark": "curriculum_cost",
            "mode": name,
            "stages": COPIES[name],
            "speed_ratio": ratio,
            "speed_ratio_low": low,
            "speed_ratio_high": high,
            "pairs": PAIRS,
            "updates": updates,
            "arena_steps_per_s": updates
            * settings.arenas
            * settings.algo.rollout_length
            / median([mine for _, mine in times])[0],
            "robot": settings.robot.body,
            "impl": dispatch.resolve_impl(settings.sim.impl),
            "arenas": settings.arenas,
            "compile_s": arm.compile_s,
            "device": provenance.device(),
            "versions": provenance.versions(),
            "commit": provenance.commit(),
        }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = load_train(["stage=s6", *arguments])
    for line in results(settings):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("curriculum_cost", main, TrainConfig))
