"""How much worse is a policy on the wheeled body, and with a realism not used in its training?

`python -m benchmarks.transfer policies=ideal:a.npz+b.npz,real:c.npz [key=value ...]` takes the keys
of `swarmjax.evaluate` except `policy` and `suite`. After each `label:` come the policy files of one
or several seeds, joined by `+`. Every policy is judged in MuJoCo C on the same levels in each world
of `WORLDS`.

For each label and world it prints a JSON line with means and their 95 % intervals. The line also
has paired differences from the label's first world (`_change`) and from the ideal world with the
same body (`_realism_change`). The intervals come from a bootstrap that draws whole levels, and the
same levels for all seeds. The intervals therefore hold for these policies on other levels.
`targets_reached_by_seed` shows how much seeds differ.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from swarmjax import command, policy_file, provenance
from swarmjax.config import ConfigError
from swarmjax.evaluate import cells, statistics, trials
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.task.stage_files import load_levels

WORLDS = (("planar", "ideal"), ("wheeled", "ideal"), ("wheeled", "webots"), ("wheeled", "real"))
MEASURES = ("targets_reached", "all_reached", "contacts_per_robot", "episode_time_s")


def judge(settings: EvaluateConfig, files: Sequence[str]) -> dict[str, np.ndarray]:
    """Judges the policies of one label.

    Args:
      settings: settings of the evaluation; their policy is not used.
      files: policy files, one per seed.

    Returns:
      [seeds, levels] values of each measure.
    """
    (trial,) = trials.run(settings, cells.load(settings).cells, trials.read_policies(files))
    return {name: trial.found[name] for name in MEASURES}


def summarize(
    found: dict[str, np.ndarray], first: dict[str, np.ndarray], ideal: dict[str, np.ndarray]
) -> dict[str, Any]:
    """Computes means with intervals, and differences paired by level.

    Args:
      found: [seeds, levels] values of each measure in a world.
      first: values in the label's first world.
      ideal: values in the world with the same body and without realism.

    Returns:
      The numeric entries of the JSON line.
    """
    result: dict[str, Any] = {"targets_reached_by_seed": found["targets_reached"].mean(1).tolist()}
    for name in MEASURES:
        mine = found[name]
        intervals = {
            name: statistics.bootstrap(mine, np.mean, draw="tasks"),
            f"{name}_change": statistics.paired(first[name], mine, np.mean, draw="tasks"),
            f"{name}_realism_change": statistics.paired(ideal[name], mine, np.mean, draw="tasks"),
        }
        for key, (estimate, low, high) in intervals.items():
            result |= {key: estimate, f"{key}_interval": [low, high]}
    return result


def results(words: Sequence[str], policies: dict[str, list[str]]) -> Iterator[dict[str, Any]]:
    """Judges all labels in all worlds; yields one JSON line per label and world."""
    some = next(iter(policies.values()))[0]
    for label, files in policies.items():
        worlds: dict[tuple[str, str], dict[str, np.ndarray]] = {}
        for body, realism in WORLDS:
            given = [f"policy={some}", *words, f"robot={body}", f"realism={realism}"]
            settings = load_levels(EvaluateConfig, given)
            if settings.suite is not None:
                raise ConfigError(
                    f"suite is '{settings.suite}', but worlds are compared on levels of one stage: "
                    "give stage, shape, episodes and seed."
                )
            worlds[body, realism] = judge(settings, files)
            yield {
                "benchmark": "transfer",
                "trained": label,
                "robot": body,
                "realism": realism,
                "stage": settings.stage.name,
                "levels": settings.episodes,
                "action": settings.action,
                "seeds": len(files),
                **summarize(worlds[body, realism], worlds[WORLDS[0]], worlds[body, "ideal"]),
                "digests": [policy_file.read(name).digest[:12] for name in files],
                "device": provenance.device(),
                "versions": provenance.versions(),
                "commit": provenance.commit(),
            }


def _policies(words: Sequence[str]) -> tuple[dict[str, list[str]], list[str]]:
    """Separates `policies=...` from the other arguments of the command line."""
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
