"""Tests how a training run is watched from outside, with a script in place of training."""

import os
import signal
import sys
from pathlib import Path

import pytest
from sentences import refusal

from benchmarks import from_command
from benchmarks.from_command import Watched
from swarmjax.config import ConfigError

# The script writes a row of metrics for each success, and exits on SIGINT.
SCRIPT = """#!{python}
import json, os, signal, sys, time
signal.signal(signal.SIGINT, lambda *_: sys.exit(130))
folder = [word for word in sys.argv if word.startswith("run.dir=")][0].partition("=")[2]
os.makedirs(folder)
with open(os.path.join(folder, "metrics.jsonl"), "w") as file:
    for success in {successes}:
        time.sleep(0.05)
        file.write(json.dumps(dict(success_by_stage=[1.0, success])) + "\\n")
        file.flush()
{end}
"""


def _put(
    folder: Path, monkeypatch: pytest.MonkeyPatch, successes: list, end: str = "time.sleep(60)"
) -> None:
    path = folder / "python"
    path.write_text(SCRIPT.format(python=sys.executable, successes=successes, end=end))
    os.chmod(path, 0o755)
    monkeypatch.setattr(sys, "executable", str(path))


def test_a_run_is_stopped_where_it_reaches_its_targets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _put(tmp_path, monkeypatch, [None, 0.5, 0.91, 0.93, 0.97])
    found, row = from_command.train([], tmp_path / "run", 0.95)
    assert list(found) == ["seconds_to_0.90", "seconds_to_0.95", "saved_s"]
    seconds = [value for value in found.values() if value is not None]
    assert len(seconds) == 3
    assert seconds == sorted(seconds)
    assert 0.0 < seconds[0] < seconds[1]
    assert row["success_by_stage"] == [1.0, 0.97]


def test_what_was_never_reached_has_no_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _put(tmp_path, monkeypatch, [0.5, 0.92], end="")
    found, row = from_command.train([], tmp_path / "run", 0.95)
    assert found["seconds_to_0.90"] is not None
    assert found["seconds_to_0.95"] is None
    assert row["success_by_stage"] == [1.0, 0.92]


def test_a_run_is_asked_to_stop_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A second Ctrl-C would end a run before it has saved its state.
    _put(tmp_path, monkeypatch, [0.97])
    watched, sent = Watched([], tmp_path / "run", {}), []
    with monkeypatch.context() as patched:
        patched.setattr(watched._process, "send_signal", sent.append)
        watched.stop()
        watched.stop()
    assert sent == [signal.SIGINT]
    watched._process.kill()
    with pytest.raises(ConfigError):  # the run was killed, and did not stop as asked
        list(watched.rows())


def test_a_run_that_fails_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _put(tmp_path, monkeypatch, [0.5], end="sys.exit('arenas is 0: give more.')")
    watched = Watched([], tmp_path / "run", {})
    assert refusal(lambda: list(watched.rows())) == "arenas is 0: give more."
