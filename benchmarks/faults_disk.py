"""A campaign of `benchmarks.faults` that disturbs a run's disk, directory or clock.

In the first `SIZES` trials a run gets a small disk. The disk's size grows from trial to trial, up
to a size that just holds the run. The other trials alternate between four faults: a disk that
becomes read-only, a directory that is removed, two processes on one directory, and a clock that is
set back. Afterwards the run is started once more without a fault, and must end like an undisturbed
run.

Disks are mounted in a separate mount namespace (`unshare`, util-linux). `libfaketime` sets the
clock. If `unshare` or `libfaketime` is missing, the outcome of the trial is `not tried`.
"""

import contextlib
import functools
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults_runs import is_whole, start, train_command, undisturbed
from swarmjax.run import directory

SIZES = 20
PAGE = 4096  # bytes; a tmpfs stores files in whole pages
MOST_SECONDS = 120.0  # a run that takes longer counts as hanging
_LIBRARY = "/usr/lib/*/faketime/libfaketime.so.1"  # Debian's package `libfaketime`


def trial(seed: int, folder: Path) -> dict[str, Any]:
    """Disturbs a run, then resumes it without a fault until it ends.

    Args:
      seed: Seed of the trial; the seed's last six digits choose the fault.
      folder: Empty folder of the trial.

    Returns:
      The kind of fault, how the run ended, and the outcome.
    """
    undisturbed()  # called first, since the uncached call takes as long as a run
    number, random = seed % 1_000_000, np.random.default_rng(seed)
    if number < SIZES:
        return _judge("full disk", _full(number, folder), folder / "run")
    kind = [*_KINDS][number % len(_KINDS)]
    return _judge(kind, _KINDS[kind](random, folder), folder / "run")


def _judge(kind: str, told: dict[str, Any], run: Path) -> dict[str, Any]:
    """Resumes the run until it ends, and judges whether it lost anything."""
    if "missing" in told:
        return {"outcome": "not tried", "kind": kind, **told}
    process = start(run)
    said, _ = process.communicate()
    whole = is_whole(run)
    sound = told["answered"] and process.returncode == 0 and all(whole.values())
    last = {} if sound else {"said_at_last": said[-500:]}
    return {"outcome": "ok" if sound else "WRONG", "kind": kind, **told, **whole, **last}


def _hindered(words: list[str], allowed: set[int], **given: Any) -> dict[str, Any]:
    """Runs a command that may fail, but only with an allowed exit code and without a traceback.

    Args:
      words: The command.
      allowed: Allowed exit codes.
      given: Arguments for `subprocess.run`.
    """
    began = time.perf_counter()
    try:
        done = subprocess.run(
            words, capture_output=True, text=True, timeout=MOST_SECONDS, check=False, **given
        )
    except subprocess.TimeoutExpired:
        return {"answered": False, "code": None, "said": "hangs", "seconds": MOST_SECONDS}
    said = (done.stdout + done.stderr).strip()
    sentence = said.splitlines()[-1] if said else ""
    answered = done.returncode in allowed and "Traceback" not in said
    return {
        "answered": answered,
        "code": done.returncode,
        "said": sentence if answered else said[-500:],
        "seconds": round(time.perf_counter() - began, 1),
    }


@functools.cache
def _needed() -> int:
    """Returns the disk space that an undisturbed run needs at its end, bytes."""
    with tempfile.TemporaryDirectory() as folder:
        start(Path(folder) / "run").communicate()
        files = [path for path in Path(folder).rglob("*") if path.is_file()]
        return sum(-(-path.stat().st_size // PAGE) * PAGE for path in files)


def _on_a_disk(folder: Path, size: int, options: str, run: Path | None = None) -> dict[str, Any]:
    """Trains on a separate disk, and copies the run back to `folder`/run.

    Args:
      folder: Folder of the trial.
      size: Size of the disk, bytes.
      options: Mount options, set after `run` has been copied to the disk.
      run: A run to copy to the disk first; None for a new run.
    """
    if shutil.which("unshare") is None:
        return {"missing": "unshare"}
    disk, kept = folder / "disk", folder / "run"
    disk.mkdir()
    before = "" if run is None else f"cp -r {run} {disk}/run;"
    command = " ".join(train_command(disk / "run"))
    script = (
        f"mount -t tmpfs -o size={size} tmpfs {disk} || exit 99; {before}"
        f"mount -o remount,{options} {disk}; {command}; code=$?;"
        f"rm -rf {kept}; [ -d {disk}/run ] && cp -r {disk}/run {kept}; exit $code"
    )
    told = _hindered(["unshare", "--mount", "--map-root-user", "sh", "-c", script], {0, 1, 2})
    return {"missing": "leave to mount a disk"} if told["code"] == 99 else told


def _full(number: int, folder: Path) -> dict[str, Any]:
    """Trains on a disk that is too small."""
    size = max(1, round(_needed() * (number + 1) / SIZES / PAGE)) * PAGE
    return _on_a_disk(folder, size, "rw") | {"size": size, "needed": _needed()}


def _read_only(random: np.random.Generator, folder: Path) -> dict[str, Any]:
    """Resumes a run on a disk that has become read-only."""
    run = folder / "run"
    _begin(run, random)
    return _on_a_disk(folder, 8 * _needed(), "ro", run if run.exists() else None)


def _begin(run: Path, random: np.random.Generator) -> None:
    """Trains for a while, then asks the run to stop."""
    process = start(run)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(random.uniform(0.3, 1.0) * undisturbed().ends_s)
    process.terminate()
    process.communicate()


def _removed(random: np.random.Generator, folder: Path) -> dict[str, Any]:
    """Removes the directory of a run while the run trains."""
    run = folder / "run"
    wait = random.uniform(0.0, 0.3) * undisturbed().ends_s
    log = run / directory.METRICS
    remove = f"while ! [ -e {log} ]; do sleep 0.05; done; sleep {wait:.3f}; rm -rf {run}"
    gone = subprocess.Popen(["sh", "-c", remove])
    told = _hindered(train_command(run), {0, 1})
    gone.wait()
    shutil.rmtree(run, ignore_errors=True)  # files that were written after the removal
    return told


def _two(random: np.random.Generator, folder: Path) -> dict[str, Any]:
    """Starts a second process on the directory of a run."""
    run = folder / "run"
    first = start(run)
    time.sleep(random.uniform(0.0, 0.8) * undisturbed().ends_s)
    told = _hindered(train_command(run), {0, 2})
    first.communicate()
    # One process trains and the other is refused. If the second process starts late, it finds a
    # finished run.
    codes = {first.returncode, told["code"]}
    return told | {"answered": told["answered"] and 0 in codes and codes <= {0, 2}}


def _clock(random: np.random.Generator, folder: Path) -> dict[str, Any]:
    """Resumes a run with the clock set back by one day."""
    library = next(iter(Path("/").glob(_LIBRARY[1:])), None)
    if library is None:
        return {"missing": "libfaketime"}
    run = folder / "run"
    _begin(run, random)
    clock = {"LD_PRELOAD": str(library), "FAKETIME": "-1d", "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
    return _hindered(train_command(run), {0}, env=os.environ | clock)


_KINDS: Mapping[str, Callable[[np.random.Generator, Path], dict[str, Any]]] = {
    "read-only disk": _read_only,
    "removed directory": _removed,
    "two processes": _two,
    "clock set back": _clock,
}
