"""How a run directory is written: one process at a time, whole files, and logs that only grow.

- A lock that dies with its process keeps a second one out.
- `config.json` and `summary.json` are replaced whole or not at all.
- Logs (JSON lines) are appended to. A checkpoint counts their bytes; a run that goes on cuts them
  to that length, in one step, before it adds to them.
- A run has an id. Its checkpoints hold it, with a digest of what its config fixes.
"""

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import secrets
import socket
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple

from swarmjax.atomic_file import replacing
from swarmjax.config import ConfigError
from swarmjax.run.errors import CheckpointError

CONFIG, SUMMARY, LOCK = "config.json", "summary.json", ".lock"
METRICS, DECISIONS, EPISODES = "metrics.jsonl", "curriculum.jsonl", "episodes.jsonl"
LOGS = (METRICS, DECISIONS, EPISODES)
SAVED = "checkpoints.jsonl"  # a row for each checkpoint that was written, of those removed too
# Keys of a stored config that may change when its run goes on: they fix nothing that was computed.
MAY_CHANGE = ("budget", "devices", "resume", "run", "streams")

Row = dict[str, Any]


def new_id() -> str:
    """Draws the id of a new run."""
    return secrets.token_hex(8)


@contextlib.contextmanager
def locked(run: Path) -> Iterator[None]:
    """Keeps other processes out of a run directory, which is made if it is missing.

    Args:
      run: The directory.

    Raises:
      ConfigError: If another process writes it, or it cannot be written.
    """
    made = _make(run)
    with contextlib.ExitStack() as held:
        while True:
            file = held.enter_context(_open_lock(run))
            _lock(run, file)
            # Another process may have removed the file between opening and locking.
            if _is_same(file, run / LOCK):
                break
        _sign(file)
        try:
            yield
        finally:
            _remove_empty(run, made)


def _open_lock(run: Path) -> IO[str]:
    try:
        return (run / LOCK).open("a+")
    except OSError as error:
        raise unwritable(run, error) from None


def _lock(run: Path, file: IO[str]) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        holder = file.readline().strip() or "another process"
        raise ConfigError(
            f"run.dir is {run}, which {holder} is writing: wait for its end, or give another "
            "directory."
        ) from None
    except OSError as error:  # a file system without locks
        raise unwritable(run, error) from None


def _is_same(file: IO[str], path: Path) -> bool:
    """Tells whether an open file is the one that a path names."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False


class Writer(NamedTuple):
    """The process that wrote a run directory last.

    Attributes:
      process: its number there.
      host: its machine; this one where the lock, of an older version, does not say.
    """

    process: int
    host: str

    @property
    def is_here(self) -> bool:
        """Whether it ran on this machine."""
        return self.host == socket.gethostname()


def writer(run: Path) -> Writer | None:
    """Reads who holds or held the lock of a run directory, which is left alone; None if unknown."""
    try:
        process, *host = (run / LOCK).read_text().splitlines()
        return Writer(int(process.removeprefix("process ")), (*host, socket.gethostname())[0])
    except (OSError, ValueError, IndexError):
        return None


def is_writing(found: Writer) -> bool:
    """Tells whether a process of this machine is still there.

    Where Linux lists locks, it has to hold one: its number may be another's by now. Trying the lock
    would keep a run out that begins in the same moment.
    """
    try:
        lines = Path("/proc/locks").read_text().splitlines()
        return any(line.split()[1:5:3] == ["FLOCK", str(found.process)] for line in lines)
    except OSError:
        pass
    try:
        os.kill(found.process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # of somebody else's
        return True
    return True


def _make(run: Path) -> list[Path]:
    """Makes a directory; returns what had to be made, the innermost first."""
    missing = [path for path in (run, *run.parents) if not path.exists()]
    try:
        run.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise unwritable(run, error) from None
    return missing


def _sign(file: IO[str]) -> None:
    """Writes down who holds the lock, for the sentence that refuses the next one."""
    try:
        file.truncate(0)
        file.write(f"process {os.getpid()}\n{socket.gethostname()}\n")
        file.flush()
    except OSError:  # a full disk: the lock holds without a name
        pass


def _remove_empty(run: Path, made: list[Path]) -> None:
    """Removes the directories that were made for a run which then wrote nothing."""
    try:
        if made and os.listdir(run) == [LOCK]:
            (run / LOCK).unlink()
            for path in made:
                path.rmdir()
    except OSError:  # gone, or somebody else's by now
        pass


def check_regular(run: Path) -> None:
    """Refuses a run directory that holds a pipe or a device, which would be waited for.

    Raises:
      ConfigError: If it does.
    """
    try:
        found = [path for path in run.iterdir() if not (path.is_file() or path.is_dir())]
    except OSError:  # missing, or to be refused where it is read
        return
    odd = [path for path in found if path.exists()]  # a link to nothing is no danger
    if odd:
        raise ConfigError(f"{odd[0]} is neither a file nor a folder: remove it.")


def unwritable(run: Path, error: OSError | ValueError) -> ConfigError:
    """Says why a run directory cannot be written."""
    reason = getattr(error, "strerror", None) or error
    return ConfigError(f"run.dir is {run}, which cannot be written: {reason}.")


def write_json(path: Path, found: Mapping[str, Any]) -> None:
    """Replaces a file of JSON, whole or not at all.

    Raises:
      OSError: If it cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(found, indent=2) + "\n")


