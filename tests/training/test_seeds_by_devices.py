"""Checks that seeds spread over devices train as on one device."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from swarmjax.policy import Policy, load
from swarmjax.run import checkpoint

ROOT = Path(__file__).parents[2]
TINY = [
    "stage=s1",
    "arenas=4",
    "budget=144",  # nine updates
    "task.step_limit=8",
    "algo.rollout_length=4",
    "algo.num_minibatches=2",
    "algo.hidden_sizes=[8]",
    "run.tensorboard=false",
    "seeds=2",
]


def _train(*words: str) -> None:
    """Trains in a process that has two CPU devices."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    subprocess.run(
        [sys.executable, "-m", "swarmjax.train", *words],
        cwd=ROOT,
        env=os.environ | {"XLA_FLAGS": flags},
        check=True,
        capture_output=True,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("seeds")
    for seed in (0, 1):
        _train(*TINY, "seeds=1", f"seed={seed}", f"run.dir={folder / f'alone{seed}'}")
    _train(*TINY, "seeds_by=devices", "devices=2", f"run.dir={folder / 'spread'}")
    return folder


def _kernels(policy: Policy) -> list[np.ndarray]:
    return [kernel for kernel, _ in policy.layers]


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.slow
def test_every_seed_is_the_one_that_it_is_alone(seed: int, folder: Path) -> None:
    spread = load(folder / "spread" / f"policy-seed{seed}.npz")
    alone = load(folder / f"alone{seed}" / "policy.npz")
    # XLA fuses the two programs differently, so float32 sums round differently.
    for mine, its in zip(_kernels(spread), _kernels(alone), strict=True):
        np.testing.assert_allclose(mine, its, rtol=0.0, atol=1e-6)


@pytest.mark.slow
def test_seeds_differ(folder: Path) -> None:
    first, second = (load(folder / "spread" / f"policy-seed{seed}.npz") for seed in (0, 1))
    assert not np.array_equal(_kernels(first)[0], _kernels(second)[0])


@pytest.mark.slow
def test_a_checkpoint_holds_all_seeds(folder: Path) -> None:
    assert checkpoint.find(folder / "spread").leaves["update"].tolist() == [9, 9]
