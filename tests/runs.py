"""Writes run directories by hand, for the tests of the report."""

import json
from pathlib import Path

from swarmjax.config import to_dict
from swarmjax.ppo.config import AlgoConfig
from swarmjax.run.settings import TrainConfig
from swarmjax.sim.config import SimConfig
from swarmjax.task.config import TaskConfig
from swarmjax.task.stage_config import StageConfig

CONFIG = TrainConfig(
    stage=(
        StageConfig(name="pair", robots=2, side=0.5),
        StageConfig(name="trio", robots=3, side=0.8, obstacles=2),
    ),
    task=TaskConfig(step_limit=16),  # a cohort is two updates of 8 control steps
    algo=AlgoConfig(hidden_sizes=(8,), rollout_length=8, num_minibatches=2),
    sim=SimConfig(impl="jax"),
    arenas=8,
    budget=8 * 8 * 20,
)


def row(update: int, seed: int = 0, **given: object) -> dict:
    """Returns a row of metrics.jsonl: all arenas are on stage 1 of 2, and nothing is measured."""
    return {
        "seed": seed,
        "update": update,
        "arena_steps": 64 * (update + 1),
        "train_s": 30.0 * (update + 1),
        "mix": [8, 0],
        "weights": [1.0, 0.0],
        "success_by_stage": [None, None],
        "complete_by_stage": [None, None],
        "contacts_by_stage": [None, None],
        "return_by_stage": [None, None],
        "episodes_by_stage": [None, None],
        **given,
    }


def write(
    run: Path,
    rows: list[dict],
    decisions: list[dict] | None = None,
    trained: TrainConfig = CONFIG,
) -> Path:
    """Writes a run directory."""
    run.mkdir(parents=True, exist_ok=True)
    (run / "config.json").write_text(json.dumps(to_dict(trained)))
    (run / "metrics.jsonl").write_text("".join(json.dumps(each) + "\n" for each in rows))
    lines = "".join(json.dumps(each) + "\n" for each in decisions or [])
    (run / "curriculum.jsonl").write_text(lines)
    return run
