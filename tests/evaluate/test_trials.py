"""Checks that judging processes end when the process that started them is killed."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

SCRIPT = """
import os, sys, time
from pathlib import Path
from swarmjax.evaluate import trials

def sleep(path):
    Path(path).write_text(str(os.getpid()))
    time.sleep(600)

if __name__ == "__main__":
    list(trials.work(sleep, sys.argv[1:], 2))
"""


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="Linux tells there who is alive")
def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    script, told = tmp_path / "script.py", [tmp_path / "one", tmp_path / "other"]
    script.write_text(SCRIPT)
    parent = subprocess.Popen(
        [sys.executable, str(script), *map(str, told)],
        stderr=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    _wait_until(lambda: all(path.exists() and path.read_text() for path in told))
    workers = [Path("/proc") / path.read_text() for path in told]
    assert all(worker.exists() for worker in workers)
    parent.kill()
    parent.wait()
    _wait_until(lambda: not any(worker.exists() for worker in workers))
    assert not any(worker.exists() for worker in workers)


def _wait_until(is_so: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60.0
    while not is_so() and time.monotonic() < deadline:
        time.sleep(0.1)
