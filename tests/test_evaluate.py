"""The judge against hand-worked numbers, against the training environment, and as a command."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from swarmjax import command, evaluate, policy
from swarmjax.config import (
    ConfigError,
    EvaluateConfig,
    RobotConfig,
    SimConfig,
    StageConfig,
    TaskConfig,
    TrainConfig,
    load_evaluate,
)
from swarmjax.evaluate import Arenas, Judge, Outcome
from swarmjax.policy import Policy, PolicyError
from swarmjax.sim import gaps
from swarmjax.task import env, level, observation

SPEED = 0.1256  # m/s; largest command
STEP = 0.032  # s; control step
RADIUS = 0.037  # m; of the hull
# relu(bearing) and relu(-bearing) become the turn 2 * bearing and the speed 1 - 2 * |bearing|.
STEER = ([[0.0, 1.0], [-2.0, -2.0], [2.0, -2.0]], "relu")


def _write(path: Path, mean: list[list[float]], activation: str = "relu", **meta: Any) -> Path:
    """Writes a policy by hand: `mean` is [bias, weight of bearing > 0, of bearing < 0][speed, turn]."""
    kernel = np.zeros((1, observation.SIZE, 2), np.float32)
    kernel[0, observation.NAMES.index("target_bearing")] = [1.0, -1.0]
    zero, one = np.zeros((1, observation.SIZE), np.float32), np.ones((1, observation.SIZE), np.float32)
    weights = np.array([mean], np.float32)
    arrays = {
        "actor/hidden_0/kernel": kernel,
        "actor/hidden_0/bias": np.zeros((1, 2), np.float32),
        "actor/mean/kernel": weights[:, 1:],
        "actor/mean/bias": weights[:, 0],
        "actor/log_std": np.zeros((1, 2), np.float32),
        "normalizer/mean": zero,
        "normalizer/std": one,
    }
    layout = {"names": list(observation.NAMES), "units": list(observation.UNITS), "limit": 10.0}
    limits = {"low": [0.0, -3.14], "high": [SPEED, 3.14]}
    action = {"names": ["speed", "turn_rate"], "units": ["m/s", "rad/s"]} | limits
    full = {
        "policy": "shared",
        "learners": 1,
        "activation": activation,
        "observation": layout,
        "action": action,
        "config": {},
        "versions": {},
        "update": 0,
    }
    policy.save(path, arrays, full | meta)
    return path
