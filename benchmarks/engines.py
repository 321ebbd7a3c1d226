"""Do the training engine and the judge agree on a policy, level by level?

`python -m benchmarks.engines policy=FILE [evaluate keys]` runs both engines on the same levels and
prints a JSON line for each cell. The line has the share of targets reached in each engine with its
interval, the share of levels with equal results, and the largest differences. Only the engine
differs, not the policy, the levels or the length of a physics step.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from swarmjax import command, provenance
from swarmjax.config import ConfigError
from swarmjax.evaluate import summary as evaluate_summary
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.evaluation import evaluate
from swarmjax.evaluate.trials import Trial
from swarmjax.task.stage_files import load_levels

SAME_TIME = 0.032  # s; arrivals may fall into adjacent control steps


def compare(c: Trial, mjx: Trial) -> dict[str, Any]:
    """Compares the results of the two engines on a cell.

    Args:
      c: the judge's trial.
      mjx: the training engine's trial.

    Returns:
      Plain data for JSON.
    """
    both = [name for name in c.found if name in mjx.found]
    off = {name: np.abs(c.found[name] - mjx.found[name]) for name in both}
    free = c.found["contacts_per_robot"] == 0.0
    same = off["targets_reached"] == 0.0
    close = same & (off["episode_time_s"] <= 1.001 * SAME_TIME)
    return {
        "same_targets": float(same.mean()),
        "same_contacts": float((off["contacts_per_robot"] < 1e-6).mean()),
        "same_time": float(close.mean()),
        "same_time_without_contact": float(close[free].mean()) if free.any() else None,
        "levels_without_contact": float(free.mean()),
        "largest_differences": {name: float(off[name].max()) for name in both},
        "levels_that_differ": c.cell.episodes[~same.all(axis=0)].tolist(),
        "measures": evaluate_summary.compare(c.found, mjx.found),
    }


def results(words: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Runs both engines; yields one line per cell."""
    settings = load_levels(EvaluateConfig, words)
    if settings.policy is None:
        raise ConfigError("compare cannot be given: only the engines are compared: policy=FILE.")
    found = [evaluate(replace(settings, engine=engine)) for engine in ("c", "mjx")]
    c, mjx = found
    cells = zip(c.result["cells"], mjx.result["cells"], c.trials, mjx.trials, strict=True)
    for about, other, trial, same in cells:
        targets = (each["measures"]["targets_reached"] for each in (about, other))
        yield {
            "benchmark": "engines",
            "policies": c.result["policies"],
            **{key: value for key, value in about.items() if key != "measures"},
            "robot": settings.robot.body,
            "steps": settings.step_limit,
            "action": settings.action,
            "targets_reached": dict(zip(("c", "mjx"), targets, strict=True)),
            **compare(trial, same),
            "device": provenance.device(),
            "versions": provenance.versions(),
            "commit": provenance.commit(),
        }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    for line in results(arguments):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("engines", main, EvaluateConfig))
