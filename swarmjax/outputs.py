"""Writes files completely or not at all, and replaces none that a command did not write.

A command that writes a file notes its digest in `.swarmjax.json` of the same folder. Later it
replaces the file only if the digest still matches, or if it is told to overwrite.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from swarmjax.config import ConfigError, about, reading

NOTES = ".swarmjax.json"
# Metadata of the key `overwrite`, which all commands with outputs have.
OVERWRITE = about("replace files that this command did not write, or that were changed since")


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
    # In the same folder, so that the move stays within one file system and is atomic.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def check(key: str, paths: Iterable[Path], *, overwrite: bool) -> None:
    """Refuses to replace files that a command did not write, before the command does its work.

    Args:
      key: the key that names the files, for the message.
      paths: the files that the command will write.
      overwrite: whether the user allows it.

    Raises:
      ConfigError: if there is a file that was not written by a command, or was changed since.
    """
    for path in paths:
        if not overwrite and path.exists() and _digest(path) != _notes(path.parent).get(path.name):
            raise ConfigError(
                f"{key} is {reading.called(path)}, which swarmjax did not write or which was "
                "changed since: give another name, or overwrite=true."
            )


def make_room(key: str, path: Path, folder: Path | None = None) -> None:
    """Makes the folder of an output before the command does its work, so that no result is lost.

    Args:
      key: the key that names the output, for the message.
      path: the file; or the folder, if there are several files.
      folder: the folder of the files; None: that of the file.

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
      key: the key that names it.
      path: the file or folder.
      reason: why.
    """
    if isinstance(reason, OSError):
        reason = reason.strerror or str(reason)
    return ConfigError(f"{key} is {path}, which cannot be written: {reason}.")


def note(paths: Iterable[Path]) -> None:
    """Notes the digests of files that a command has written, so that it may replace them later.

    Args:
      paths: the files.

    Raises:
      OSError: if the notes cannot be written.
    """
    for path in paths:
        found = _notes(path.parent) | {path.name: _digest(path)}
        with replacing(path.parent / NOTES) as temporary:
            temporary.write_text(json.dumps(found, indent=2, sort_keys=True) + "\n")


def write(files: Mapping[Path, bytes]) -> None:
    """Writes the files that the key `out` names, each completely or not at all, and notes them.

    Args:
      files: contents by path; missing folders are made.

    Raises:
      ConfigError: if a file cannot be written.
    """
    for path, content in files.items():
        try:
            with replacing(path) as temporary:
                temporary.write_bytes(content)
            note([path])
        except OSError as error:
            raise unwritable("out", path, error) from None


def _digest(path: Path) -> str | None:
    """Returns the SHA-256 of a file, in hexadecimal; None if it is no file."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _notes(folder: Path) -> dict[str, str | None]:
    """Reads the digests that were noted in a folder; none if it has no sound notes."""
    try:
        found = reading.read_json(folder / NOTES)
    except ConfigError:
        return {}
    return found if isinstance(found, dict) else {}
