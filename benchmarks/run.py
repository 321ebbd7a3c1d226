"""Runs suites of benchmarks, and resumes runs that were cut off.

`python -m benchmarks.run suite=peers out=FILE.jsonl` runs each entry of the suite (`suites.yaml`)
in its own process. It appends each JSON line to `out` as soon as the process prints the line, with
the entry's name. Measurements that have a result in `out` are not repeated, but failed and skipped
measurements are repeated. If a process dies, or prints nothing for longer than its entry allows,
its current measurement is recorded as `failed` and the suite continues.
"""

import json
import math
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

import yaml

from benchmarks import lines
from benchmarks.lines import Line, Output
from swarmjax import command
from swarmjax.config import ConfigError, Section, about

_GRACE = 10.0  # s; a process that has not ended by itself after this time is killed
_LISTED = yaml.safe_load((Path(__file__).parent / "suites.yaml").read_text())


@dataclass(frozen=True, kw_only=True)
class SuiteEntry:
    """One benchmark with its settings.

    Attributes:
      name: name of the entry, which its lines also have.
      run: the module in benchmarks/ and its `key=value` words.
      over: key whose several values are measured one by one.
      values: the values of `over`; each line has one of them.
      seconds: time limit, s; a process that prints nothing for this long is ended.
      environment: environment variables of the process.
    """

    name: str
    run: str
    over: str | None = None
    values: Sequence[int] = ()
    seconds: float = 300.0
    environment: dict[str, str] = field(default_factory=dict)


ENTRIES = {name: SuiteEntry(name=name, **entry) for name, entry in _LISTED["entries"].items()}
SUITES = {suite: [ENTRIES[name] for name in names] for suite, names in _LISTED["suites"].items()}


@dataclass(frozen=True, kw_only=True)
class SuiteRunConfig(Section):
    """Settings: what to run, and where the results go."""

    suite: str = field(metadata=about(f"which benchmarks: {', '.join(SUITES)}"))
    only: tuple[str, ...] = field(
        default=(), metadata=about("entries of the suite, by name; []: all of them")
    )
    out: str = field(metadata=about("file for JSON lines, which are appended"))
    minutes: float | None = field(
        default=None, metadata=about("starts no entry after this time; null: no limit", above=0.0)
    )

    def _check(self) -> None:
        if self.suite not in SUITES:
            raise ConfigError(f"suite is '{self.suite}': give one of {', '.join(SUITES)}.")
        names = [entry.name for entry in SUITES[self.suite]]
        for name in self.only:
            if name not in names:
                raise ConfigError(f"only holds '{name}': give any of {', '.join(names)}.")


# Remaining work


def entries(config: SuiteRunConfig) -> list[SuiteEntry]:
    """Returns the chosen entries, in the order of their suite."""
    return [entry for entry in SUITES[config.suite] if entry.name in config.only or not config.only]


def left(entry: SuiteEntry, done: Sequence[Line]) -> list[int | None]:
    """Returns the values of an entry that have no result yet.

    Args:
      entry: entry of a suite.
      done: lines of `out`.

    Returns:
      The values that are missing, or that failed or were skipped when last tried. An entry without
      values counts as one value, None.
    """
    values = entry.values or (None,)
    return [value for value in values if not _is_done(entry, value, done)]


def _is_done(entry: SuiteEntry, value: int | None, done: Sequence[Line]) -> bool:
    """Tells whether the newest line of an entry and value is a result."""
    mine = [line for line in done if _is_of(entry, value, line)]
    return bool(mine) and not {"failed", "skipped"} & mine[-1].keys()


def _is_of(entry: SuiteEntry, value: int | None, line: Line) -> bool:
    if line.get("entry") != entry.name:
        return False
    return entry.over is None or line.get(entry.over) == value


def command_line(entry: SuiteEntry, values: Sequence[int | None]) -> list[str]:
    """Returns the command of a process that measures some values of an entry."""
    module, *words = entry.run.split()
    if entry.over is not None:
        words.append(f"{entry.over}={','.join(str(value) for value in values)}")
    return [sys.executable, "-m", f"benchmarks.{module}", *words]


# Running


