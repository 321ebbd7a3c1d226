"""When each seed of a run first reached its targets."""

import json
from pathlib import Path

import runs
from runs import CONFIG, row

from benchmarks import time_to_success


def _run(folder: Path) -> Path:
    """Two seeds on two stages; seed 1 is measured on the last one once, and not well."""
    shares = {
        0: [[0.95, None], [0.99, 0.89], [0.99, 0.9], [None, 0.97]],
        1: [[0.95, None], [0.5, None], [0.5, 0.25], [None, 0.25]],
    }
    rows = [
        row(update, seed, success_by_stage=shares[seed][update], broken_arenas=seed)
        for update in range(4)
        for seed in (0, 1)
    ]
    run = runs.write(folder, rows, trained=CONFIG)
    figures = dict.fromkeys(time_to_success.OF_THE_RUN, 2.5)
    reached = [{"pair": 0.99, "trio": 0.97}, {"pair": 0.5}]
    summary = {"seeds": [0, 1], "targets_reached": reached, **figures}
    (run / "summary.json").write_text(json.dumps(summary))
    return run


def test_each_seed_has_a_line_of_its_own(tmp_path: Path) -> None:
    first, second = time_to_success.lines(_run(tmp_path), 0.9)
    # The last stage is the second; update 2 ends at 3 x 30 s and 3 x 64 arena steps.
    assert (first["seed"], first["seconds"], first["arena_steps"]) == (0, 90.0, 192)
    assert (second["seed"], second["seconds"], second["arena_steps"]) == (1, None, None)
    assert (first["final_success"], second["final_success"]) == (0.97, None)
    assert (first["broken_arenas"], second["broken_arenas"]) == (0, 4)
    assert first["transitions_per_s"] == second["transitions_per_s"] == 2.5
