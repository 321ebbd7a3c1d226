"""How many seconds of training does a swarm need to reach its targets, and how fast is training?

`python -m benchmarks.time_to_success RUN [SHARE]` reads a run directory of `swarmjax.train` and
prints a JSON line for each seed. The line has the training seconds, without compilation, until
robots on the last stage first reached at least SHARE of their targets. SHARE is 0.9 by default, and
the share is taken over a whole cohort of training episodes. Seconds are measured only at the end of
each call (`run.chunk`), so they are rounded up to the end of a call. The seeds of a run train
together, so they share one clock, and the speeds are totals over all seeds.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from swarmjax.config import ConfigError
from swarmjax.exit_codes import USER_ERROR
from swarmjax.report import rows as report_rows
from swarmjax.report.rows import Row
from swarmjax.run.recorder import METRICS
from swarmjax.sim.config import physics_substeps

USAGE = "usage: python -m benchmarks.time_to_success RUN [SHARE]\n"

OF_THE_RUN = (
    "impl",
    "arena_steps_per_s",
    "transitions_per_s",
    "train_s",
    "compile_s",
    "device",
    "versions",
    "commit",
)


def lines(run: Path, share: float) -> list[Row]:
    """Summarises a run.

    Args:
      run: the run directory.
      share: share of targets that counts as success, 0..1.

    Returns:
      A JSON line for each seed; its seconds and steps are None if the share was never reached.

    Raises:
      ConfigError: if a file is missing or damaged.
    """
    trained = report_rows.read_config(run)
    summary = _read_summary(run)
    rows = _read_rows(run, len(trained.stage))
    last = trained.stage[-1]
    found = []
    for seed, reached in zip(summary["seeds"], summary["targets_reached"], strict=True):
        mine = [row for row in rows if row["seed"] == seed]
        there = [row for row in mine if (row["success_by_stage"][-1] or 0.0) >= share]
        found.append(
            {
                "benchmark": "time_to_success",
                "stage": trained.stage_name,
                "seed": seed,
                "seeds": trained.seeds,
                "share": share,
                "seconds": there[0].get("train_s") if there else None,
                "arena_steps": there[0]["arena_steps"] if there else None,
                "final_success": reached.get(last.name),
                "broken_arenas": sum(row["broken_arenas"] for row in mine),
                "robot": trained.robot.body,
                "arenas": trained.arenas,
                "robots": last.robots,
                "substeps": physics_substeps(trained.robot, trained.sim.substeps),
                **{key: summary[key] for key in OF_THE_RUN},
            }
        )
    return found


def _read_summary(run: Path) -> Row:
    """Reads the summary of a finished run."""
    path = run / report_rows.SUMMARY
    summary = report_rows.read_object(path)
    for key in ("seeds", "targets_reached", *OF_THE_RUN):
        if key not in summary:
            raise ConfigError(f"{path} has no {key}: it is damaged.")
    seeds, reached = summary["seeds"], summary["targets_reached"]
    if not isinstance(seeds, list):
        raise ConfigError(f"{path} has no list as seeds: it is damaged.")
    shares = reached if isinstance(reached, list) else []
    if len(shares) != len(seeds) or not all(isinstance(each, dict) for each in shares):
        raise ConfigError(f"{path} has no shares of each seed as targets_reached: it is damaged.")
    return summary


def _read_rows(run: Path, stages: int) -> list[Row]:
    """Reads the metrics of a run, and checks the values that the JSON lines need."""
    found = []
    for where, row in report_rows.read_lines(run, METRICS):
        report_rows.check(row, ("seed", "arena_steps", "broken_arenas"), report_rows.WHOLE, where)
        report_rows.check(row, ("train_s",), report_rows.NUMBER_OR_NULL, where)
        by_stage = report_rows.list_of(report_rows.NUMBER_OR_NULL, stages)
        report_rows.check(row, ("success_by_stage",), by_stage, where)
        found.append(row)
    return found


def _share(text: str) -> float:
    """Parses a share of the targets; raises ConfigError unless it is from 0 to 1."""
    try:
        share = float(text)
    except ValueError:
        share = -1.0
    if not 0.0 <= share <= 1.0:
        raise ConfigError(f"SHARE is {text}: give a number from 0 to 1.")
    return share


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code, which is 2 for a user error."""
    if {"-h", "--help"} & set(arguments):
        sys.stdout.write(USAGE)
        return 0
    if not 1 <= len(arguments) <= 2:
        sys.stderr.write(USAGE)
        return USER_ERROR
    try:
        found = lines(Path(arguments[0]), _share(arguments[1]) if len(arguments) > 1 else 0.9)
    except ConfigError as error:
        sys.stderr.write(f"benchmarks.time_to_success: error: {error}\n")
        return USER_ERROR
    sys.stdout.writelines(json.dumps(line) + "\n" for line in found)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
