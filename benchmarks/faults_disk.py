"""Campaign of `benchmarks.faults` against the disk, the directory and the clock of a run.

The first `SIZES` trials give a run a disk that is too small, each of another size, up to one that
just holds it. The rest take turns: a disk that becomes read-only, a directory that is removed, two
processes on one directory, and a clock that is set back. Afterwards the run is started once more
where nothing hinders it, and must end as an undisturbed run does.

Disks are mounted in a namespace of their own (`unshare`, util-linux); the clock is that of
`libfaketime`. A trial that lacks either says `not tried`.
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
PAGE = 4096  # bytes; a tmpfs has whole pages
MOST_SECONDS = 120.0  # a run that takes longer hangs
_LIBRARY = "/usr/lib/*/faketime/libfaketime.so.1"  # Debian's package `libfaketime`


def trial(seed: int, folder: Path) -> dict[str, Any]:
    """Hinders a run, then lets it end.

    Args:
        seed: Of the trial; its number chooses the hindrance.
        folder: Of the trial, empty.

    Returns:
        The kind of hindrance, what the run ended with, and what came of it.
    """
    undisturbed()  # before a run starts: it takes as long as one
    number, random = seed % 1_000_000, np.random.default_rng(seed)
    if number < SIZES:
        return _judge("full disk", _full(number, folder), folder / "run")
    kind = [*_KINDS][number % len(_KINDS)]
    return _judge(kind, _KINDS[kind](random, folder), folder / "run")


def _judge(kind: str, told: dict[str, Any], run: Path) -> dict[str, Any]:
    """Lets the run end and says whether anything was lost."""
    if "missing" in told:
        return {"outcome": "not tried", "kind": kind, **told}
    process = start(run)
    said, _ = process.communicate()
    whole = is_whole(run)
    sound = told["answered"] and process.returncode == 0 and all(whole.values())
    last = {} if sound else {"said_at_last": said[-500:]}
    return {"outcome": "ok" if sound else "WRONG", "kind": kind, **told, **whole, **last}


def _hindered(words: list[str], allowed: set[int], **given: Any) -> dict[str, Any]:
    """Runs a command that may fail, with one sentence.

    Args:
        words: The command.
        allowed: Exit codes that it may have.
        given: For `subprocess.run`.
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
    """Bytes of disk that an undisturbed run needs at its end."""
    with tempfile.TemporaryDirectory() as folder:
        start(Path(folder) / "run").communicate()
        files = [path for path in Path(folder).rglob("*") if path.is_file()]
        return sum(-(-path.stat().st_size // PAGE) * PAGE for path in files)


def _on_a_disk(folder: Path, size: int, options: str, run: Path | None = None) -> dict[str, Any]:
    """Trains on a disk of its own, and brings what it holds back to `folder`/run.

    Args:
        folder: Of the trial.
        size: Of the disk, bytes.
        options: Of the mount, once `run` lies there.
        run: A run that lies on the disk already.
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
    """Goes on with a run on a disk that is read-only by then."""
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
    """Removes the directory of a run while it trains, and starts the run once more."""
    run = folder / "run"
    wait = random.uniform(0.0, 0.3) * undisturbed().ends_s
    log = run / directory.METRICS
    remove = f"while ! [ -e {log} ]; do sleep 0.05; done; sleep {wait:.3f}; rm -rf {run}"
    gone = subprocess.Popen(["sh", "-c", remove])
    told = _hindered(train_command(run), {0, 1})
    gone.wait()
    shutil.rmtree(run, ignore_errors=True)  # what was written after
    return told


def _two(random: np.random.Generator, folder: Path) -> dict[str, Any]:
    """Starts a second process on the directory of a run."""
    run = folder / "run"
    first = start(run)
    time.sleep(random.uniform(0.0, 0.8) * undisturbed().ends_s)
    told = _hindered(train_command(run), {0, 2})
    first.communicate()
    # One of them trains and the other is refused; one that comes late finds nothing left to do.
    codes = {first.returncode, told["code"]}
    return told | {"answered": told["answered"] and 0 in codes and codes <= {0, 2}}


def _clock(random: np.random.Generator, folder: Path) -> dict[str, Any]:
    """Goes on with a run a day before it began."""
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
