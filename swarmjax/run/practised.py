"""Lists the levels that a run currently practises, from its newest checkpoint, for its report."""

from collections.abc import Mapping
from typing import Any

import numpy as np

FILE = "levels.json"
BEST = 3  # levels to list for each stage
_BUFFER = "curriculum/levels/"
_TOLD = ("numbers", "score", "episodes", "successes", "generation")


def best(leaves: Mapping[str, np.ndarray]) -> dict[str, Any] | None:
    """Lists the levels of the buffer with the highest scores.

    Args:
      leaves: [N, ...] arrays of a checkpoint.

    Returns:
      `update` and `levels`; None without a buffer. `levels` lists at most `BEST` levels for each
      seed and stage, best first. Each level has its `score`, `episodes`, `successes`, `generation`,
      and the `numbers` that define it.
    """
    if f"{_BUFFER}numbers" not in leaves:
        return None
    buffer = {name: leaves[f"{_BUFFER}{name}"] for name in _TOLD}
    seeds, stages, _ = buffer["score"].shape
    found = [
        [_of_stage({name: x[seed, stage] for name, x in buffer.items()}) for stage in range(stages)]
        for seed in range(seeds)
    ]
    return {"update": int(leaves["update"][0]), "levels": found}


def _of_stage(buffer: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    order = np.argsort(-buffer["score"], kind="stable")
    chosen = order[buffer["episodes"][order] > 0][:BEST]
    return [{name: buffer[name][at].tolist() for name in _TOLD} for at in chosen]
