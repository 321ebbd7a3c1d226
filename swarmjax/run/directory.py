"""Writes a run directory: one process at a time, complete files, and append-only logs.

- A lock keeps a second process out. The lock is released when the process that holds it dies.
- `config.json` and `summary.json` are replaced completely or not at all.
- Logs are files of JSON lines. Each checkpoint records the logs' lengths in bytes. A resumed run
  first truncates the logs to those lengths, in one step, and then appends.
- Each run has an id. The run's checkpoints store the id and a digest of the config's fixed keys.
"""

import contextlib
import errno
import fcntl
import hashlib
import itertools
import json
import os
import secrets
import socket
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from swarmjax.config import ConfigError
from swarmjax.outputs import replacing, unwritable
from swarmjax.run.errors import CheckpointError

CONFIG, SUMMARY, LOCK = "config.json", "summary.json", ".lock"
METRICS, DECISIONS, EPISODES = "metrics.jsonl", "curriculum.jsonl", "episodes.jsonl"
LOGS = (METRICS, DECISIONS, EPISODES)
# Keys of a stored config that may change when a run is resumed, as they affect no past results.
MAY_CHANGE = ("budget", "devices", "resume", "run", "streams")

Row = dict[str, Any]


def new_id() -> str:
    """Draws the id of a new run."""
    return secrets.token_hex(8)


@contextlib.contextmanager
def locked(run: Path, *, claimed: bool = False) -> Iterator[None]:
    """Keeps other processes out of a run directory, and makes it if it is missing.

    Args:
      run: the directory.
      claimed: whether `claim` has made the directory. Directories that were made for the run are
        removed if the run writes nothing.

    Raises:
      ConfigError: if another process is writing the directory, or this process cannot write it.
    """
    made = [path for path in (run, *run.parents) if not path.exists()]
    made = made or [run, run.parent] * claimed
    with contextlib.ExitStack() as held:
        try:
            run.mkdir(parents=True, exist_ok=True)
            _lock(run, held)
        except OSError as error:
            raise unwritable("run.dir", run, error) from None
        try:
            yield
        finally:
            _remove_empty(run, made)


def _remove_empty(run: Path, made: Iterable[Path]) -> None:
    """Removes the directories that were made for a run, if the run wrote nothing."""
    with contextlib.suppress(OSError):  # already removed, not empty, or owned by another user
        if made and os.listdir(run) == [LOCK]:
            (run / LOCK).unlink()
            for path in made:
                path.rmdir()


def _lock(run: Path, held: contextlib.ExitStack) -> None:
    """Locks a run directory, and writes into the lock file which process holds the lock."""
    file = held.enter_context((run / LOCK).open("a+"))
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not os.fstat(file.fileno()).st_nlink:  # its holder removed it before we locked it
            raise BlockingIOError
    except BlockingIOError:
        file.seek(0)
        holder = file.readline().strip() or "another process"
        raise ConfigError(
            f"run.dir is {run}, but {holder} is writing to it: wait for its end, or give another "
            "directory."
        ) from None
    with contextlib.suppress(OSError):  # on a full disk; the lock works without this text
        file.truncate(0)
        file.write(f"process {os.getpid()}\n{socket.gethostname()}\n")
        file.flush()


def claim(folder: Path, name: str) -> Path:
    """Makes a new directory that no other process gets, even one that asks for the same name.

    Args:
      folder: parent of the new directory; it is made if it is missing.
      name: name of the new directory. If this name is taken, -2, -3 and so on is added.

    Raises:
      OSError: if the directory cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    while True:
        with contextlib.suppress(FileExistsError):
            run = folder / next(names)
            run.mkdir()
            return run


def visible(run: Path) -> list[str]:
    """Lists the names in a directory, leaving out locks and temporary files of a killed start.

    Args:
      run: the directory; it need not exist.
    """
    try:
        return sorted(each.name for each in run.iterdir() if not each.name.startswith("."))
    except OSError:  # missing or unreadable: writing it raises an error later
        return []


def is_written(run: Path) -> bool | None:
    """Returns whether the process that last wrote a run directory still runs.

    This does not try to acquire the lock: that could keep out a run that begins at that moment.

    Returns:
      Whether the process still runs; None if it was started on another machine.
    """
    try:
        process, host = (run / LOCK).read_text().splitlines()
        if host != socket.gethostname():
            return None
        os.kill(int(process.removeprefix("process ")), 0)
    except PermissionError:  # the process belongs to another user
        return True
    except (OSError, ValueError, OverflowError):
        return False
    return True


def write_json(path: Path, found: Mapping[str, Any]) -> None:
    """Replaces a JSON file, completely or not at all.

    Raises:
      OSError: if the file cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(found, indent=2) + "\n")


def has_ended(summary: Mapping[str, Any]) -> bool:
    """Returns whether a summary says that its run ended, by its budget or by `run.stop_at`."""
    return summary.get("budget_spent") is True or summary.get("stopped_at") is not None


def kept_config(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Makes the `config.json` of a resumed run.

    Args:
      before: the stored config.
      now: the config with which the run goes on.

    Returns:
      `before`, with the keys of `MAY_CHANGE` taken from `now`. So the digest still matches the
      checkpoints.
    """
    return {**before, **{key: now[key] for key in MAY_CHANGE if key in now}}


def config_digest(stored: Mapping[str, Any]) -> str:
    """Returns the SHA-256 of a stored config's fixed keys, in hexadecimal."""
    fixed = {key: value for key, value in stored.items() if key not in MAY_CHANGE}
    return hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()


class Log:
    """An append-only file of JSON lines."""

    def __init__(self, path: Path) -> None:
        """Opens the file, and makes it if it is missing."""
        # Unbuffered: on a full disk, `close` would fail again on rows that are left in a buffer.
        self._file = path.open("ab", buffering=0)

    def write(self, rows: Iterable[Row]) -> None:
        """Appends rows, and passes them to the operating system.

        Raises:
          OSError: if the disk is full.
        """
        lines = "".join(json.dumps(row) + "\n" for row in rows).encode()
        if self._file.write(lines) != len(lines):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def sync(self) -> int:
        """Flushes all rows to disk, and returns the length of the file, bytes."""
        os.fsync(self._file.fileno())
        return self._file.tell()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def __enter__(self) -> "Log":
        """Returns itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Closes the file."""
        self.close()


def cut(path: Path, length: int) -> None:
    """Truncates a log to the length that a checkpoint recorded.

    Args:
      path: the log.
      length: length in bytes, at the end of a line.

    Raises:
      CheckpointError: if the log is shorter than `length`, or no line ends at this length.
    """
    if not path.exists():
        return
    with path.open("rb+") as file:
        found = file.seek(0, os.SEEK_END)
        file.seek(max(0, length - 1))
        if found < length or (length and file.read(1) != b"\n"):
            raise CheckpointError(
                f"{path} has {found} bytes, but its checkpoint recorded {length} bytes of complete "
                "lines: restore the file, or delete it to continue without its rows."
            )
        file.truncate(length)


def read_rows(path: Path, length: int | None) -> list[Row]:
    """Reads the rows of a log.

    Args:
      path: the log. A missing log has no rows.
      length: number of bytes to read; None for the whole log.

    Raises:
      CheckpointError: if the log is damaged.
    """
    if not path.exists():
        return []
    with path.open("rb") as file:
        lines = file.read(-1 if length is None else length).splitlines()
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            row = None
        if not isinstance(row, dict):
            raise CheckpointError(
                f"{path} is damaged at line {number}: restore the file, or delete it to continue "
                "without its rows."
            )
        rows.append(row)
    return rows
