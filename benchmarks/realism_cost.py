"""How much training speed does realism cost, as a whole and for each factor alone?

`python -m benchmarks.realism_cost [arms=real,webots,...] [key=value ...]` takes the keys of
`swarmjax.train`. It compares the training program of each arm with the ideal program, which has no
realism. It calls both programs alternately, `PAIRS` times, after a warm-up pair. For each arm it
prints a JSON line with the median ratio of the arm's time to the ideal program's time, and with an
interval that assumes no distribution. With 10 pairs the interval runs from the second smallest to
the second largest ratio and contains the true median with a probability of 97.9 %.
"""

import dataclasses
import json
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

from benchmarks.pairs import Arm, median, time_in_turn
from swarmjax import command, provenance
from swarmjax.config import ConfigError
from swarmjax.run.load_settings import load_train
from swarmjax.run.settings import TrainConfig
from swarmjax.sim import dispatch
from swarmjax.sim.realism_config import COUNTED, RealismConfig

PAIRS = 10
CALL_SECONDS = 0.5  # s; approximate time of a call of the ideal program
THREADS = 8  # programs compiled in parallel
PRESETS = ("real", "webots")
# Fields without an arm. Hull friction is a different program instead of a random number, so the
# hulls of `real` have none.
_NO_FACTOR = ("name", "infrared", "stall_time", "hull_friction")


def arms() -> dict[str, RealismConfig]:
    """Returns each arm's realism: a preset, the infrared response alone, or a factor of `real`."""
    presets = {name: load_train([f"realism={name}"]).realism for name in PRESETS}
    real = presets["real"]
    alone = {"infrared": RealismConfig(infrared=real.infrared)}
    for item in dataclasses.fields(RealismConfig):
        if item.name not in _NO_FACTOR:
            # Factors that change infrared counts need an infrared response with counts, so their
            # arms also have the response.
            base = alone["infrared"] if item.name in COUNTED else RealismConfig()
            alone[item.name] = replace(base, **{item.name: getattr(real, item.name)})
    return presets | alone


def compare(ideal: Arm, arm: Arm, updates: int) -> dict[str, Any]:
    """Times two arms alternately.

    Returns:
      The median ratio of the arm's time to the ideal arm's time, the interval of this ratio, and
      the median speeds of both arms.
    """
    pairs = time_in_turn(ideal, arm, updates, PAIRS)
    ratio, low, high = median([mine / theirs for theirs, mine in pairs])
    settings = ideal.settings
    steps = updates * settings.seeds * settings.arenas * settings.algo.rollout_length
    return {
        "time_ratio": ratio,
        "time_ratio_low": low,
        "time_ratio_high": high,
        "pairs": PAIRS,
        "ideal_arena_steps_per_s": steps / median([theirs for theirs, _ in pairs])[0],
        "arena_steps_per_s": steps / median([mine for _, mine in pairs])[0],
    }


def results(settings: TrainConfig, chosen: dict[str, RealismConfig]) -> Iterator[dict[str, Any]]:
    """Compiles all arms, then compares each with the ideal arm; yields one line per arm."""
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
            "impl": dispatch.resolve_impl(settings.sim.impl),
            "arenas": settings.arenas,
            "seeds": settings.seeds,
            "robots": settings.stage[-1].robots,
            "compile_s": arm.compile_s,
            "device": provenance.device(),
            "versions": provenance.versions(),
            "commit": provenance.commit(),
        }


def _choose(words: Sequence[str]) -> tuple[dict[str, RealismConfig], list[str]]:
    """Separates `arms=...` from the other arguments of the command line."""
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
    settings = load_train(["stage=s6", *rest])
    for line in results(replace(settings, stage=settings.stage[-1:]), chosen):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("realism_cost", main, TrainConfig))
