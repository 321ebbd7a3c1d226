"""Tests that a policy is judged where JAX is not installed."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from policies import EMBODIMENT

from swarmjax import policy_file
from swarmjax.task import observation

_ABSENT = ("jax", "jaxlib", "flax", "chex", "optax", "brax", "orbax", "scipy", "warp")


def _write_policy(path: Path) -> None:
    """Writes a policy that drives straight ahead."""
    sizes = (observation.SIZE, 4, 2)
    arrays = {
        "actor/hidden_0/kernel": np.zeros((1, *sizes[:2])),
        "actor/hidden_0/bias": np.zeros((1, 4)),
        "actor/mean/kernel": np.zeros((1, *sizes[1:])),
        "actor/mean/bias": np.array([[1.0, 0.0]]),
        "actor/log_std": np.zeros((1, 2)),
        "normalizer/mean": np.zeros((1, observation.SIZE)),
        "normalizer/std": np.ones((1, observation.SIZE)),
    }
    meta = {
        "policy": "shared",
        "learners": 1,
        "activation": "tanh",
        "observation": observation.describe("metric") | {"limit": 10.0},
        "action": {
            "names": policy_file.ACTION_NAMES,
            "units": policy_file.ACTION_UNITS,
            "low": [0.0, -3.14],
            "high": [0.1256, 3.14],
        },
        "config": {},
        **EMBODIMENT,
        "versions": {},
        "update": 0,
    }
    policy_file.write(path, {name: a.astype(np.float32) for name, a in arrays.items()}, meta)


def test_policy_and_evaluate_run_without_jax(tmp_path: Path) -> None:
    _write_policy(tmp_path / "policy.npz")
    # Stand-ins that cannot be imported are first on the path, which the two workers inherit.
    absent = tmp_path / "absent"
    absent.mkdir()
    for name in _ABSENT:
        (absent / f"{name}.py").write_text(f"raise ImportError('{name} is absent')\n")
    words = ["policy=policy.npz", "stage=s3", "episodes=2", "steps=10", "workers=2"]
    code = (
        "import sys, runpy\n"
        "sys.modules['mujoco.mjx'] = None\n"
        "import swarmjax.policy, swarmjax.policy_file, swarmjax.evaluate.statistics\n"
        f"sys.argv = ['evaluate', *{words}, 'out=result.json']\n"
        "runpy.run_module('swarmjax.evaluate', run_name='__main__', alter_sys=True)\n"
    )
    root = Path(__file__).resolve().parents[1]
    path = os.pathsep.join([str(absent), str(root)])
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert '"episodes": 2' in (tmp_path / "result.json").read_text()
