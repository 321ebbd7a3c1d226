"""Handles signals: a run saves and stops at the first one, and stops at once at the second.

SIGINT comes from a person and ends the run with code 130. SIGTERM, SIGUSR1, SIGUSR2 and SIGHUP come
from a scheduler or a lost terminal. They end the run with code 75, so that a job script can requeue
it. A signal that is ignored when the command starts stays ignored. This module imports nothing
slow, so a command can listen before it loads JAX.
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
    """Says that a run was asked to stop before it had anything to save."""


class Stop:
    """Notices signals in a `with` block, so that the run can save before it stops.

    Attributes:
      code: the exit code for the first signal; None if there was none.
      number: the first signal; None if there was none.
      signalled: whether a stop was requested, by a signal or by setting this attribute.
    """

    def __init__(
        self, until: float = math.inf, *, patient: bool = False, last: bool = False
    ) -> None:
        """Begins without a request to stop.

        Args:
          until: time to stop without a signal, on the clock `time.monotonic`.
          patient: whether to ignore a second signal. A scheduler sends each signal to a process and
            to its parent. The parent passes the signal on, so the process receives it twice.
          last: whether the process ends after the `with` block. Then everything is saved, and later
            signals must not change the exit code.
        """
        self.signalled = False
        self._patient, self._last = patient, last
        self.code: int | None = None
        self.number: int | None = None
        self._until = until

    @property
    def asked(self) -> bool:
        """Whether to stop, because of a signal or the time limit."""
        return self.signalled or time.monotonic() >= self._until

    def check(self) -> None:
        """Raises `StoppedError` if a signal came. For use before there is anything to save."""
        if self.signalled:
            raise StoppedError

    def __enter__(self) -> "Stop":
        """Begins to listen."""
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        # `nohup`, or `&` in a script, has signals ignored. They stay ignored.
        heard = [each for each in CODES if signal.getsignal(each) is not signal.SIG_IGN]
        self._before = {number: signal.signal(number, self._ask) for number in heard}
        self._wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._thread = threading.Thread(
            target=_watch, args=(self._read, self._patient), daemon=True
        )
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Restores the old signal handlers, or ignores signals if the process ends."""
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_IGN if self._last else handler)
        os.close(self._write)  # ends the thread after its last message
        self._thread.join()

    def _ask(self, number: int, _: FrameType | None) -> None:
        if self.code is None:
            self.code, self.number = CODES[signal.Signals(number)], number
        self.signalled = True


def _watch(read: int, patient: bool) -> None:
    """Reports the first signal, and ends the process at the second.

    Python calls a handler only between its own instructions. A compiled program can run for minutes
    within one instruction. The bytes of `signal.set_wakeup_fd` arrive at once.
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
            _say("stopping after the current call, to save; a second signal stops at once")


def _end(code: int) -> None:
    """Ends the process without waiting. Files that it was writing keep their old content."""
    _say("stopped at once; what was saved before is kept")
    os._exit(code)


def _say(sentence: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # the terminal may be gone
        sys.stderr.write(f"{sentence}\n")
        sys.stderr.flush()
