"""Keeps compiled programs between runs, so that a second start need not compile them.

JAX loads and runs the files in the cache directory, so anyone who can write there can run code
here. Therefore the directory belongs to the user, and a directory that others can write is not
used. If the environment or a surrounding program has already configured JAX's cache, this
configuration is left unchanged: `JAX_COMPILATION_CACHE_DIR` chooses another directory, and
`JAX_ENABLE_COMPILATION_CACHE=false` turns the cache off.
"""

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax
from jax.experimental.compilation_cache import compilation_cache

_DIRECTORY = "jax_compilation_cache_dir"


def default_directory() -> Path:
    """Returns the cache directory: `swarmjax/xla` in the user's cache folder."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG Base Directory Specification says to ignore a relative path here.
    base = Path(given) if os.path.isabs(given) else Path.home() / ".cache"
    return base / "swarmjax" / "xla"


@contextlib.contextmanager
def use() -> Iterator[None]:
    """Caches the programs that are compiled in a `with` block. Cache errors never stop a run."""
    if getattr(jax.config, _DIRECTORY) or not jax.config.jax_enable_compilation_cache:
        yield
        return
    try:
        directory = default_directory()
        _open(directory)
    except (OSError, RuntimeError) as error:  # RuntimeError: the home directory is unknown
        sys.stderr.write(f"swarmjax: compiled programs will not be kept: {error}.\n")
        yield
        return
    options = {
        _DIRECTORY: str(directory),
        # Keep every program. A start compiles only a handful of programs, and on a GPU even small
        # programs take a tenth of a second each. By default, JAX keeps only programs that take over
        # a second.
        "jax_persistent_cache_min_compile_time_secs": 0.0,
    }
    before = {name: getattr(jax.config, name) for name in options}
    _configure(options)
    try:
        yield
    finally:
        _configure(before)


def _open(directory: Path) -> None:
    """Makes the directory, private to its owner, and checks that it can be used.

    Raises:
      OSError: if the directory cannot be written, or if other users can write to it.
    """
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=directory).close()
    found = directory.stat()
    mine = not hasattr(os, "geteuid") or found.st_uid == os.geteuid()
    if not mine or (os.name == "posix" and found.st_mode & 0o022):
        raise OSError(f"other users can write to {directory} and could run code through it")


def _configure(options: Mapping[str, object]) -> None:
    for name, value in options.items():
        jax.config.update(name, value)
    # JAX reads the directory's setting once, when it first compiles.
    compilation_cache.reset_cache()
