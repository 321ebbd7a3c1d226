"""Files that are replaced whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Gives a place to write to, and moves what was written to `path` unless something failed.

    Args:
      path: Of the file; folders that are missing are made.

    Yields:
      Another path with the same ending.

    Raises:
      OSError: If it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # Beside the file, so that the move stays within one file system and cannot stop half way.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
