"""Writes files completely or not at all."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from swarmjax.config import ConfigError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary path to write to, and moves it to `path` if no error occurs.

    Args:
      path: path of the file. Missing folders are made.

    Yields:
      A temporary path with the same extension.

    Raises:
      OSError: if the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # The temporary file is in the same folder, so that the move stays within one file system and is
    # atomic.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def make_room(key: str, path: Path, folder: Path | None = None) -> None:
    """Makes the folder of an output before the command does its work, so that no result is lost.

    Args:
      key: the key that names the output, for the message.
      path: the file, or the folder if the output has several files.
      folder: the folder of several files. None for a single file, whose folder is then made.

    Raises:
      ConfigError: if nothing can be written there.
    """
    try:
        (folder or path.parent).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(key, path, error) from None
    if folder is None and path.is_dir():
        raise unwritable(key, path, "it is a folder")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise unwritable(key, path, "permission denied")


def unwritable(key: str, path: Path, reason: OSError | str) -> ConfigError:
    """Makes the error for an output that cannot be written.

    Args:
      key: the key that names the output.
      path: the file or folder.
      reason: why it cannot be written.
    """
    if isinstance(reason, OSError):
        reason = reason.strerror or str(reason)
    return ConfigError(f"{key} is {path}, which cannot be written: {reason}.")


def write(files: Mapping[Path, bytes]) -> None:
    """Writes the files that the key `out` names, each completely or not at all.

    Args:
      files: contents by path; missing folders are made.

    Raises:
      ConfigError: if a file cannot be written.
    """
    for path, content in files.items():
        try:
            with replacing(path) as temporary:
                temporary.write_bytes(content)
        except OSError as error:
            raise unwritable("out", path, error) from None
