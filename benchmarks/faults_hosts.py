"""A campaign of `benchmarks.faults` that kills one of the two processes of a run.

A trial starts two processes with one device each, kills one of them at a random moment, and checks
how the other process ends. The run is then resumed on one or two devices until it ends. On a
machine with GPUs each process uses one GPU. On other machines the processes use the CPU and
communicate through gloo.
"""

import contextlib
import functools
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmjax.exit_codes import REQUEUE
from swarmjax.run import directory

UPDATES = 400
WORDS = (
    "stage=s1",
    "arenas=64",
    f"budget={64 * 32 * UPDATES}",
    "run.tensorboard=false",
    "run.chunk=4",
    "run.checkpoint_share=0.1",
    "resume=auto",
)
SECONDS = 4.0  # one process is killed within this time after the first metrics
MOST_SECONDS = 30.0  # the other process must end within this time
_TIMEOUT = 400.0  # s
_POLL = 0.02  # s


def trial(seed: int, folder: Path) -> dict[str, Any]:
    """Kills one of two processes, then resumes the run on one or two devices until it ends.

    Args:
      seed: chooses the moment, the process to kill, and the number of devices after the resume.
      folder: an empty folder.

    Returns:
      The entries of the line.
    """
    random, run = np.random.default_rng(seed), folder / "run"
    victim, devices = int(random.integers(2)), 1 + seed % 2
    lost = _lose_one(run, victim, random.uniform(0.0, SECONDS))
    more = _start(run, devices)
    said = [process.communicate(timeout=_TIMEOUT)[1] for process in more]
    went_on = not any(process.returncode for process in more) and _updates(run) == UPDATES
    sound = lost.is_sound and went_on
    return {
        "outcome": "ok" if sound else "ended before" if lost.updates == UPDATES else "WRONG",
        "victim": victim,
        "goes_on_with": devices,
        "updates": UPDATES,
        "updates_at_the_kill": lost.updates,
        "code": lost.code,
        "seconds_until_the_other_ended": round(lost.seconds, 2),
        "sentence": lost.said.strip()[-300:],
        "success": _success(run),
        **({} if sound else {"said": [text[-500:] for text in said]}),
    }


class Lost(NamedTuple):
    """Describes how a process ended after its peer was killed.

    Attributes:
      updates: updates that the run had done.
      code: exit code.
      said: text on standard error.
      seconds: seconds from the kill to the end.
    """

    updates: int
    code: int
    said: str
    seconds: float

    @property
    def is_sound(self) -> bool:
        """Whether the process ended in time, without traceback, with exit code `REQUEUE`."""
        soon, short = self.seconds < MOST_SECONDS, "Traceback" not in self.said
        return self.code == REQUEUE and soon and short and self.updates > 0


def _lose_one(run: Path, victim: int, after: float) -> Lost:
    """Starts two processes, and kills one of them `after` seconds after the first metrics."""
    both = _start(run, 2)
    try:
        _wait_for_metrics(run, both)
        time.sleep(after)
        # Kills the child process and not its parent, since the parent reports how the child ended.
        _kill_child(both[victim])
        updates, began = _updates(run), time.monotonic()
        _, said = both[1 - victim].communicate(timeout=_TIMEOUT)
        seconds = time.monotonic() - began
        both[victim].communicate(timeout=_TIMEOUT)
    finally:
        for process in both:
            process.kill()
    return Lost(updates, both[1 - victim].returncode, said, seconds)


@functools.cache
def gpus() -> int:
    """Counts the NVIDIA GPUs of this machine, without JAX."""
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        found = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=True)
        return len(found.stdout.splitlines())
    return 0


def _start(run: Path, devices: int) -> list[subprocess.Popen[str]]:
    """Starts or resumes a run, with one process per device."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        coordinator = f"127.0.0.1:{free.getsockname()[1]}"
    processes = []
    for process in range(devices):
        words = [*WORDS, f"run.dir={run}", f"devices={devices}"]
        if devices > 1:
            words += [f"run.coordinator={coordinator}", f"run.processes={devices}"]
            words.append(f"run.process={process}")
        processes.append(
            subprocess.Popen(
                [sys.executable, "-m", "swarmjax.train", *words],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                env=os.environ | _own_device(process),
            )
        )
    return processes


def _own_device(process: int) -> dict[str, str]:
    """Returns the environment variables that give a process one device."""
    if gpus():
        # Several trials may share a machine, so JAX must not reserve the whole GPU memory.
        return {"CUDA_VISIBLE_DEVICES": str(process), "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    return {"JAX_PLATFORMS": "cpu"}


def _wait_for_metrics(run: Path, both: list[subprocess.Popen[str]]) -> None:
    end = time.monotonic() + _TIMEOUT
    while _updates(run) < 1 and time.monotonic() < end:
        if any(process.poll() is not None for process in both):
            return
        time.sleep(_POLL)


def _kill_child(process: subprocess.Popen[str]) -> None:
    found = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    with contextlib.suppress(OSError):
        for child in found.read_text().split():
            os.kill(int(child), signal.SIGKILL)


def _rows(run: Path) -> Iterator[dict[str, Any]]:
    with contextlib.suppress(OSError):
        yield from directory.read_rows(run / directory.METRICS, None, whole=False)


def _updates(run: Path) -> int:
    """Counts the updates in the metrics; -1 if one is missing, repeated or out of order."""
    found = [row["update"] for row in _rows(run)]
    return len(found) if found == list(range(len(found))) else -1


def _success(run: Path) -> float | None:
    """Reads the share of targets that were reached at the end of the run."""
    with contextlib.suppress(OSError, ValueError, KeyError):
        summary = json.loads((run / directory.SUMMARY).read_text())
        return next(iter(summary["targets_reached"][0].values()))
    return None
