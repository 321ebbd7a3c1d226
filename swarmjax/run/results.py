"""Writes the results of a run: a policy for each seed, and `summary.json`."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from swarmjax import provenance
from swarmjax.policy import PolicyError
from swarmjax.run import directory
from swarmjax.run.checkpoint import Leaves
from swarmjax.run.directory import METRICS, SUMMARY, Row
from swarmjax.run.errors import TrainingError
from swarmjax.run.policy_export import POLICY, seed_path, write_policy
from swarmjax.run.settings import TrainConfig
from swarmjax.training.rollout import Program


def write_policies(run: Path, settings: TrainConfig, leaves: Leaves, update: int) -> None:
    """Writes the policy of every seed.

    Raises:
      TrainingError: if a policy cannot be written.
    """
    for seed in settings.numbers:
        try:
            write_policy(seed_path(run / POLICY, settings, seed), leaves, settings, update, seed)
        except PolicyError as error:  # such as a full disk
            raise TrainingError(str(error)) from None


# Fewest episodes on the last stage before `run.stop_at` may end a run. If 95 of 100 episodes
# succeed, the exact 95 % confidence interval of the success is 0.89 to 0.98.
ENOUGH = 100


def has_reached(settings: TrainConfig, newest: Sequence[Row]) -> bool:
    """Returns whether every seed has reached the success `run.stop_at` on the last stage.

    Args:
      settings: the config.
      newest: the last row of metrics of each seed; empty before the first update.
    """
    column = {"targets": "success_by_stage", "all": "complete_by_stage"}
    shares = [row[column[settings.curriculum.success]][-1] for row in newest]
    if settings.run.stop_at is None or not shares or None in shares:
        return False
    # A curriculum may have only one arena on the last stage; its success says little.
    least = min(ENOUGH, settings.arenas // 2)
    if any(row["episodes_by_stage"][-1] < least for row in newest):
        return False
    # Compared in float32, the type of the shares, so that 19 of 20 targets count as 0.95.
    return bool((np.array(shares, np.float32) >= np.float32(settings.run.stop_at)).all())


def is_current(run: Path, updates: int) -> bool:
    """Returns whether the summary, a run's last file, says that the run ended at this update."""
    try:
        summary = json.loads((run / SUMMARY).read_text())
        return directory.has_ended(summary) and summary["updates"] == updates
    except (OSError, ValueError, KeyError, AttributeError, RecursionError):
        return False


def write_summary(
    run: Path,
    program: Program[TrainConfig],
    updates: int,
    compile_s: float,
    stopped_at: float | None,
) -> None:
    """Writes `summary.json`, with the totals of the run.

    Args:
      run: the run directory.
      program: the run's program.
      updates: number of updates that every seed has done.
      compile_s: seconds spent compiling.
      stopped_at: `run.stop_at` if every seed has reached it, otherwise None.
    """
    settings, engine = program.config, program.world.physics.engine
    rows = directory.read_rows(run / METRICS, None)
    steps = updates * settings.arenas * settings.algo.rollout_length
    train_s = rows[-1]["train_s"] if rows else 0.0
    transitions = sum(row["transitions"] for row in rows)
    directory.write_json(
        run / SUMMARY,
        {
            "stage": settings.stage_name,
            "stages": settings.stage_names,
            "seeds": [*settings.numbers],
            "updates": updates,
            "budget_spent": updates >= settings.updates,
            "stopped_at": stopped_at,
            "arena_steps": steps,
            "train_s": train_s,
            "compile_s": compile_s,
            "arena_steps_per_s": settings.seeds * steps / train_s if train_s else None,
            "transitions_per_s": transitions / train_s if train_s else None,
            "impl": engine.impl,
            "solver": engine.solver,
            "stepped_by": engine.label,
            "update_backend": program.ppo.backend,
            "device": provenance.device(),
            "versions": provenance.versions(),
            "commit": provenance.commit(),
        },
    )
