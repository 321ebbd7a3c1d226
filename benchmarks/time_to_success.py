"""How many seconds of training until a swarm reaches its targets, and how fast was it trained?

`python -m benchmarks.time_to_success RUN [SHARE]` reads a run directory that `swarmjax.train` left
and prints a JSON line: the seconds after compilation at which the success of the last stage was
first measured at SHARE (0.9) of the targets or more, over a whole cohort of training episodes.
Seconds are those at the end of the call (`run.chunk`), so they are rounded up to it.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from swarmjax.config import TrainConfig, build, substeps
from swarmjax.recorder import METRICS


def line(run: Path, share: float) -> dict:
    """Sums a run up.

    Args:
      run: the run directory.
      share: of targets that counts as success, 0..1.

    Returns:
      The JSON line; seconds and steps are None if the share was never measured.
    """
    config = json.loads((run / "config.json").read_text())
    summary = json.loads((run / "summary.json").read_text())
    rows = [json.loads(text) for text in (run / METRICS).read_text().splitlines()]
    last, trained = config["stage"][-1], build(TrainConfig, config)
    there = [r for r in rows if r["stage"] == last["name"] and (r["stage_success"] or 0.0) >= share]
    return {
        "benchmark": "time_to_success",
        "stage": config["stage_name"],
        "share": share,
        "seconds": there[0]["train_s"] if there else None,
        "arena_steps": there[0]["arena_steps"] if there else None,
        "final_success": summary["targets_reached"].get(last["name"]),
        "broken_arenas": sum(row["broken_arenas"] for row in rows),
        "robot": config["robot"]["body"],
        "arenas": config["arenas"],
        "robots": last["robots"],
        "substeps": substeps(trained.robot, trained.sim.substeps),
        **{k: summary[k] for k in ("impl", "arena_steps_per_s", "transitions_per_s")},
        **{k: summary[k] for k in ("train_s", "compile_s", "device", "versions", "commit")},
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    if not 1 <= len(arguments) <= 2:
        sys.stderr.write("usage: python -m benchmarks.time_to_success RUN [SHARE]\n")
        return 2
    run, share = Path(arguments[0]), float(arguments[1]) if len(arguments) > 1 else 0.9
    sys.stdout.write(json.dumps(line(run, share)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
