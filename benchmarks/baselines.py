"""How good is a policy that never learned? Two of them, judged by `swarmjax.evaluate`.

`python -m benchmarks.baselines [evaluate keys]` prints a JSON line for `blind`, which drives
straight at its target and ignores the infrared, and for `still`, which never moves. What a
trained policy must beat is `blind`: it reaches most targets of an open arena, by pushing through
whatever is there.
"""

import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from swarmjax import command, epuck, policy_file, provenance
from swarmjax.evaluate.config import EvaluateConfig
from swarmjax.evaluate.evaluation import evaluate
from swarmjax.task import observation
from swarmjax.task.stage_files import load_levels

# Action (speed, turn rate; -1..1) at bearing 0, and what each radian to the left or right adds:
# full speed and twice the bearing as a turn, slower the further the target is off the nose.
POLICIES = {
    "blind": ((1.0, 0.0), (-2.0, 2.0), (-2.0, -2.0)),
    "still": ((-1.0, 0.0), (0.0, 0.0), (0.0, 0.0)),
}


def write(path: Path, ahead: Sequence[float], *sides: Sequence[float]) -> None:
    """Writes a policy that is piecewise linear in the bearing.

    Args:
      path: of the `policy.npz`.
      ahead: [2] action at bearing 0.
      sides: [2] each: what a radian to the left, and to the right, adds.
    """
    split = np.zeros((1, observation.SIZE, 2), np.float32)
    split[0, observation.NAMES.index("target_bearing")] = [1.0, -1.0]
    none = np.zeros((1, observation.SIZE), np.float32)
    arrays = {
        "actor/hidden_0/kernel": split,
        "actor/hidden_0/bias": none[:, :2],
        "actor/mean/kernel": np.array([sides], np.float32),
        "actor/mean/bias": np.array([ahead], np.float32),
        "actor/log_std": none[:, :2] - 200.0,  # a deviation of 0 in float32
        "normalizer/mean": none,
        "normalizer/std": none + 1.0,
    }
    turn = epuck.MAX_TURN_RATE
    meta = {
        "policy": "shared",
        "learners": 1,
        "activation": "relu",
        "observation": observation.describe("metric") | {"limit": 10.0},
        "action": {
            "names": ["speed", "turn_rate"],
            "units": ["m/s", "rad/s"],
            "low": [0.0, -turn],
            "high": [epuck.MAX_SPEED, turn],
        },
        "robot": {
            "preset": "planar",
            "body": "planar",
            "wheel_radius": epuck.WHEEL_RADIUS,
            "track": epuck.TRACK,
            "max_wheel_speed": epuck.MAX_WHEEL_SPEED,
        },
        "sensors": {"preset": "ideal", "response": "ideal", "range": epuck.SENSOR_RANGE},
        "task": {"control_step": 0.032, "target_radius": 0.05},
        "seed": 0,
        "config": {},
        "versions": provenance.versions(),
        "update": 0,
    }
    policy_file.write(path, arrays, meta)


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    for name, actions in POLICIES.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{name}.npz"
            write(path, *actions)
            settings = load_levels(EvaluateConfig, [*arguments, f"policy={path}"])
            result = evaluate(settings).result
        del result["policies"]  # written a moment ago, to a folder that is gone
        line = {"benchmark": "baselines", "policy": name, **result, "commit": provenance.commit()}
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(command.run("baselines", main, EvaluateConfig))
