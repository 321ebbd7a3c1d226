"""How long after the command starts does a swarm reach its targets, and how good is its policy?

`python -m benchmarks.command_to_success seed=0,1,2 [stop_at=0.95] [key=value ...]` takes the keys
of `swarmjax.train`. It runs `swarmjax.train` once per seed, each time in a new process that uses
the existing caches. A run is stopped as soon as robots on its last stage reach at least `stop_at`
of the targets over a whole cohort of training episodes. The saved policy is then judged in MuJoCo C
on the wheeled body.

The benchmark prints a JSON line for each seed. The line has the share of targets that the judge
measured. It also has the seconds from the start of `swarmjax.train` until training measured the
shares 0.90 and 0.95, and until the policy was saved. These seconds include compilation.
`benchmarks.time_to_success` measures the seconds to a share for a finished run, without the time
before the run's first update.
"""

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import key_value, peers, steps_per_second
from benchmarks.watched_run import MADE_WITH, Watched
from swarmjax import command
from swarmjax.config import Section, about
from swarmjax.config.section import MAX_COUNT
from swarmjax.evaluate import cells, trials
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.report import rows as report_rows
from swarmjax.report.rows import Row
from swarmjax.run.load_settings import load_train
from swarmjax.run.policy_export import POLICY
from swarmjax.task.stage_files import load_levels

SHARES = (0.90, 0.95)


@dataclass(frozen=True, kw_only=True)
class SuccessConfig(Section):
    """Settings: which seeds to train, when to stop, and how to judge the policies."""

    seed: tuple[int, ...] = field(
        default=(0,), metadata=about("random seeds, one after the other", 0, MAX_COUNT)
    )
    stop_at: float = field(
        default=0.95, metadata=about("share of targets at which training stops", 0.95, 1.0)
    )
    episodes: int = field(default=500, metadata=about("episodes to judge the policy on", 1, 10**6))


def train(words: Sequence[str], run: Path, stop_at: float) -> tuple[dict[str, float | None], Row]:
    """Trains until robots on the last stage reach a share of the targets, or the budget is spent.

    Args:
      words: `key=value` words for training.
      run: the run directory.
      stop_at: the share.

    Returns:
      Seconds from the command until the policy was saved, and until each of `SHARES` was measured
      (None for a share that was never measured). Also the last row of the metrics.
    """
    watched, row = Watched(words, run, {}), {}
    found: dict[str, float | None] = dict.fromkeys((f"seconds_to_{x:.2f}" for x in SHARES), None)
    for seconds, row in watched.rows():
        success = row["success_by_stage"][-1] or 0.0
        for share, (name, before) in zip(SHARES, list(found.items()), strict=True):
            if before is None and success >= share:
                found[name] = seconds
        if success >= stop_at:
            watched.stop()
    return found | {"saved_s": watched.seconds}, row


def judge(run: Path, stage: str, episodes: int) -> dict[str, Any]:
    """Judges a run's policy on wheels in MuJoCo C; returns its share of targets and action mode."""
    path = run / POLICY
    settings = load_levels(
        EvaluateConfig,
        [f"policy={path}", f"stage={stage}", "robot=wheeled", f"episodes={episodes}"],
    )
    policies = trials.read_policies([str(path)])
    (trial,) = trials.run(settings, cells.load(settings).cells, policies)
    judged = float(np.mean(trial.found["targets_reached"]))
    return {"judged": judged, "action": settings.action}


def results(given: SuccessConfig, words: Sequence[str]) -> Iterator[Row]:
    """Trains and judges every seed; yields one line per seed."""
    trained = load_train(words)
    for seed in given.seed:
        with tempfile.TemporaryDirectory() as name:
            run = Path(name) / "run"
            found, row = train([*words, f"seed={seed}"], run, given.stop_at)
            summary = report_rows.read_object(run / report_rows.SUMMARY)
            judged = judge(run, trained.stage[-1].name, given.episodes)
        yield {
            "benchmark": "command_to_success",
            "seed": seed,
            "stage": trained.stage_name,
            "stop_at": given.stop_at,
            **found,
            **judged,
            "episodes": given.episodes,
            "measured": row["success_by_stage"][-1],
            "arena_steps": row["arena_steps"],
            "compile_s": summary["compile_s"],
            "train_s": summary["train_s"],
            **steps_per_second.about(trained, summary["impl"]),
            **{key: summary[key] for key in MADE_WITH},
        }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    given, words = key_value.parse(SuccessConfig, arguments)
    peers.write(results(given, words))
    return 0


if __name__ == "__main__":
    sys.exit(command.run("command_to_success", main, SuccessConfig))
