"""Signals: a run saves when it is asked to stop, and stops at once when it is asked twice.

SIGINT comes from a person and ends the run with 130. SIGTERM, SIGUSR1, SIGUSR2 and SIGHUP come from
a scheduler or a lost terminal and end it with 75, so that a job script may requeue it. This module
imports nothing that is slow, so that a command can listen before it loads JAX.
"""

import contextlib
import math
import os
import signal
import sys
import threading
import time
from types import FrameType

from swarmjax.exit_codes import INTERRUPTED, REQUEUE

CODES = {
    signal.SIGINT: INTERRUPTED,
    signal.SIGTERM: REQUEUE,
    signal.SIGUSR1: REQUEUE,
    signal.SIGUSR2: REQUEUE,
    signal.SIGHUP: REQUEUE,
}


class StoppedError(Exception):
    """A run that was asked to stop before it had anything to save."""


class Stop:
    """Notices signals while in a `with`, so that the run can save before it stops.

    Attributes:
      code: The exit code that the first signal asks for; None if there was none.
      signalled: Whether somebody asked to stop, by a signal or by setting it.
    """

    def __init__(
        self, until: float = math.inf, *, patient: bool = False, last: bool = False
    ) -> None:
        """Nobody has asked yet; it stops by itself at `until`, of `time.monotonic`.

        One that is `patient` does not stop at once at a second signal: a scheduler sends each to a
        process and to its parent, which hands it on. After one that is `last` the process ends, and
        a signal no longer changes its exit code: what there was to save is saved.
        """
        self.signalled = False
        self._patient, self._last = patient, last
        self.code: int | None = None
        self._until = until

    @property
    def asked(self) -> bool:
        """Whether to stop, because of a signal or of the time."""
        return self.signalled or time.monotonic() >= self._until

    def check(self) -> None:
        """Raises `StoppedError` if a signal came; for where there is nothing to save yet."""
        if self.signalled:
            raise StoppedError

    def __enter__(self) -> "Stop":
        """Begins to listen."""
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        self._before = {number: signal.signal(number, self._ask) for number in CODES}
        self._wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._thread = threading.Thread(
            target=_watch, args=(self._read, self._patient), daemon=True
        )
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Gives the signals back; ignores them if the process ends."""
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_IGN if self._last else handler)
        os.close(self._write)  # which ends the thread, when it has said what it has to
        self._thread.join()

    def _ask(self, number: int, _: FrameType | None) -> None:
        if self.code is None:
            self.code = CODES[signal.Signals(number)]
        self.signalled = True


def _watch(read: int, patient: bool) -> None:
    """Says what the first signal does, and ends the process at the second.

    Python calls a handler only between its own instructions, and a compiled program may run for
    minutes within one. The bytes of `signal.set_wakeup_fd` come at once.
    """
    first: signal.Signals | None = None
    with os.fdopen(read, "rb", buffering=0) as pipe:
        while number := pipe.read(1):
            found = signal.Signals(number[0])
            if found not in CODES:
                continue
            if first is not None and patient:
                continue
            if first is not None:
                _end(CODES[first])
            first = found
            _say("stopping after this call, to save; a second signal stops at once")


def _end(code: int) -> None:
    """Ends the process without waiting for anything; files it was writing are not replaced."""
    _say("stopped at once; what was saved before is kept")
    os._exit(code)


def _say(sentence: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # a terminal that is gone
        sys.stderr.write(f"{sentence}\n")
        sys.stderr.flush()
