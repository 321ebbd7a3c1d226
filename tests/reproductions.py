"""Builds reproductions of the paper whose numbers are known."""

import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swarmjax.config import to_dict
from swarmjax.reproduce.config import ARMS, ReproduceConfig
from swarmjax.reproduce.rows import ACTIONS, EXPANDED, JUDGED, LAST, Reproduction, RunLog

SEEDS = (0, 1, 2)
VERSIONS = {"jax": "0.11.2"}
SUMMARY = {
    "budget_spent": True,
    "device": "CPU x86_64, 2 cores",
    "commit": "60ed72f",
    "train_s": 60.0,
    "compile_s": 60.0,
}


def episode(number: int, **given: Any) -> dict[str, Any]:
    """Returns episode `number` of a seed, counted from 1: two robots arrive in 100 steps."""
    robots = len(given.get("reached", (True, True)))
    return {
        "seed": 0,
        "update": number,
        "arena_steps": 100 * number,
        "stage": LAST,
        "steps": 100,
        "robots": robots,
        "reached": [True] * robots,
        "reward": [0.5] * robots,
        "robot_steps": [100] * robots,
        "sensed": [10] * robots,
        "contacts": [1] * robots,
    } | given


def row(arm: str, seed: int, stage: str, action: str = "sampled", **given: Any) -> dict[str, Any]:
    """Returns a row of the evaluation."""
    shares = {"targets_reached": 0.9, "all_reached": 0.6, "sensed_share": 0.1}
    where = {"arm": arm, "seed": seed, "stage": stage, "action": action}
    return where | shares | {"contacts_per_robot": 1.5} | given


def write(
    out: Path,
    logs: Mapping[str, Sequence[Mapping[str, Any]]],
    judged: Sequence[Mapping[str, Any]] | None = None,
    seeds: int = len(SEEDS),
) -> Path:
    """Writes a directory in which the arms in `logs` have finished."""
    out.mkdir(parents=True, exist_ok=True)
    settings = to_dict(ReproduceConfig(seeds=seeds))
    facts = {"format": 4, "settings": settings, "versions": VERSIONS}
    (out / "reproduce.json").write_text(json.dumps(facts))
    for arm, episodes in logs.items():
        (out / arm).mkdir(exist_ok=True)
        lines = "".join(json.dumps(each) + "\n" for each in episodes)
        (out / arm / "episodes.jsonl").write_text(lines)
        (out / arm / "summary.json").write_text(json.dumps(SUMMARY))
    if judged is None:
        every = itertools.product(logs, SEEDS, (LAST, EXPANDED), ACTIONS)
        judged = [row(*each) for each in every]
    text = json.dumps({"format": 4, "rows": list(judged)})
    (out / "evaluation.json").write_text(text)
    return out


def whole(out: Path, episodes: int = 30, arms: Sequence[str] = ARMS) -> Path:
    """Writes arms that fail only in their first ten episodes (baselines in their first twelve)."""
    logs = {}
    for arm in arms:
        stage = EXPANDED if arm.endswith("_expanded") else LAST
        failures = 12 if "baseline" in arm else 10
        logs[arm] = [
            episode(
                number,
                seed=seed,
                stage="paper1" if arm.endswith("curriculum") and number <= 5 else stage,
                reached=[number > failures] * 2,
            )
            for seed in SEEDS
            for number in range(1, episodes + 1)
        ]
    return write(out, logs)


def log(successes: Sequence[bool], *, every: int = 100, **given: Any) -> RunLog:
    """Returns a seed's episodes of two robots, which arrive together or not at all."""
    count = len(successes)
    both = np.repeat(np.asarray(successes, bool)[:, None], 2, axis=1)
    ones = np.ones((count, 2), int)
    number = np.arange(1, count + 1)
    values = {
        "number": number,
        "arena_steps": every * number,
        "stage": np.full(count, LAST),
        "present": np.ones((count, 2), bool),
        "reached": both,
        "reward": both.astype(float),
        "robot_steps": 100 * ones,
        "sensed": 10 * ones,
        "contacts": ones,
    }
    return RunLog(**(values | given))


def reproduction(
    logs: Mapping[str, Sequence[RunLog]] | None = None,
    judged: Mapping[tuple[str, ...], Mapping[str, float]] | None = None,
) -> Reproduction:
    """Returns a reproduction in which every measure that is not given is 0 for all seeds.

    The keys of `judged` are arm, stage and perhaps the kind of action; without it, both kinds.
    """
    logs, judged = logs or {}, judged or {}
    arms = [*logs, *dict.fromkeys(arm for arm, *_ in judged if arm not in logs)]
    zero = dict.fromkeys(JUDGED, 0.0)
    return Reproduction(
        settings=ReproduceConfig(seeds=len(SEEDS)),
        versions=VERSIONS,
        summaries=dict.fromkeys(arms, SUMMARY),
        logs={arm: tuple(logs.get(arm, [log([True] * 30)] * len(SEEDS))) for arm in arms},
        judged={
            (arm, stage, action): {
                key: np.full(len(SEEDS), value)
                for key, value in (
                    zero
                    | dict(judged.get((arm, stage), {}))
                    | dict(judged.get((arm, stage, action), {}))
                ).items()
            }
            for arm in arms
            for stage in (LAST, EXPANDED)
            for action in ACTIONS
        },
    )
