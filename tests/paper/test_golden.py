"""Compares one update of `algo=paper` with numbers that make_golden.py got from PPO-PyTorch."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from golden_update import errors

# Bounds on the difference that float64 rounding in both programs may cause in 80 steps of Adam.
DOUBLE = {"returns": 1e-10, "advantages": 1e-10, "loss_1": 1e-9, "loss_80": 1e-9}
DOUBLE |= {"params_1": 1e-8, "params_80": 1e-6}  # relative error in norm


def _double(case: str) -> dict[str, float]:
    """Returns the float64 errors, from a separate process because a process has one precision."""
    program = Path(__file__).with_name("golden_update.py")
    found = subprocess.run(
        [sys.executable, str(program), case],
        env=os.environ | {"JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    return json.loads(found.stdout)


@pytest.mark.parametrize(
    ("case", "compared"),
    [
        ("terminal", set(DOUBLE)),
        pytest.param("std", {"loss_1", "loss_80"}, marks=pytest.mark.slow),
        # Steps in which an arrived robot waits must not affect the update.
        pytest.param(
            "waiting", {"returns", "advantages", "loss_1", "params_1"}, marks=pytest.mark.slow
        ),
    ],
)
def test_an_update_is_theirs_in_double_precision(case: str, compared: set[str]) -> None:
    found = _double(case)
    assert set(found) == compared
    assert all(found[name] <= DOUBLE[name] for name in compared), found


@pytest.mark.slow
def test_an_update_is_theirs_in_single_precision() -> None:
    found = errors("terminal", trained=(80,))
    # `params_80` is a relative error in norm. Both bounds are for float32 returns and gradients.
    assert found["params_80"] <= 1e-3
    assert found["returns"] <= 1e-4
