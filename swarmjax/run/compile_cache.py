"""Compiled programs kept between runs, so that a second start need not compile.

JAX loads what lies in the cache's directory and runs it: who can write there can run code here.
So the directory is the user's own, and one that others may write is not used. An environment, or a
program around this one, that has set JAX's cache up itself is left alone. Entries are compressed
with zlib, whose checksum tells those that are damaged; they are dropped and compiled anew.
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
LARGEST = 2**30  # bytes; a program of the default run takes a thousandth of it
_OPTIONS = {
    # Everything is kept: a start compiles a handful of programs, and on a GPU small ones take a
    # tenth of a second each, below the second from which JAX keeps them by default.
    "jax_persistent_cache_min_compile_time_secs": 0.0,
}
_DIRECTORY = "jax_compilation_cache_dir"
_ENTRY = re.compile(r"(.+)-[0-9a-f]{64}-cache")  # JAX's name of a program, and a SHA-256
_TROUBLE = re.compile(
    r"Error (reading|writing) persistent compilation cache entry for '([^']+)': ([^\n]*)"
)


def default_directory() -> Path:
    """Returns where the cache is unless somebody says otherwise: `swarmjax/xla` with the caches."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    # By the XDG Base Directory Specification a relative path there is to be ignored.
    base = Path(given) if os.path.isabs(given) else Path.home() / ".cache"
    return base / "swarmjax" / "xla"


def _to_stderr(sentence: str) -> None:
    sys.stderr.write(f"swarmjax: {sentence}\n")


@contextlib.contextmanager
def use(choice: str | None, say: Callable[[str], None] = _to_stderr) -> Iterator[None]:
    """Keeps what is compiled while in a `with`; nothing that is wrong with the cache stops a run.

    Args:
      choice: a directory, `auto` for `default_directory`, or None for no cache.
      say: takes a sentence for each thing that is wrong.
    """
    set_up = getattr(jax.config, _DIRECTORY) or not jax.config.jax_enable_compilation_cache
    if choice is None or set_up:
        yield
        return
    try:
        directory = default_directory() if choice == AUTO else Path(choice).absolute()
        _open(directory)
        if choice == AUTO:  # in a directory that was given, programs may be somebody else's
            _shorten(directory)
    except (OSError, RuntimeError) as error:  # RuntimeError: nobody knows where home is
        say(f"nothing that is compiled will be kept: {error}.")
        yield
        return
    with _configured(directory), _explained(directory, say):
        yield


def _open(directory: Path) -> None:
    """Makes the directory, for its owner alone, and looks whether it can be used.

    Raises:
      OSError: it cannot be written, or others may write it.
    """
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=directory).close()
    found = directory.stat()
    mine = not hasattr(os, "geteuid") or found.st_uid == os.geteuid()
    if not mine or (os.name == "posix" and found.st_mode & 0o022):
        raise OSError(f"{directory} can be written by others, who could run code by that")


def _entries(directory: Path) -> list[tuple[str, Path]]:
    """Finds the programs that JAX keeps there, by name; every other file is left alone."""
    found = [(_ENTRY.fullmatch(path.name), path) for path in directory.iterdir()]
    return [(match[1], path) for match, path in found if match is not None]


def _shorten(directory: Path) -> None:
    """Drops the programs that were used longest ago from a cache that has become too large."""
    found = []
    for _, path in _entries(directory):
        with contextlib.suppress(FileNotFoundError):  # another run dropped it just now
            found.append((path, path.stat()))
    found.sort(key=lambda entry: max(entry[1].st_atime, entry[1].st_mtime), reverse=True)
    total = 0
    for path, stat in found:
        total += stat.st_size
        if total > LARGEST:
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def _configured(directory: Path) -> Iterator[None]:
    """Sets JAX's cache up, and puts everything back."""
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
    # JAX looks at the directory once, when it first compiles.
    compilation_cache.reset_cache()


@contextlib.contextmanager
def _explained(directory: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Turns JAX's warnings about the cache into sentences, and drops what cannot be read.

    JAX itself compiles anew then, but does not write over an entry that is there.
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
    """Says what is wrong with an entry, which is dropped if it cannot be read."""
    if verb == "writing":
        return f"{name} is not kept in {directory}: {reason}."
    with contextlib.suppress(OSError):
        for program, path in _entries(directory):
            if program == name:
                path.unlink(missing_ok=True)
    return f"what {directory} kept of {name} cannot be read and is compiled anew: {reason}."
