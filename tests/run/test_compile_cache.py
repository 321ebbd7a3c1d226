"""Checks that compiled programs are cached where possible, and that no cache stops a run."""

import os
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from swarmjax import train
from swarmjax.exit_codes import INTERRUPTED
from swarmjax.run import compile_cache
from swarmjax.run.run import Run
from swarmjax.run.signals import StoppedError

_NAMES = ("jax_compilation_cache_dir", "jax_enable_compilation_cache", *compile_cache._OPTIONS)


@pytest.fixture
def unset() -> Iterator[None]:
    """Puts JAX into the state in which no cache is set up, and restores it afterwards."""
    before = {name: getattr(jax.config, name) for name in _NAMES}
    jax.config.update("jax_compilation_cache_dir", None)
    jax.config.update("jax_enable_compilation_cache", True)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture
def events() -> Iterator[list[str]]:
    """Returns a list to which JAX's cache events are added, such as `cache_hits`."""
    found: list[str] = []

    def listen(event: str, **_: object) -> None:
        found.append(event.rpartition("/")[2])

    jax.monitoring.register_event_listener(listen)
    yield found
    jax.monitoring.unregister_event_listener(listen)


def _compile_and_run() -> float:
    """Compiles a program that JAX has not seen in this process, and runs it: 2 * 3 + 1."""

    def small_program(x: jax.Array) -> jax.Array:
        return 2.0 * x + 1.0

    return float(jax.jit(small_program)(jnp.float32(3.0)))


def _entries(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.glob("jit_small_program-*-cache")}


def _use(directory: Path | str | None) -> list[str]:
    """Compiles and runs the program with a cache, and returns the messages of the cache."""
    said: list[str] = []
    with compile_cache.use(None if directory is None else str(directory), said.append):
        assert _compile_and_run() == 7.0
    return said


def test_what_was_compiled_once_is_read_the_second_time(
    unset: None, events: list[str], tmp_path: Path
) -> None:
    assert _use(tmp_path / "xla") == []
    assert len(_entries(tmp_path / "xla")) == 1
    assert "cache_hits" not in events
    events.clear()
    assert _use(tmp_path / "xla") == []
    assert "cache_hits" in events
    assert "cache_misses" not in events


def test_training_keeps_what_it_compiles_where_it_is_told_to(
    unset: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compile_only(_: Run) -> None:
        assert int(_compile_and_run()) == 7
        raise StoppedError

    monkeypatch.setattr(Run, "load", compile_only)
    here = [f"run.dir={tmp_path / 'run'}"]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    assert train.main([*here, f"run.compile_cache={tmp_path / 'given'}"]) == INTERRUPTED
    assert len(_entries(tmp_path / "given")) == 1
    assert train.main([*here, "run.compile_cache=null"]) == INTERRUPTED
    assert not (tmp_path / "user").exists()
    assert train.main(here) == INTERRUPTED
    assert len(_entries(tmp_path / "user" / "swarmjax" / "xla")) == 1


def _flip(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0xFF]) + data[middle + 1 :]


