"""Handles signals: at the first signal a run saves and stops, at the second it stops at once.

SIGINT comes from a person and ends the run with code 130. SIGTERM, SIGUSR1, SIGUSR2 and SIGHUP come
from a scheduler or a lost terminal. These four signals end the run with code 75, so that a job
script can requeue it. A signal that is ignored when the command starts stays ignored. This module
imports nothing slow, so a command can listen before it loads JAX.
"""

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
# Seconds after the first signal in which further signals count as the same one. A scheduler sends a
# signal to a process and to its parent (`rank`), which passes the signal on.
ONE_S = 1.0


class StoppedError(Exception):
    """Says that a run was asked to stop before it had anything to save."""


class Stop:
    """Notices signals in a `with` block, so that the run can save before it stops.

    Attributes:
      code: the exit code for the first signal; None if there was none.
      signalled: whether a stop was requested, by a signal or by setting this attribute.
    """

    def __init__(self, until: float = math.inf, *, last: bool = False) -> None:
        """Begins without a request to stop.

        Args:
          until: time to stop without a signal, on the clock `time.monotonic`.
          last: whether the process ends after the `with` block. Everything is saved by then, and
            later signals must not change the exit code.
        """
        self.signalled = False
        self.code: int | None = None
        self._until, self._last = until, last

    @property
    def asked(self) -> bool:
        """Whether to stop, because of a signal or the time limit."""
        return self.signalled or time.monotonic() >= self._until

    def check(self) -> None:
        """Raises `StoppedError` if a signal came. Call it while there is nothing to save."""
        if self.signalled:
            raise StoppedError(
                "stopped before the first update: nothing was trained, and nothing is lost"
            )

    def __enter__(self) -> "Stop":
        """Begins to listen."""
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        # `nohup`, or `&` in a script, starts a command that ignores signals. They stay ignored.
        heard = [each for each in CODES if signal.getsignal(each) is not signal.SIG_IGN]
        self._before = {number: signal.signal(number, self._ask) for number in heard}
        self._wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._thread = threading.Thread(target=_watch, args=(self._read,), daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Restores the old signal handlers, or ignores signals if `last` was given."""
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_IGN if self._last else handler)
        os.close(self._write)  # ends the thread after its last message
        self._thread.join()

    def _ask(self, number: int, _: FrameType | None) -> None:
        self.code = self.code or CODES[signal.Signals(number)]
        self.signalled = True


def _watch(read: int) -> None:
    """Reports the first signal, and ends the process at the second.

    Python calls a handler only between its own instructions. A compiled program can run for minutes
    within one instruction. The bytes that `signal.set_wakeup_fd` makes Python write arrive at once.
    """
    code, since = None, 0.0
    with os.fdopen(read, "rb", buffering=0) as pipe:
        while number := pipe.read(1):
            if number[0] not in CODES:
                continue
            if code is None:
                code, since = CODES[signal.Signals(number[0])], time.monotonic()
                _say("saving and stopping after the current updates; a second signal stops at once")
            elif time.monotonic() > since + ONE_S:
                _say("stopped at once; everything saved before is kept")
                os._exit(code)


def _say(sentence: str) -> None:
    try:
        sys.stderr.write(f"{sentence}\n")
        sys.stderr.flush()
    except (OSError, ValueError):  # the terminal may be gone
        pass
