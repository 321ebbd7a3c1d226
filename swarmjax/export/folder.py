"""Writes exported files and folders completely or not at all.

A file replaces an older file at its path in one move. A folder has a manifest, `export.json`, with
the SHA-256 of each of its files. A new export replaces a folder only if it holds exactly the listed
files, unchanged. Any other folder is left alone and raises an error.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from swarmjax import outputs
from swarmjax.config import ConfigError, reading
from swarmjax.outputs import replacing

MANIFEST = "export.json"
BUILT = ("__pycache__", "build")  # made by using an export; may be replaced


def write_file(path: Path, content: bytes) -> None:
    """Writes a file and replaces any older file at its path.

    Args:
      path: path of the file; missing folders are created.
      content: the whole content.

    Raises:
      ConfigError: if the file cannot be written.
    """
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(content)
        outputs.note([path])
    except OSError as error:
        raise outputs.unwritable("out", path, error) from None


def write_folder(path: Path, files: Mapping[str, bytes]) -> None:
    """Writes a folder; replaces an older export there if it is unchanged.

    Args:
      path: path of the folder.
      files: content of each file, by name.

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
        raise outputs.unwritable("out", path, error) from None


def check_folder(path: Path) -> None:
    """Checks that a folder holds only an unchanged export, so that it can be replaced.

    Args:
      path: path of the folder; it need not exist.

    Raises:
      ConfigError: if something in the folder would be lost.
    """
    try:
        if not path.exists() or (path.is_dir() and not any(path.iterdir())):
            return
        if not path.is_dir():
            raise ConfigError(f"out is {path}, a file: give a folder.")
        strange = _strange(path)
    except OSError as error:
        raise outputs.unwritable("out", path, error) from None
    if strange:
        raise ConfigError(
            f"out is {path}, where {strange} is not from an export or was changed since: give "
            f"another folder, or move {strange} away."
        )


def _strange(path: Path) -> str | None:
    """Names a file in the folder that does not match the manifest."""
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
