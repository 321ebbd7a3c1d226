"""Runs suites of benchmarks, continues where a run was cut off, and writes docs/benchmarks.md.

`python -m benchmarks.run suite=peers out=FILE.jsonl` runs each entry of the suite
(`benchmarks.suites`) in its own process. It appends the entry's JSON lines to `out` as they come,
with the entry's name. Results that `out` already has are not run again; failures are. If a process
dies, or prints nothing for longer than its entry allows, it is recorded as `failed` and the other
entries continue.

`python -m benchmarks.run table=FILE.jsonl docs=docs` only writes the tables and plots of that file
into docs/benchmarks.md. With `suite` and `docs` this is done at the end.
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
from typing import Any, TextIO

from benchmarks import key_value, run_page
from benchmarks.suites import SUITES, SuiteEntry
from swarmjax import command
from swarmjax.config import ConfigError, Section, about

Line = dict[str, Any]
_GRACE = 10.0  # s; a process has this time to end by itself


@dataclass(frozen=True, kw_only=True)
class SuiteRunConfig(Section):
    """Settings: what to run, and where the results go."""

    suite: str | None = field(
        default=None, metadata=about(f"which benchmarks: {', '.join(SUITES)}")
    )
    only: tuple[str, ...] = field(
        default=(), metadata=about("entries of the suite, by name; []: all of them")
    )
    out: str | None = field(default=None, metadata=about("file for JSON lines, which are appended"))
    minutes: float | None = field(
        default=None, metadata=about("starts no entry after this time; null: no limit", above=0.0)
    )
    table: str | None = field(
        default=None, metadata=about("file of JSON lines for the page; null: out")
    )
    docs: str | None = field(default=None, metadata=about(f"folder of {run_page.PAGE}"))

    def _check(self) -> None:
        if self.suite is not None and self.suite not in SUITES:
            raise ConfigError(f"suite is '{self.suite}': give one of {', '.join(SUITES)}.")
        names = [entry.name for entry in SUITES.get(self.suite or "", ())]
        for name in self.only:
            if name not in names:
                raise ConfigError(f"only holds '{name}': give any of {', '.join(names)}.")
        if self.suite is None and (self.table is None or self.docs is None):
            raise ConfigError("suite is null: give suite=NAME, or table=FILE.jsonl and docs=DIR.")
        if self.suite is not None and self.out is None:
            raise ConfigError("out is null: give out=FILE.jsonl for the results of the suite.")
        if self.table is not None and self.docs is None:
            raise ConfigError("docs is null: give the folder of the page with table.")


# Remaining work


def entries(config: SuiteRunConfig) -> list[SuiteEntry]:
    """Returns the chosen entries, in the order of their suite."""
    if config.suite is None:
        return []
    return [entry for entry in SUITES[config.suite] if entry.name in config.only or not config.only]


def left(entry: SuiteEntry, lines: Sequence[Line]) -> list[str | None]:
    """Returns the values of an entry that have no result yet.

    Args:
      entry: entry of a suite.
      lines: lines of `out`.

    Returns:
      The values that are missing, or that failed or were skipped when last tried. An entry without
      values counts as one value, None.
    """
    values = entry.values or (None,)
    return [value for value in values if not _is_done(entry, value, lines)]


def _is_done(entry: SuiteEntry, value: str | None, lines: Sequence[Line]) -> bool:
    """Tells whether the newest line of an entry and value is a result."""
    mine = [line for line in lines if _is_of(entry, value, line)]
    return bool(mine) and not {"failed", "skipped"} & mine[-1].keys()


def _is_of(entry: SuiteEntry, value: str | None, line: Line) -> bool:
    if line.get("entry") != entry.name:
        return False
    return entry.over is None or str(line.get(entry.over)) == value


def command_line(entry: SuiteEntry, values: Sequence[str | None]) -> list[str]:
    """Returns the command of a process that measures some values of an entry."""
    words = [*entry.words]
    if entry.over is not None:
        words.append(f"{entry.over}={','.join(str(value) for value in values)}")
    return [sys.executable, "-m", f"benchmarks.{entry.module}", *words]


# Running


class Output:
    """The file of JSON lines that a suite adds to."""

    def __init__(self, path: Path) -> None:
        """Reads the existing lines.

        Raises:
          ConfigError: if the file cannot be read or written.
        """
        self.lines, self._path = read(path) if path.exists() else [], path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        except OSError as error:
            raise ConfigError(
                f"out is {path}, which cannot be written: {error.strerror}."
            ) from None

    def add(self, line: Line) -> None:
        """Writes a line to the file at once."""
        self.lines.append(line)
        with self._path.open("a") as file:
            file.write(json.dumps(line) + "\n")


def read(path: Path) -> list[Line]:
    """Reads JSON lines.

    Args:
      path: path of the file; a last line that was cut off is skipped.

    Returns:
      The lines.

    Raises:
      ConfigError: if there is no such file, or a line is damaged.
    """
    try:
        text = path.read_text()
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}.") from None
    found = []
    for number, line in enumerate(text.split("\n")[:-1], 1):
        try:
            found.append(json.loads(line))
        except ValueError:
            raise ConfigError(f"{path} in line {number} is not JSON: remove it.") from None
    return found


def run_entry(entry: SuiteEntry, output: Output, deadline: float) -> None:
    """Runs the remaining values of an entry, in as many processes as needed.

    If a process dies or is ended, the value that it was measuring is recorded as failed. The next
    process takes the values after it.

    Args:
      entry: entry of a suite.
      output: gets the lines.
      deadline: time by `time.monotonic`. The process that runs at this time is ended, but its value
        is not recorded as failed.
    """
    waiting = left(entry, output.lines)
    while waiting:
        values = waiting[: entry.each or len(waiting)]
        rest = waiting[len(values) :]
        process, first = Process(entry, values), len(output.lines)
        for line in process.lines(deadline):
            output.add({**line, "entry": entry.name})
        new = output.lines[first:]
        if process.late or any("skipped" in line for line in new):
            return
        untried = [value for value in values if not any(_is_of(entry, value, x) for x in new)]
        if untried:
            output.add(_failed(entry, untried[0], process.reason))
        waiting = [*untried[1:], *rest]


def _failed(entry: SuiteEntry, value: str | None, reason: str) -> Line:
    """Makes the line of a value that has no result."""
    line = {"benchmark": entry.module, "entry": entry.name, "failed": reason}
    return line if entry.over is None else {**line, entry.over: value}


class Process:
    """A benchmark in its own process.

    Attributes:
      reason: why it ended without a result; valid once its lines have been read.
      late: whether it was ended because the time of the whole run was over.
    """

    def __init__(self, entry: SuiteEntry, values: Sequence[str | None]) -> None:
        """Starts it."""
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
        """Yields its JSON lines as they come, and ignores all other output.

        Args:
          deadline: time by `time.monotonic` when the process is ended.

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
        """Returns the next line of output; None at its end, or when the time is over."""
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
        """Ends the process and its children, unless it ends by itself."""
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
        """Returns its exit code, and the last line of its errors."""
        self._errors.seek(0)
        words = [line.strip() for line in self._errors if line.strip()]
        return f"exit code {self._process.returncode}: {words[-1][:300] if words else 'silent'}"


def run_suite(config: SuiteRunConfig, say: TextIO) -> None:
    """Runs all entries, and reports each.

    Args:
      config: which entries to run, and for how long.
      say: gets one sentence per entry.
    """
    output = Output(Path(config.out or ""))
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
    config = key_value.load(SuiteRunConfig, arguments)
    if config.suite is not None:
        run_suite(config, sys.stderr)
    if config.docs is not None:
        source = Path(config.table or config.out or "")
        run_page.write(Path(config.docs), read(source), source)
    return 0


if __name__ == "__main__":
    sys.exit(command.run("run", main, SuiteRunConfig))
