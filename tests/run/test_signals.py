"""Checks that the first signal asks a run to save, and that the second ends it at once."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence

import pytest

from swarmjax.exit_codes import INTERRUPTED, REQUEUE
from swarmjax.run.signals import ONE_S, Stop, StoppedError

# A program that listens for signals, prints so, and then waits as its argument says.
_PROCESS = """
import ctypes, signal, sys, time
from swarmjax.run.signals import Stop
for number in sys.argv[2:]:  # as nohup and a shell's & do
    signal.signal(int(number), signal.SIG_IGN)
with Stop() as stop:
    print("listening", flush=True)
    if sys.argv[1] == "poll":
        while not stop.asked:
            time.sleep(0.01)
    else:  # within one call of C, as a compiled program is, from which no signal brings Python back
        libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(64)
        libc.pthread_mutex_lock(mutex)
        libc.pthread_mutex_lock(mutex)  # waits for itself
sys.exit(stop.code)
"""


def _start(how: str, ignored: Sequence[int] = ()) -> subprocess.Popen:
    code = [sys.executable, "-c", _PROCESS, how, *map(str, map(int, ignored))]
    process = subprocess.Popen(code, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "listening\n"
    return process


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, INTERRUPTED),
        (signal.SIGTERM, REQUEUE),
        (signal.SIGUSR1, REQUEUE),
        (signal.SIGUSR2, REQUEUE),
        (signal.SIGHUP, REQUEUE),
    ],
)
def test_a_signal_asks_to_stop_and_says_so(number: int, code: int) -> None:
    process = _start("poll")
    process.send_signal(number)
    _, said = process.communicate(timeout=30)
    assert process.returncode == code
    assert said == "saving and stopping after the current updates; a second signal stops at once\n"


@pytest.mark.parametrize("ignored", [signal.SIGHUP, signal.SIGINT])
def test_a_signal_that_is_ignored_at_the_start_stays_ignored(ignored: int) -> None:
    process = _start("poll", [ignored])
    process.send_signal(ignored)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.3)
    process.send_signal(signal.SIGUSR1)  # the first signal that counts
    _, said = process.communicate(timeout=30)
    assert process.returncode == REQUEUE
    assert said.count("saving and stopping after the current updates") == 1
    assert "stopped at once" not in said


def test_a_second_signal_ends_the_process_even_within_a_call() -> None:
    process = _start("call")
    process.send_signal(signal.SIGTERM)
    time.sleep(1.5 * ONE_S)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=10)
    assert process.returncode == REQUEUE  # the code of the first signal
    assert "stopped at once" in said


def test_nothing_to_save_is_an_error_of_its_own() -> None:
    with Stop() as stop:
        stop.check()
        os.kill(os.getpid(), signal.SIGUSR1)
        deadline = time.monotonic() + 10.0
        while not stop.signalled and time.monotonic() < deadline:
            time.sleep(0.01)
        with pytest.raises(StoppedError):
            stop.check()


def test_a_signal_that_comes_twice_at_once_counts_once() -> None:
    process = _start("poll")
    process.send_signal(signal.SIGUSR1)
    process.send_signal(signal.SIGUSR1)
    _, said = process.communicate(timeout=30)
    assert process.returncode == REQUEUE
    assert "stopped at once" not in said


def test_a_stop_has_a_time_of_its_own() -> None:
    assert not Stop().asked
    assert not Stop(until=time.monotonic() + 3600.0).asked
    over = Stop(until=time.monotonic())
    assert over.asked
    assert not over.signalled


def test_signals_are_given_back() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGUSR1)]
    with Stop():
        pass
    assert [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGUSR1)] == before


# A program that sends a signal to itself while Python exits.
_ENDING = """
import atexit, os, sys
from swarmjax.run.signals import Stop
atexit.register(lambda: os.kill(os.getpid(), int(sys.argv[1])))
with Stop(last=True):
    pass
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_a_signal_after_all_is_saved_changes_no_exit_code(number: int) -> None:
    process = subprocess.run([sys.executable, "-c", _ENDING, str(int(number))], check=False)
    assert process.returncode == 0
