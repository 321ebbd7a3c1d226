"""Checks that compiled programs are cached where possible, and that no cache stops a run."""

import os
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

_NAMES = (
    "jax_compilation_cache_dir",
    "jax_enable_compilation_cache",
    "jax_persistent_cache_min_compile_time_secs",
)


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Returns the user's cache directory, before it is made, while JAX has no other cache."""
    before = {name: getattr(jax.config, name) for name in _NAMES}
    for name, value in zip(_NAMES, (None, True, 1.0), strict=True):
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    yield tmp_path / "caches" / "swarmjax" / "xla"
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


def _entries(directory: Path) -> list[Path]:
    return list(directory.glob("jit_small_program-*-cache"))


def _use() -> None:
    """Compiles and runs the program with the cache."""
    with compile_cache.use():
        assert _compile_and_run() == 7.0


def test_what_was_compiled_once_is_read_the_second_time(own: Path, events: list[str]) -> None:
    _use()
    assert len(_entries(own)) == 1
    assert "cache_hits" not in events
    events.clear()
    _use()
    assert "cache_hits" in events
    assert "cache_misses" not in events


def test_training_keeps_what_it_compiles(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def compile_only(_: Run) -> None:
        assert int(_compile_and_run()) == 7
        raise StoppedError

    monkeypatch.setattr(Run, "load", compile_only)
    assert train.main([f"run.dir={own / 'run'}"]) == INTERRUPTED
    assert len(_entries(own)) == 1


@pytest.mark.filterwarnings("ignore:Error reading persistent compilation cache:UserWarning")
def test_a_damaged_entry_is_compiled_again(own: Path) -> None:
    _use()
    (entry,) = _entries(own)
    content = bytearray(entry.read_bytes())
    content[len(content) // 2] ^= 0xFF
    entry.write_bytes(content)
    _use()


def test_a_directory_that_cannot_be_written_is_said(
    own: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own.parent.parent.write_text("")
    _use()
    sentence = capsys.readouterr().err
    assert sentence.startswith("swarmjax: compiled programs will not be kept: ")
    assert str(own.parent.parent) in sentence


def test_a_directory_that_others_may_write_is_not_used(
    own: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own.mkdir(parents=True)
    own.chmod(0o770)
    _use()
    assert "could run code" in capsys.readouterr().err
    assert not _entries(own)


def test_the_directory_is_made_for_its_owner_alone(own: Path) -> None:
    before = os.umask(0)
    try:
        _use()
    finally:
        os.umask(before)
    assert own.stat().st_mode & 0o777 == 0o700


def test_a_relative_cache_folder_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    for unusable in ("", "relative/path"):
        monkeypatch.setenv("XDG_CACHE_HOME", unusable)
        monkeypatch.setenv("HOME", "/home/somebody")
        home = Path("/home/somebody/.cache/swarmjax/xla")
        assert compile_cache.default_directory() == home


def test_a_cache_that_is_set_up_already_is_left_alone(own: Path, tmp_path: Path) -> None:
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "theirs"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    compilation_cache.reset_cache()
    _use()
    assert len(_entries(tmp_path / "theirs")) == 1
    assert not own.exists()


def test_no_cache_is_made_where_jax_is_told_to_have_none(own: Path) -> None:
    jax.config.update("jax_enable_compilation_cache", False)
    _use()
    assert not own.exists()


def test_everything_is_put_back(own: Path) -> None:
    before = {name: getattr(jax.config, name) for name in _NAMES}
    with compile_cache.use():
        assert jax.config.jax_compilation_cache_dir == str(own)
    assert {name: getattr(jax.config, name) for name in _NAMES} == before