def run_entry(entry: SuiteEntry, output: Output, deadline: float) -> None:
    """Runs the remaining values of an entry, in as many processes as needed.

    If a process dies or is ended, the value that it was measuring is recorded as failed. The next
    process continues with the value after the failed value.

    Args:
      entry: entry of a suite.
      output: the file that the lines are added to.
      deadline: time of `time.monotonic` at which the run ends. A process that still runs then is
        ended, but its value is not recorded as failed.
    """
    waiting = left(entry, output.lines)
    while waiting:
        process, first = Process(entry, waiting), len(output.lines)
        for line in process.lines(deadline):
            output.add({**line, "entry": entry.name})
        new = output.lines[first:]
        if process.late or any("skipped" in line for line in new):
            return
        untried = [value for value in waiting if not any(_is_of(entry, value, x) for x in new)]
        if untried:
            output.add(_failed(entry, untried[0], process.reason))
        waiting = untried[1:]


def _failed(entry: SuiteEntry, value: int | None, reason: str) -> Line:
    """Makes the JSON line that records a value as failed."""
    line = {"benchmark": entry.run.split()[0], "entry": entry.name, "failed": reason}
    return line if entry.over is None else {**line, entry.over: value}


class Process:
    """A benchmark in its own process.

    Attributes:
      reason: why the process ended without a result; valid once its lines have been read.
      late: whether the process was ended because the time of the whole run was up.
    """

    def __init__(self, entry: SuiteEntry, values: Sequence[int | None]) -> None:
        """Starts the process."""
        self.reason, self.late, self._closed = "", False, False
        self._limit = entry.seconds
        self._errors = tempfile.TemporaryFile("w+")  # noqa: SIM115  # `_end` closes it
        self._process = subprocess.Popen(
            command_line(entry, values),
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=os.environ | entry.environment,
            start_new_session=True,
        )
        self._queue: queue.Queue[str | None] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as output:
            for text in output:
                self._queue.put(text)
        self._queue.put(None)

    def lines(self, deadline: float) -> Iterator[Line]:
        """Yields the JSON lines of the process as it prints them, and ignores all other output.

        Args:
          deadline: time of `time.monotonic` at which the process is ended.

        Yields:
          The lines.
        """
        try:
            while (text := self._next(deadline)) is not None:
                if text.startswith("{"):
                    yield json.loads(text)
        finally:
            self._end()

    def _next(self, deadline: float) -> str | None:
        """Returns the next output line; None at the end, after silence, or at the deadline."""
        left = deadline - time.monotonic()
        try:
            text = self._queue.get(timeout=max(0.0, min(self._limit, left)))
            self._closed = text is None
            return text
        except queue.Empty:
            self.late = left <= self._limit
            self.reason = f"printed nothing for {self._limit:g} s"
            return None

    def _end(self) -> None:
        """Ends the process and its children if needed, and waits until the process has ended."""
        if not self._closed:
            os.killpg(self._process.pid, signal.SIGTERM)
        try:
            self._process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self._reader.join()
        self.reason = self.reason or self._last_words()
        self._errors.close()

    def _last_words(self) -> str:
        """Returns the exit code of the process and the last line of its standard error."""
        self._errors.seek(0)
        words = [line.strip() for line in self._errors if line.strip()]
        return f"exit code {self._process.returncode}: {words[-1][:300] if words else 'silent'}"


def run_suite(config: SuiteRunConfig, say: TextIO) -> None:
    """Runs all entries of the suite, and reports on each entry.

    Args:
      config: which entries to run, and for how long.
      say: the stream for a report on each entry.
    """
    output = Output(Path(config.out))
    deadline = math.inf if config.minutes is None else time.monotonic() + 60.0 * config.minutes
    for entry in entries(config):
        began, first = time.monotonic(), len(output.lines)
        if time.monotonic() < deadline:
            run_entry(entry, output, deadline)
        seconds, missing = time.monotonic() - began, len(left(entry, output.lines))
        new = output.lines[first:]
        say.write(
            f"{entry.name}: {len(new)} lines in {seconds:.0f} s"
            f"{f', {missing} of {len(entry.values) or 1} without a result' if missing else ''}\n"
        )
        for line in new:
            for why in ("skipped", "failed"):
                if why in line:
                    say.write(f"  {why}: {line[why]}\n")
        say.flush()


def main(arguments: Sequence[str]) -> int:
    """Runs the command; returns its exit code."""
    run_suite(lines.load(SuiteRunConfig, arguments), sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(command.run("run", main, SuiteRunConfig))
