"""Keeps compiled programs between runs, so that a second start need not compile.

JAX loads and runs the files in the cache directory, so anyone who can write there can run code
here. Therefore the directory belongs to the user, and a directory that others can write is not
used. If the environment or a surrounding program has already configured JAX's cache, it is left
unchanged. Zlib compresses the entries, and its checksum detects damaged ones, which are deleted and
compiled again.
"""

import contextlib
import os
import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TextIO

import jax
from jax.experimental.compilation_cache import compilation_cache

AUTO = "auto"
LARGEST = 2**30  # bytes; a program of the default run takes one thousandth of this
_OPTIONS = {
    # Keep every program. A start compiles only a handful of programs, and on a GPU even small
    # programs take a tenth of a second each. By default, JAX keeps only programs that take over a
    # second.
    "jax_persistent_cache_min_compile_time_secs": 0.0,
}
_DIRECTORY = "jax_compilation_cache_dir"
_ENTRY = re.compile(r"(.+)-[0-9a-f]{64}-cache")  # JAX's name for a program, then a SHA-256
_TROUBLE = re.compile(
    r"Error (reading|writing) persistent compilation cache entry for '([^']+)': ([^\n]*)"
)


def default_directory() -> Path:
    """Returns the default cache directory: `swarmjax/xla` in the user's cache folder."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG Base Directory Specification says to ignore a relative path here.
    base = Path(given) if os.path.isabs(given) else Path.home() / ".cache"
    return base / "swarmjax" / "xla"


def _to_stderr(sentence: str) -> None:
    sys.stderr.write(f"swarmjax: {sentence}\n")


@contextlib.contextmanager
def use(choice: str | None, say: Callable[[str], None] = _to_stderr) -> Iterator[None]:
    """Caches the programs that are compiled in a `with` block. Cache errors never stop a run.

    Args:
      choice: a directory, `auto` for `default_directory`, or None for no cache.
      say: receives a sentence for each problem.
    """
    set_up = getattr(jax.config, _DIRECTORY) or not jax.config.jax_enable_compilation_cache
    if choice is None or set_up:
        yield
        return
    try:
        directory = default_directory() if choice == AUTO else Path(choice).absolute()
        _open(directory)
        if choice == AUTO:  # a directory that was given may hold programs of other users
            _shorten(directory)
    except (OSError, RuntimeError) as error:  # RuntimeError: the home directory is unknown
        say(f"compiled programs will not be kept: {error}.")
        yield
        return
    with _configured(directory), _explained(directory, say):
        yield


def _open(directory: Path) -> None:
    """Makes the directory, private to its owner, and checks that it can be used.

    Raises:
      OSError: if it cannot be written, or if others can write it.
    """
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=directory).close()
    found = directory.stat()
    mine = not hasattr(os, "geteuid") or found.st_uid == os.geteuid()
    if not mine or (os.name == "posix" and found.st_mode & 0o022):
        raise OSError(f"other users can write to {directory} and could run code through it")


def _entries(directory: Path) -> list[tuple[str, Path]]:
    """Finds the programs in JAX's cache directory, by name, and ignores all other files."""
    found = [(_ENTRY.fullmatch(path.name), path) for path in directory.iterdir()]
    return [(match[1], path) for match, path in found if match is not None]


def _shorten(directory: Path) -> None:
    """Deletes the least recently used programs when the cache is too large."""
    found = []
    for _, path in _entries(directory):
        with contextlib.suppress(FileNotFoundError):  # another run has just deleted the file
            found.append((path, path.stat()))
    found.sort(key=lambda entry: max(entry[1].st_atime, entry[1].st_mtime), reverse=True)
    total = 0
    for path, stat in found:
        total += stat.st_size
        if total > LARGEST:
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def _configured(directory: Path) -> Iterator[None]:
    """Configures JAX's cache, and restores the old configuration at the end."""
    options = _OPTIONS | {_DIRECTORY: str(directory)}
    before = {name: getattr(jax.config, name) for name in options}
    _update(options)
    try:
        yield
    finally:
        _update(before)


def _update(options: Mapping[str, object]) -> None:
    for name, value in options.items():
        jax.config.update(name, value)
    # JAX reads the directory's setting once, when it first compiles.
    compilation_cache.reset_cache()


@contextlib.contextmanager
def _explained(directory: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Turns JAX's warnings about the cache into sentences, and deletes unreadable entries.

    JAX then compiles the program again, but does not overwrite an existing entry.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("always", message=_TROUBLE.pattern)
        otherwise = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            found = _TROUBLE.match(str(message))
            if found is None:
                otherwise(message, category, filename, lineno, file, line)
                return
            say(_sentence(directory, *found.groups()))

        warnings.showwarning = show
        yield


def _sentence(directory: Path, verb: str, name: str, reason: str) -> str:
    """Describes the problem with an entry, and deletes the entry if it cannot be read."""
    if verb == "writing":
        return f"{name} is not kept in {directory}: {reason}."
    with contextlib.suppress(OSError):
        for program, path in _entries(directory):
            if program == name:
                path.unlink(missing_ok=True)
    return f"{name} in {directory} cannot be read and is compiled again: {reason}."