@pytest.mark.parametrize(
    "damage",
    [_flip, lambda data: data[: len(data) // 2], lambda data: b""],
    ids=["flipped", "cut short", "empty"],
)
def test_a_damaged_entry_is_said_and_replaced(
    unset: None, events: list[str], tmp_path: Path, damage
) -> None:
    _use(tmp_path)
    ((name, sound),) = _entries(tmp_path).items()
    (tmp_path / name).write_bytes(damage(sound))
    foreign = "jit_small_program-of-mine-cache"
    (tmp_path / foreign).write_text("")
    (sentence,) = _use(tmp_path)
    assert sentence.startswith(f"jit_small_program in {tmp_path} cannot be read and is compiled ")
    assert _entries(tmp_path).keys() == {name, foreign}
    events.clear()
    assert _use(tmp_path) == []
    assert "cache_hits" in events


def test_a_directory_that_cannot_be_written_is_said(unset: None, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (sentence,) = _use(tmp_path / "file" / "xla")
    assert sentence.startswith("compiled programs will not be kept: ")
    assert str(tmp_path / "file") in sentence


def test_an_entry_that_cannot_be_written_is_said(unset: None, tmp_path: Path) -> None:
    said: list[str] = []
    with compile_cache.use(str(tmp_path / "xla"), said.append):
        assert _compile_and_run() == 7.0
        shutil.rmtree(tmp_path / "xla")
        assert _compile_and_run() == 7.0
    start = f"jit_small_program is not kept in {tmp_path / 'xla'}: FileNotFoundError"
    assert any(each.startswith(start) for each in said)


def test_a_directory_that_others_may_write_is_not_used(unset: None, tmp_path: Path) -> None:
    tmp_path.chmod(0o770)
    (sentence,) = _use(tmp_path)
    assert "could run code" in sentence
    assert not _entries(tmp_path)


def test_the_directory_is_made_for_its_owner_alone(unset: None, tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        _use(tmp_path / "caches" / "xla")
    finally:
        os.umask(before)
    assert (tmp_path / "caches" / "xla").stat().st_mode & 0o777 == 0o700


def test_auto_is_the_users_own_cache(
    unset: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert _use("auto") == []
    assert len(_entries(tmp_path / "swarmjax" / "xla")) == 1
    for unusable in ("", "relative/path"):
        monkeypatch.setenv("XDG_CACHE_HOME", unusable)
        monkeypatch.setenv("HOME", str(tmp_path / "home"))
        home = tmp_path / "home" / ".cache" / "swarmjax" / "xla"
        assert compile_cache.default_directory() == home


def test_null_keeps_nothing(unset: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert _use(None) == []
    assert not any(tmp_path.iterdir())


def test_a_cache_that_is_set_up_already_is_left_alone(unset: None, tmp_path: Path) -> None:
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "theirs"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    compilation_cache.reset_cache()
    assert _use(tmp_path / "ours") == []
    assert len(_entries(tmp_path / "theirs")) == 1
    assert not (tmp_path / "ours").exists()


def test_no_cache_is_made_where_jax_is_told_to_have_none(unset: None, tmp_path: Path) -> None:
    jax.config.update("jax_enable_compilation_cache", False)
    assert _use(tmp_path / "ours") == []
    assert not (tmp_path / "ours").exists()


def test_everything_is_put_back(unset: None, tmp_path: Path) -> None:
    before = {name: getattr(jax.config, name) for name in _NAMES}
    filters, show = list(warnings.filters), warnings.showwarning
    with compile_cache.use(str(tmp_path)):
        assert jax.config.jax_compilation_cache_dir == str(tmp_path)
    assert {name: getattr(jax.config, name) for name in _NAMES} == before
    assert (warnings.filters, warnings.showwarning) == (filters, show)


def test_other_warnings_pass(unset: None, tmp_path: Path) -> None:
    with (
        pytest.warns(UserWarning, match="of something else"),
        compile_cache.use(str(tmp_path)),
    ):
        warnings.warn("of something else", stacklevel=1)


def test_a_large_cache_loses_what_was_used_longest_ago(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new, middle, old = (f"jit_{age}-{'0' * 64}-cache" for age in ("new", "middle", "old"))
    for age, name in enumerate((new, middle, old, "package-cache")):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    os.utime(tmp_path / old, (1e9 + 1, 0.0))  # read later than the other entries
    monkeypatch.setattr(compile_cache, "LARGEST", 250)
    compile_cache._shorten(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {new, old, "package-cache"}


def test_only_the_users_own_cache_is_shortened(
    unset: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    monkeypatch.setattr(compile_cache, "LARGEST", 0)
    own, given = compile_cache.default_directory(), tmp_path / "given"
    for directory in (own, given):
        directory.mkdir(parents=True, mode=0o700)
        (directory / f"jit_theirs-{'0' * 64}-cache").write_bytes(bytes(100))
    assert _use("auto") == []
    assert _use(given) == []
    assert not list(own.glob("jit_theirs-*"))
    assert list(given.glob("jit_theirs-*"))
