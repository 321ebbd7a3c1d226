"""Checks run directories: one process at a time, and logs cut to what a checkpoint counts."""

import errno
import fcntl
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from swarmjax.config import ConfigError
from swarmjax.run import directory
from swarmjax.run.directory import Log
from swarmjax.run.errors import CheckpointError

# A program that holds the lock of a directory until it is killed.
_HOLDER = """
import pathlib, sys, time
from swarmjax.run import directory
with directory.locked(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_second_process_is_refused_until_the_first_is_dead(tmp_path: Path) -> None:
    run = tmp_path / "run"
    code = [sys.executable, "-c", _HOLDER, str(run)]
    with subprocess.Popen(code, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        try:
            with (
                pytest.raises(
                    ConfigError, match=f"but process {holder.pid} is writing to it: wait"
                ),
                directory.locked(run),
            ):
                pass
        finally:
            holder.kill()
    with directory.locked(run):
        assert run.exists()


def test_starts_of_the_same_second_get_directories_of_their_own(tmp_path: Path) -> None:
    def claim(_: int) -> str:
        return directory.claim(tmp_path / "runs", "now").name

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(claim, range(20)))
    assert sorted(found) == sorted(["now", *(f"now-{number}" for number in range(2, 21))])


def _write(path: Path, *rows: dict) -> int:
    log = Log(path)
    log.write(rows)
    length = log.sync()
    log.close()
    return length


def test_a_log_is_cut_to_the_bytes_that_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    length = _write(path, {"update": 0}, {"update": 1})
    _write(path, {"update": 2})
    with path.open("a") as file:
        file.write('{"update": 3, "are')
    directory.cut(path, length)
    assert directory.read_rows(path, None) == [{"update": 0}, {"update": 1}]


@pytest.mark.parametrize("content", ["", '{"update": 0}', '{"update": 0}\n{"update": 1}'])
def test_a_log_that_lacks_rows_is_refused_and_left_as_it_is(tmp_path: Path, content: str) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text(content)
    with pytest.raises(CheckpointError, match=r"restore the file, or delete it to continue"):
        directory.cut(path, len('{"update": 0}\n{"update": 1}\n'))
    assert path.read_text() == content


def test_a_log_that_was_deleted_is_begun_anew(tmp_path: Path) -> None:
    directory.cut(tmp_path / "metrics.jsonl", 100)
    assert directory.read_rows(tmp_path / "metrics.jsonl", 100) == []


@pytest.mark.parametrize("line", [b"[]", b"{", b"\xff\xfe", b"[" * 100_000, b"9" * 5000, b"NaN"])
def test_a_damaged_line_is_named(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_bytes(b'{"update": 0}\n' + line + b"\n")
    with pytest.raises(
        CheckpointError, match=r"metrics.jsonl is damaged at line 2: restore the file"
    ):
        directory.read_rows(path, None)


def test_a_full_disk_is_an_error_and_nothing_waits(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").symlink_to("/dev/full")
    log = Log(tmp_path / "metrics.jsonl")
    with pytest.raises(OSError, match="No space left on device"):
        log.write([{"update": 0}])
    log.close()


@contextmanager
def _room_for_10_bytes() -> Iterator[None]:
    """Limits files that this process writes to ten bytes, as on a disk that is nearly full."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_rows_that_a_disk_holds_in_part_are_an_error(tmp_path: Path) -> None:
    with (
        Log(tmp_path / "metrics.jsonl") as log,
        _room_for_10_bytes(),
        pytest.raises(OSError, match="No space left"),
    ):
        log.write([{"update": 0}])
    assert (tmp_path / "metrics.jsonl").read_text() == '{"update":'


def test_a_log_is_cut_without_writing_it_again(tmp_path: Path) -> None:
    lines = b'{"update": 0}\n{"update": 1}\n'
    (tmp_path / "log").write_bytes(lines)
    with _room_for_10_bytes():
        directory.cut(tmp_path / "log", 14)
    assert (tmp_path / "log").read_bytes() == lines[:14]


def test_what_may_change_is_not_in_the_digest_of_a_config() -> None:
    stored = {"budget": 1, "run": {"dir": "a", "id": "x"}, "algo": {"epochs": 1}, "resume": None}
    now = {"budget": 2, "run": {"dir": "b", "id": "x"}, "algo": {"epochs": 9, "new": 1}}
    kept = directory.kept_config(stored, now)
    assert kept == stored | {"budget": 2, "run": {"dir": "b", "id": "x"}}
    assert directory.config_digest(kept) == directory.config_digest(stored)
    assert directory.config_digest(now) != directory.config_digest(stored)


def test_a_file_system_without_locks_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    refused = pytest.raises(ConfigError, match="cannot be written: No locks available")
    with refused, directory.locked(tmp_path):
        pass


def test_a_claimed_directory_that_stays_empty_is_removed(tmp_path: Path) -> None:
    run = directory.claim(tmp_path / "runs", "now")
    with directory.locked(run, claimed=True):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_its_holder_removes_meanwhile_is_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = fcntl.flock

    def remove_first(file: Any, how: int) -> None:
        (tmp_path / directory.LOCK).unlink()  # like a process that held the lock and wrote nothing
        lock(file, how)

    monkeypatch.setattr(fcntl, "flock", remove_first)
    with pytest.raises(ConfigError, match="another process is writing"), directory.locked(tmp_path):
        pass
