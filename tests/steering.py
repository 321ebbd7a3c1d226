"""Writes policies by hand that steer only by the bearing of their target."""

from pathlib import Path
from typing import Any

import numpy as np
import policies

from swarmjax import policy_file
from swarmjax.task import observation

SPEED = 0.1256  # m/s, the largest command
STEP = 0.032  # s, a control step
STRIDE = SPEED * STEP  # m; the servo reaches the speed within one control step
NO_NOISE = -200.0  # The logarithm of a deviation that is 0 in float32.
# A policy's action at bearing 0, then its change per radian of bearing to the left and to the
# right.
STEER = ((1.0, 0.0), (-2.0, 2.0), (-2.0, -2.0))
AHEAD = ((1.0, 0.0), (0.0, 0.0), (0.0, 0.0))
STAY = ((-1.0, 0.0), (0.0, 0.0), (0.0, 0.0))
SPIN = ((-1.0, 1.0), (0.0, 0.0), (0.0, 0.0))


def write(
    path: Path,
    drive: tuple = STEER,
    learners: int = 1,
    log_std: float | np.ndarray = NO_NOISE,
    **meta: Any,
) -> Path:
    """Writes a policy whose one hidden layer has the units relu(bearing) and relu(-bearing)."""
    bearing = np.zeros((1, observation.SIZE, 2))
    bearing[0, observation.NAMES.index("target_bearing")] = [1.0, -1.0]
    zero = np.zeros((1, observation.SIZE))
    arrays = {
        "actor/hidden_0/kernel": bearing,
        "actor/hidden_0/bias": zero[:, :2],
        "actor/mean/kernel": np.array([drive[1:]]),
        "actor/mean/bias": np.array([drive[0]]),
        "actor/log_std": zero[:, :2] + log_std,
        "normalizer/mean": zero,
        "normalizer/std": zero + 1.0,
    }
    arrays = {n: np.repeat(a, learners // len(a), 0).astype(np.float32) for n, a in arrays.items()}
    said = {"learners": learners, "activation": "relu", "config": {}, "versions": {}, "update": 0}
    policy_file.write(path, arrays, policies.meta(**{**said, **meta}))
    return path


def arrays(drives: tuple) -> dict[str, np.ndarray]:
    """Returns policies with one hidden layer, relu(bearing) and relu(-bearing); one per robot."""
    count = len(drives)
    bearing = np.zeros((count, observation.SIZE, 2), np.float32)
    bearing[:, observation.NAMES.index("target_bearing")] = [1.0, -1.0]
    drive = np.array(drives, np.float32)
    return {
        "actor/hidden_0/kernel": bearing,
        "actor/hidden_0/bias": np.zeros((count, 2), np.float32),
        "actor/mean/kernel": drive[:, 1:],
        "actor/mean/bias": drive[:, 0],
        "actor/log_std": np.zeros((count, 2), np.float32),
        "normalizer/mean": np.zeros((count, observation.SIZE), np.float32),
        "normalizer/std": np.ones((count, observation.SIZE), np.float32),
    }
