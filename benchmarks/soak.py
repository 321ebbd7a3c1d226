"""Do memory use, open file descriptors and speed stay constant in a long training run?

`python -m benchmarks.soak dir=DIR minutes=60 [key=value ...]` trains in `DIR`/run for this time and
then asks the run to stop. It appends a sample every ten seconds to `DIR`/samples.jsonl. All other
keys are keys of `swarmjax.train`. Repeating the command resumes the run. A leg is the part of the
run that one command trains. `python -m benchmarks.soak dir=DIR do=table` prints a JSON line with
the median and the slope of each quantity in each leg. The slope is a Theil-Sen estimate in percent
of the median per hour, with a 95 % interval.

Speed is given per second of elapsed time and per second of processor time. Other processes on the
machine affect the speed per second of processor time less.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy import stats

from benchmarks import key_value
from swarmjax import command, provenance
from swarmjax.config import Section, about
from swarmjax.exit_codes import REQUEUE
from swarmjax.run import directory

EVERY_S = 10.0  # s between two samples
WARM_UP = 0.1  # share of a leg left out at its start: caches fill, the policy learns to move
SAMPLES = "samples.jsonl"
_TAIL = 65_536  # bytes read from the end of the metrics, enough for the last line
_LEVELS = ("memory_mb", "device_memory_mb", "descriptors", "threads")
_SPEEDS = ("arena_steps_per_s", "arena_steps_per_cpu_s")


@dataclass(frozen=True, kw_only=True)
class SoakConfig(Section):
    """Settings: how long to train, and where."""

    dir: str = field(metadata=about("folder of the run and of the samples"))
    minutes: float = field(default=60.0, metadata=about("of this leg", above=0.0))
    do: Literal["train", "table"] = field(default="train", metadata=about("what is done"))


def sample(pid: int, run: Path) -> dict[str, float]:
    """Measures a process and the progress of its training run.

    Args:
      pid: Id of the process.
      run: The run directory.

    Returns:
      Resident memory, used GPU memory if there is a GPU, number of open file descriptors, number of
      threads, processor seconds since the start, and arena steps of the run.

    Raises:
      OSError: If the process has ended.
    """
    place = Path("/proc") / str(pid)
    status = (place / "stat").read_text().rpartition(")")[2].split()
    user, system, threads, pages = (int(status[i]) for i in (11, 12, 17, 21))
    device = _device_memory()
    return ({} if device is None else {"device_memory_mb": device}) | {
        "memory_mb": pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
        "descriptors": len(list((place / "fd").iterdir())),
        "threads": threads,
        "cpu_s": (user + system) / os.sysconf("SC_CLK_TCK"),
        "arena_steps": _arena_steps(run / directory.METRICS),
    }


def _device_memory() -> float | None:
    """Reads the used memory of the first GPU, MB; None without a GPU."""
    if (command := shutil.which("nvidia-smi")) is None:
        return None
    words = [command, "--query-gpu=memory.used", "--format=csv,noheader,nounits", "--id=0"]
    return float(subprocess.run(words, capture_output=True, text=True, check=True).stdout)


def _arena_steps(metrics: Path) -> int:
    """Reads a run's arena steps from the last complete line of its metrics; 0 without a line."""
    if not metrics.exists():
        return 0
    with metrics.open("rb") as file:
        file.seek(max(0, metrics.stat().st_size - _TAIL))
        lines = file.read().splitlines(keepends=True)
    whole = [line for line in lines if line.endswith(b"\n")]
    return int(json.loads(whole[-1])["arena_steps"]) if whole else 0


def leg(settings: SoakConfig, words: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Trains for `settings.minutes`, appends samples to the file `SAMPLES` and yields them.

    Args:
      settings: Settings of the soak.
      words: `key=value` arguments for `swarmjax.train`.
    """
    folder = Path(settings.dir)
    folder.mkdir(parents=True, exist_ok=True)
    run, number = folder / "run", 1 + max((row["leg"] for row in read(folder)), default=0)
    words = [sys.executable, "-m", "swarmjax.train", f"run.dir={run}", "resume=auto", *words]
    with (folder / "said.txt").open("a") as said, (folder / SAMPLES).open("a") as file:
        process = subprocess.Popen(words, stdout=said, stderr=said)
        began = time.monotonic()
        while (seconds := time.monotonic() - began) < 60.0 * settings.minutes:
            time.sleep(EVERY_S)
            if process.poll() is not None:
                break
            known = {"leg": number, "seconds": seconds + EVERY_S, "commit": provenance.commit()}
            row = known | sample(process.pid, run)
            file.write(json.dumps(row) + "\n")
            file.flush()
            yield row
        process.terminate()
        code = process.wait()
    if code not in (0, REQUEUE):
        raise SystemExit(f"training ended with {code}: see {folder / 'said.txt'}.")


def read(folder: Path) -> list[dict[str, Any]]:
    """Reads the samples of all legs; returns an empty list before the first leg."""
    path = folder / SAMPLES
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def sum_up(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Computes the median and the slope of each quantity in one leg.

    Args:
      rows: Samples of the leg, in order.

    Returns:
      `median`, `slope`, `slope_low` and `slope_high` of each quantity. Slopes are in percent of
      the median per hour. A leg that made no progress in most samples has no speeds.
    """
    rows = rows[int(WARM_UP * len(rows)) :]
    hours = np.array([row["seconds"] for row in rows]) / 3600.0
    found = {
        name: _trend(hours, np.array([row[name] for row in rows]))
        for name in _LEVELS
        if name in rows[0]
    }
    steps = np.diff([row["arena_steps"] for row in rows])
    spent = (np.diff(hours) * 3600.0, np.diff([row["cpu_s"] for row in rows]))
    for name, seconds in zip(_SPEEDS, spent, strict=True):
        if np.median(steps) > 0:
            found[name] = _trend(hours[1:], steps / seconds)
    return found


def _trend(hours: np.ndarray, values: np.ndarray) -> dict[str, float]:
    middle = float(np.median(values))
    slope, _, low, high = map(float, stats.theilslopes(values, hours))
    percent = 100.0 / middle
    return {
        "median": middle,
        "slope": slope * percent,
        "slope_low": low * percent,
        "slope_high": high * percent,
    }


def table(folder: Path) -> dict[str, Any]:
    """Summarises all legs in one JSON line."""
    rows = read(folder)
    legs = {
        str(number): {
            "minutes": round(mine[-1]["seconds"] / 60.0, 1),
            "arena_steps": mine[-1]["arena_steps"],
            **sum_up(mine),
        }
        for number in sorted({row["leg"] for row in rows})
        if (mine := [row for row in rows if row["leg"] == number])
    }
    return {
        "benchmark": "soak",
        "legs": legs,
        "run": json.loads((folder / "run" / directory.SUMMARY).read_text())["device"],
        "commits": sorted({row["commit"] for row in rows}),
        "versions": provenance.versions(),
    }


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    settings, words = key_value.parse(SoakConfig, arguments)
    if settings.do == "table":
        sys.stdout.write(json.dumps(table(Path(settings.dir))) + "\n")
        return 0
    for _ in leg(settings, words):
        pass
    return 0


if __name__ == "__main__":
    sys.exit(command.run("soak", main, SoakConfig))