def kept_config(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """Makes the config that a run which goes on writes.

    Args:
      before: What its `config.json` holds, which any version may have written.
      now: The config that it goes on with.

    Returns:
      `before` with what may change as it is now, so that the digest stays that of the checkpoints.
    """
    return {**before, **{key: now[key] for key in MAY_CHANGE if key in now}}


def config_digest(stored: Mapping[str, Any]) -> str:
    """Returns the SHA-256 of what a stored config fixes, in hexadecimal."""
    fixed = {key: value for key, value in stored.items() if key not in MAY_CHANGE}
    return hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()


class Log:
    """A file of JSON lines that is appended to."""

    def __init__(self, path: Path) -> None:
        """Opens the file, which is made if it is missing."""
        # Without a buffer, which a full disk would leave for `close` to fail on once more.
        self._file = path.open("ab", buffering=0)

    def write(self, rows: Iterable[Row]) -> None:
        """Appends rows, and hands them to the system.

        Raises:
          OSError: If the disk has no room for them.
        """
        lines = "".join(json.dumps(row) + "\n" for row in rows).encode()
        if self._file.write(lines) != len(lines):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def sync(self) -> int:
        """Makes sure that the disk has all rows; returns the length of the file, bytes."""
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
    """Cuts a log to the length that a checkpoint counts.

    Args:
      path: Of the log.
      length: In bytes, at the end of a line.

    Raises:
      CheckpointError: If the log is shorter, or no line ends there.
    """
    if not path.exists():
        return
    with path.open("rb+") as file:
        found = file.seek(0, os.SEEK_END)
        file.seek(max(0, length - 1))
        if found < length or (length and file.read(1) != b"\n"):
            raise CheckpointError(
                f"{path} has {found} bytes, and not the {length} with whole lines that its "
                "checkpoint counts: put the file back, or delete it to go on without its rows."
            )
        file.truncate(length)


def bring(source: Path, run: Path, logs: Mapping[str, int]) -> None:
    """Copies the logs of a run that goes on in another directory.

    Args:
      source: The directory of the run.
      run: The other one; the logs of a run that has begun there are left as they are.
      logs: Bytes of each log that belong to the run, by name; without them all are copied.
    """
    if (run / CONFIG).exists():
        return
    for name in LOGS:
        if (source / name).exists():
            found = (source / name).read_bytes()
            with replacing(run / name) as temporary:
                temporary.write_bytes(found[: logs.get(name, 0)] if logs else found)


def cut_rows(path: Path, update: int) -> None:
    """Drops the rows of `update` and after, where a checkpoint of an older version counts none."""
    if path.exists():
        rows = [row for row in read_rows(path, None, whole=False) if is_before(row, update)]
        with replacing(path) as temporary:
            temporary.write_text("".join(json.dumps(row) + "\n" for row in rows))


def is_before(row: Row, update: int) -> bool:
    """Tells whether a row is of an update before this one."""
    found = row.get("update")
    return isinstance(found, int) and found < update


def read_rows(path: Path, length: int | None, *, whole: bool = True) -> list[Row]:
    """Reads the rows of a log.

    Args:
      path: Of the log; none if it is missing.
      length: Bytes that are read; None for all.
      whole: Whether a line that is no row is an error. If not, it is left out.

    Raises:
      CheckpointError: If the log is damaged.
    """
    if not path.exists():
        return []
    with path.open("rb") as file:
        lines = file.read(-1 if length is None else length).splitlines()
    found = [_parsed(line) for line in lines]
    if whole and None in found:
        raise CheckpointError(
            f"{path} is damaged at line {found.index(None) + 1}: put the file back, or delete it "
            "to go on without its rows."
        )
    return [row for row in found if row is not None]


def _parsed(line: bytes) -> Row | None:
    """Reads a row; None if the line is none."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) else None
