"""Checks that a run on two devices, in one or two processes, matches the run on one device."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow  # each run compiles in a process of its own

ROOT = Path(__file__).parents[2]
SCRIPT = Path(__file__).with_name("two_devices.py")

Found = dict[str, np.ndarray]

PLAIN = ""
# Optional parts of a run: a memory, and a critic that sees the state.
REMEMBERS = "algo.memory=gru algo.memory_size=8 algo.critic=state"


def _start(
    out: Path, devices: int, words: str, *more: str, forced: int = 1
) -> subprocess.Popen[str]:
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={forced}"
    return subprocess.Popen(
        [sys.executable, str(SCRIPT), str(out), str(devices), words, *more],
        cwd=ROOT,
        env=os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
    )


def _end(*processes: subprocess.Popen[str]) -> None:
    for process in processes:
        _, errors = process.communicate(timeout=600)
        assert process.returncode == 0, errors


@pytest.fixture(scope="module", params=[PLAIN, REMEMBERS], ids=["plain", "remembers"])
def words(request: pytest.FixtureRequest) -> str:
    """Returns the words of the config that the run gets."""
    return request.param


@pytest.fixture(scope="module")
def alone(words: str, tmp_path_factory: pytest.TempPathFactory) -> Found:
    """Returns the results of the run on one device, with the random streams of two devices."""
    out = tmp_path_factory.mktemp("alone") / "found.npz"
    _end(_start(out, 1, words))
    return dict(np.load(out))


@pytest.fixture(scope="module", params=["one process", "two processes"])
def spread(
    request: pytest.FixtureRequest, words: str, tmp_path_factory: pytest.TempPathFactory
) -> Found:
    """Returns the results of the run on two devices."""
    out = tmp_path_factory.mktemp("spread") / "found.npz"
    if request.param == "one process":
        _end(_start(out, 2, words, forced=2))
    else:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            coordinator = f"127.0.0.1:{free.getsockname()[1]}"
        _end(*[_start(out, 2, words, coordinator, str(rank)) for rank in range(2)])
    return dict(np.load(out))


def test_learners_are_the_same(alone: Found, spread: Found) -> None:
    learned = [name for name in alone if name.startswith(".params")]
    assert len(learned) > 10
    for name in learned:
        # float32 sums in another order make parameters differ by 2e-5 after 160 steps of Adam, as
        # measured. A statistic over one device alone would change them by more than a hundredth.
        np.testing.assert_allclose(spread[name], alone[name], rtol=0.0, atol=2e-4, err_msg=name)


@pytest.mark.parametrize("name", ["decision", "stage", "next_stage", "mix"])
def test_the_curriculum_decides_the_same(alone: Found, spread: Found, name: str) -> None:
    np.testing.assert_array_equal(spread[f"metrics/{name}"], alone[f"metrics/{name}"])


def test_an_update_sums_once_a_minibatch_and_five_times_more(alone: Found, spread: Found) -> None:
    assert int(alone["sums"]) == 0
    assert int(spread["sums"]) == 1 + 5  # 1 in the loop over minibatches


def test_the_curriculum_moves_on(alone: Found) -> None:
    assert np.ptp(alone["metrics/stage"]) > 1


@pytest.mark.parametrize(
    "name",
    ["transitions", "episodes", "targets", "reached", "steps", "episodes_by_stage"],
)
def test_counts_are_of_all_arenas(alone: Found, spread: Found, name: str) -> None:
    # Rounding may let a robot arrive a step earlier or later.
    np.testing.assert_allclose(spread[f"metrics/{name}"], alone[f"metrics/{name}"], rtol=2e-3)
