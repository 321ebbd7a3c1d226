"""Checks runs of several processes: refusals, written files, and the loss of a process."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from sentences import refusal

from swarmjax.run import hosts
from swarmjax.run.load_settings import load_train

ROOT = Path(__file__).parents[2]
WORDS = ["arenas=64", "algo.num_minibatches=4", "run.tensorboard=false"]


def _start(run: Path, coordinator: str, process: int, *words: str) -> subprocess.Popen[str]:
    given = [*WORDS, f"run.dir={run}", "run.distributed=true", *words]
    joined = {
        "JAX_COORDINATOR_ADDRESS": coordinator,
        "JAX_NUM_PROCESSES": "2",
        "JAX_PROCESS_ID": str(process),
    }
    return subprocess.Popen(
        [sys.executable, "-m", "swarmjax.train", *given],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | joined,
    )


@pytest.fixture
def coordinator() -> str:
    """Returns an address with a free port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


def _said(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, errors = process.communicate(timeout=300)
    return process.returncode, errors


@pytest.mark.slow
def test_processes_of_other_settings_are_refused(tmp_path: Path, coordinator: str) -> None:
    run = tmp_path / "run"
    both = [_start(run, coordinator, i, "devices=2", f"seed={i}") for i in range(2)]
    (first, said), (second, named) = map(_said, both)
    assert (first, second) == (2, 2)
    assert "another process has other settings" in said
    assert "seed is 1 here and 0 in process 0" in named
    assert "Traceback" not in said + named
    assert not run.exists()


@pytest.mark.slow
def test_devices_are_those_of_all_processes(tmp_path: Path, coordinator: str) -> None:
    both = [_start(tmp_path / "run", coordinator, i) for i in range(2)]
    for code, said in map(_said, both):
        assert code == 2
        assert "devices is 1, but the 2 processes of the run have 2: give devices=2." in said


@pytest.mark.slow
def test_a_process_whose_peer_never_comes_is_refused_in_time(
    tmp_path: Path, coordinator: str
) -> None:
    for process in (0, 1):  # process 0, the coordinator, waits for process 1, and 1 for 0
        began = time.monotonic()
        code, said = _said(_start(tmp_path / "run", coordinator, process, "devices=2"))
        assert code == 2
        assert "did not connect within" in said
        assert "Traceback" not in said
        # 90 s: 45 s of waiting, and the start of a process on a busy machine.
        assert time.monotonic() - began < 90.0


def test_processes_of_other_versions_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    other = {"version of jax": "0.0.1"}
    monkeypatch.setattr(hosts, "share_text", lambda text: json.dumps(json.loads(text) | other))
    sentence = refusal(hosts._check_alike, load_train(["seed=1"]))
    assert sentence.startswith("version of jax is ")
    assert sentence.endswith("and '0.0.1' in process 0: give all processes the same.")


@pytest.mark.slow
def test_processes_go_on_together(tmp_path: Path, coordinator: str) -> None:
    run = tmp_path / "run"
    for stop in (3, 5):
        words = ["devices=2", "budget=1e6", "resume=auto", f"run.stop_after={stop}"]
        both = [_start(run, coordinator, i, *words) for i in range(2)]
        assert [_said(process)[0] for process in both] == [0, 0]
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [row["update"] for row in rows] == list(range(5))


@pytest.mark.slow
def test_a_lost_process_ends_the_others_and_the_run_goes_on_alone(
    tmp_path: Path, coordinator: str
) -> None:
    run = tmp_path / "run"
    words = ["devices=2", "run.chunk=1", "run.checkpoint_minutes=0", "budget=1e6"]
    both = [_start(run, coordinator, i, *words) for i in range(2)]
    while not (run / "metrics.jsonl").exists():
        assert all(process.poll() is None for process in both)
        time.sleep(0.1)
    time.sleep(5.0)
    both[1].kill()
    began = time.monotonic()
    code, said = _said(both[0])
    assert code in (75, -signal.SIGABRT)  # JAX aborts where it notices the loss between two calls
    assert "Traceback" not in said
    _said(both[1])
    assert time.monotonic() - began < 30.0
    given = [*WORDS, f"run.dir={run}", "resume=auto", "run.chunk=1", "run.checkpoint_minutes=0"]
    subprocess.run(
        [sys.executable, "-m", "swarmjax.train", *given, "budget=1e6", "run.stop_after=100"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        timeout=300,
    )
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [row["update"] for row in rows] == list(range(100))
