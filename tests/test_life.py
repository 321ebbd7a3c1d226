"""Checks what shows that long work goes on."""

import subprocess
import sys
import time

import pytest

from swarmjax import life

# What XLA writes on standard error, with what must stay visible before, between and after.
LOG = """\
E0730 21:00:01.000 7 first.cc:1] a real error
E0730 21:00:00.000 1234 slow_operation_alarm.cc:73]
********************************
[Compiling module jit_chunk] Very slow compile? If you want to file a bug, run with envvar ...
********************************
E0730 21:00:01.000 7 other.cc:1] another error
The operation took 2m13.4s
last words
"""


def _stderr_of(lines: str) -> str:
    """Returns what a process shows of these lines, written by its C code within the block."""
    code = f"from swarmjax import life\nimport os\nwith life.shown(str):\n    {lines}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    return done.stderr


def test_only_the_advice_of_xla_is_hidden() -> None:
    shown = _stderr_of(f"os.write(2, {LOG.encode()!r})")
    assert [line.split("] ")[-1] for line in shown.splitlines()] == [
        "a real error",
        "another error",
        "last words",
    ]


def test_the_last_words_of_a_process_that_crashes_are_shown() -> None:
    assert "fatal" in _stderr_of("os.write(2, b'fatal'); os.abort()")


def test_standard_error_is_whole_again_after_the_block() -> None:
    assert _stderr_of("pass\nos.write(2, b'****')") == "****"


def test_a_command_shows_how_far_it_is_without_a_terminal(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(life, "EVERY_S", 0.05)
    with life.progress("evaluate") as progress:
        progress.advance(progress.add_task("episodes", total=1000), 64)
        time.sleep(0.5)
    time.sleep(0.3)  # until the filter has written all
    line = capfd.readouterr().err.splitlines()[0]
    assert line.startswith("swarmjax.evaluate: 64 of 1,000 episodes after 0")


def test_a_line_comes_at_most_every_ten_seconds() -> None:
    assert life.EVERY_S == 10.0
