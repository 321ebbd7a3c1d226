"""Writes what is exported, whole or not at all.

A file takes the place of the one before it, whatever that was, in one move. A folder never goes
over what somebody else has made: it has a manifest, `export.json`,
with the SHA-256 of each of its files: one that holds nothing but what it lists, unchanged, can be
exported again, and is replaced; any other is refused.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from swarmjax.atomic_file import replacing
from swarmjax.config import ConfigError, reading

MANIFEST = "export.json"
BUILT = ("__pycache__", "build")  # folders that using an export makes, and using it again would


def write_file(path: Path, content: bytes) -> None:
    """Writes a file in the place of the one before it, whatever that was.

    Args:
        path: of the file; folders that are missing are made.
        content: all of it.

    Raises:
        ConfigError: if it cannot be written.
    """
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise _unwritable(path, error) from None


def write_folder(path: Path, files: Mapping[str, bytes]) -> None:
    """Writes a folder, in the place of an export that nobody has changed.

    Args:
        path: of the folder.
        files: content of each, by name.

    Raises:
        ConfigError: if the folder holds anything else, or cannot be written.
    """
    check_folder(path)
    digests = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    manifest = json.dumps(digests, indent=2, sort_keys=True) + "\n"
    new, old = (path.with_name(f".{path.name}.{os.getpid()}.{what}") for what in ("new", "old"))
    try:
        new.mkdir(parents=True)
        try:
            for name, content in [*files.items(), (MANIFEST, manifest.encode())]:
                (new / name).write_bytes(content)
            if path.exists():
                path.rename(old)
            new.rename(path)
        finally:
            if old.exists() and not path.exists():
                old.rename(path)
            for left in (new, old):
                shutil.rmtree(left, ignore_errors=True)
    except OSError as error:
        raise _unwritable(path, error) from None


def check_folder(path: Path) -> None:
    """Refuses to replace a folder that holds more than an unchanged export.

    Args:
        path: of the folder, which need not exist.

    Raises:
        ConfigError: if something in it would be lost.
    """
    try:
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            return
        if not path.is_dir():
            raise ConfigError(f"out is {path}, a file: give a folder.")
        strange = _strange(path)
    except OSError as error:
        raise _unwritable(path, error) from None
    if strange:
        raise ConfigError(
            f"out is {path}, where {strange} is not as an export left it: give another folder, "
            "or move it away."
        )


def _strange(path: Path) -> str | None:
    """Names something in a folder that its manifest does not vouch for."""
    try:
        listed = reading.read_json(path / MANIFEST)
    except ConfigError:
        listed = None
    if not isinstance(listed, dict):
        return min(found.name for found in path.iterdir())
    for found in sorted(path.iterdir()):
        if found.name == MANIFEST or (found.name in BUILT and found.is_dir()):
            continue
        whole = found.is_file() and not found.is_symlink()
        if not whole or hashlib.sha256(found.read_bytes()).hexdigest() != listed.get(found.name):
            return found.name
    return None


def _unwritable(path: Path, error: OSError) -> ConfigError:
    return ConfigError(f"out is {path}, which cannot be written: {error.strerror or error}.")
