"""How many seconds of training until a swarm reaches its targets, and how fast was it trained?

`python -m benchmarks.time_to_success RUN [SHARE]` reads a run directory that `swarmjax.train` left
and prints a JSON line for each seed: the seconds after compilation at which the success of the last
stage was first measured at SHARE (0.9) of the targets or more, over a whole cohort of training
episodes. Seconds are those at the end of the call (`run.chunk`), so they are rounded up to it;
seeds of one run share them, and its speeds are those of all of them together.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from swarmjax.config import TrainConfig, build, substeps
from swarmjax.recorder import METRICS

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


def lines(run: Path, share: float) -> list[dict]:
    """Sums a run up.

    Args:
      run: the run directory.
      share: of targets that counts as success, 0..1.

    Returns:
      A JSON line for each seed; seconds and steps are None if the share was never measured.
    """
    trained = build(TrainConfig, json.loads((run / "config.json").read_text()))
    summary = json.loads((run / "summary.json").read_text())
    rows = [json.loads(text) for text in (run / METRICS).read_text().splitlines()]
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
                "seconds": there[0]["train_s"] if there else None,
                "arena_steps": there[0]["arena_steps"] if there else None,
                "final_success": reached.get(last.name),
                "broken_arenas": sum(row["broken_arenas"] for row in mine),
                "robot": trained.robot.body,
                "arenas": trained.arenas,
                "robots": last.robots,
                "substeps": substeps(trained.robot, trained.sim.substeps),
                **{key: summary[key] for key in OF_THE_RUN},
            }
        )
    return found


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    if not 1 <= len(arguments) <= 2:
        sys.stderr.write("usage: python -m benchmarks.time_to_success RUN [SHARE]\n")
        return 2
    run, share = Path(arguments[0]), float(arguments[1]) if len(arguments) > 1 else 0.9
    sys.stdout.writelines(json.dumps(line) + "\n" for line in lines(run, share))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
