"""Writes a policy that was not trained, as a baseline for trained policies.

`python -m benchmarks.baselines out=FILE.npz` writes a policy that `swarmjax.evaluate
policy=FILE.npz` evaluates like any other. The policy drives straight to the target and ignores the
infrared sensors: the turn rate is twice the bearing, and the speed falls with the bearing.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import lines
from swarmjax import command, epuck, policy_file, provenance
from swarmjax.config import Section, about
from swarmjax.task import observation

# The action (speed, turn rate; -1..1) at bearing 0, then the change of the action per radian of
# bearing to the left, and per radian to the right.
AHEAD, SIDES = (1.0, 0.0), ((-2.0, 2.0), (-2.0, -2.0))


@dataclass(frozen=True, kw_only=True)
class BaselinesConfig(Section):
    """Settings: where to write the policy."""

    out: str = field(metadata=about("file .npz for the policy"))


def write(path: Path) -> None:
    """Writes the policy, which is piecewise linear in the bearing."""
    split = np.zeros((1, observation.SIZE, 2), np.float32)
    split[0, observation.NAMES.index("target_bearing")] = [1.0, -1.0]
    none = np.zeros((1, observation.SIZE), np.float32)
    arrays = {
        "actor/hidden_0/kernel": split,
        "actor/hidden_0/bias": none[:, :2],
        "actor/mean/kernel": np.array([SIDES], np.float32),
        "actor/mean/bias": np.array([AHEAD], np.float32),
        "actor/log_std": none[:, :2] - 200.0,  # exp(-200) is 0 in float32
        "normalizer/mean": none,
        "normalizer/std": none + 1.0,
    }
    policy_file.write(path, arrays, meta(1, "relu"))


def meta(learners: int, activation: str) -> dict[str, Any]:
    """Returns the metadata of a policy that was not trained.

    Args:
      learners: number of learners; 1 for a shared policy.
      activation: activation of its hidden layers.
    """
    return {
        "policy": "shared" if learners == 1 else "independent",
        "learners": learners,
        "activation": activation,
        "observation": observation.describe("metric") | {"limit": 10.0},
        "action": {
            "names": policy_file.ACTION_NAMES,
            "units": policy_file.ACTION_UNITS,
            "low": [0.0, -epuck.MAX_TURN_RATE],
            "high": [epuck.MAX_SPEED, epuck.MAX_TURN_RATE],
        },
        "robot": {
            "preset": "planar",
            "body": "planar",
            "wheel_radius": epuck.WHEEL_RADIUS,
            "track": epuck.TRACK,
            "max_wheel_speed": epuck.MAX_WHEEL_SPEED,
        },
        "sensors": {"preset": "ideal", "response": "ideal", "range": epuck.SENSOR_RANGE},
        "task": {
            "control_step": 0.032,
            "target_radius": 0.05,
            "arrival": "latch",
            "observations": [],  # so that `compare` takes it beside a trained policy
        },
        "realism": {"name": "ideal", "infrared": "ideal"},
        "stages": [{"name": "mine", "robots": 2, "side": 1.0}],
        "extensions": {},
        "seed": 0,
        "config": {},
        "versions": provenance.versions(),
        "update": 0,
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings = lines.load(BaselinesConfig, arguments)
    write(Path(settings.out))
    return 0


if __name__ == "__main__":
    sys.exit(command.run("baselines", main, BaselinesConfig))
