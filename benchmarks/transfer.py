"""What does a policy lose on the wheeled body, and under a realism that it was not trained with?

`python -m benchmarks.transfer policies=ideal:a.npz+b.npz,real:c.npz [key=value ...]` takes the keys
of `swarmjax.evaluate` but `policy`, and judges every policy (`label:` files of several seeds, `+`
between them) in MuJoCo C on the same levels in each world of `WORLDS`. It prints a JSON line for
each label and world: means with 95 % intervals, and the paired difference to the label's first
world. Intervals are percentiles of a bootstrap that draws seeds' levels anew within each seed: they
hold for these policies on other levels; how far seeds differ is in `targets_reached_by_seed`.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from swarmjax import command, config, evaluate, policy, provenance
from swarmjax.config import ConfigError, EvaluateConfig

WORLDS = (("planar", "ideal"), ("wheeled", "ideal"), ("wheeled", "webots"), ("wheeled", "real"))
RESAMPLES = 2000
MEASURES = ("targets_reached", "all_reached", "contacts_per_robot", "episode_time_s")


def judge(settings: EvaluateConfig, files: Sequence[str]) -> dict[str, np.ndarray]:
    """Judges the policies of one label.

    Args:
      settings: of the evaluation; its policy is not read.
      files: of the policies, one a seed.

    Returns:
      [seeds, levels] of each measure.
    """
    rows = []
    for name in files:
        mine = replace(settings, policy=name)
        outcome = evaluate.outcomes(mine, policy.load(name))
        rows.append(evaluate.per_level(outcome, settings.task.control_step))
    return {name: np.stack([row[name] for row in rows]) for name in MEASURES}


def interval(values: np.ndarray) -> tuple[float, float]:
    """95 % interval of the mean of [seeds, levels], levels drawn anew within each seed.

    Args:
      values: [seeds, levels].

    Returns:
      The 2.5th and the 97.5th percentile of `RESAMPLES` means.
    """
    random = np.random.default_rng(0)
    drawn = random.integers(values.shape[1], size=(RESAMPLES, *values.shape))
    means = np.take_along_axis(values[None], drawn, axis=2).mean(axis=(1, 2))
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def summarize(found: dict[str, np.ndarray], first: dict[str, np.ndarray]) -> dict[str, Any]:
    """Means with intervals, and paired differences to the first world, level by level."""
    result: dict[str, Any] = {"targets_reached_by_seed": found["targets_reached"].mean(1).tolist()}
    for name in MEASURES:
        change = found[name] - first[name]
        result[name] = float(found[name].mean())
        result[f"{name}_interval"] = interval(found[name])
        result[f"{name}_change"] = float(change.mean())
        result[f"{name}_change_interval"] = interval(change)
    return result


def results(words: Sequence[str], policies: dict[str, list[str]]) -> Iterator[dict[str, Any]]:
    """Judges all labels in all worlds; yields a line each."""
    some = next(iter(policies.values()))[0]
    for label, files in policies.items():
        first = None
        for body, realism in WORLDS:
            given = [f"policy={some}", *words, f"robot={body}", f"realism={realism}"]
            settings = config.load_evaluate(given)
            found = judge(settings, files)
            first = found if first is None else first
            yield {
                "benchmark": "transfer",
                "trained": label,
                "robot": body,
                "realism": realism,
                "stage": settings.stage.name,
                "levels": settings.episodes,
                "seeds": len(files),
                **summarize(found, first),
                "digests": [policy.load(name).digest[:12] for name in files],
                "device": provenance.device(),
                "versions": provenance.versions(),
                "commit": provenance.commit(),
            }


def _policies(words: Sequence[str]) -> tuple[dict[str, list[str]], list[str]]:
    """Takes `policies=...` out of the words of the command line."""
    given = [word.partition("=")[2] for word in words if word.startswith("policies=")]
    labelled = [part.partition(":") for part in given[-1].split(",")] if given else []
    if not labelled or not all(label and files for label, _, files in labelled):
        raise ConfigError(
            f"policies is '{given[-1] if given else ''}': give label:file+file,label:file, "
            "as in ideal:a.npz+b.npz,real:c.npz."
        )
    rest = [word for word in words if not word.startswith("policies=")]
    return {label: files.split("+") for label, _, files in labelled}, rest


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    policies, rest = _policies(arguments)
    for line in results(rest, policies):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("transfer", main, EvaluateConfig))
