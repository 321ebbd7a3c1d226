"""The parent of a process that trains together with others.

A process whose peers are gone is ended by JAX from inside, by an abort and pages of stack. So one
of several processes trains in a child, and its parent, which knows no JAX, says in a sentence what
became of it.
"""

import ctypes
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from typing import IO

from swarmjax.exit_codes import REQUEUE, USER_ERROR
from swarmjax.run.signals import CODES, Stop

CHILD = "SWARMJAX_CHILD"  # holds the descriptor that a child tells its parent by
_TICK_S = 0.05
_DIE_WITH_PARENT, _KILL = 1, 9  # PR_SET_PDEATHSIG and SIGKILL of prctl(2)
# What the C++ parts of JAX write: log lines, and the stack of an abort.
_NOISE = re.compile(
    r"[IWEF]\d{4} |\*\*\*|\s+@ |PC: @|\[Gloo\]|RPC: |=== Source|external/|Additional GRPC"
)


def is_child() -> bool:
    """Tells whether this process has such a parent."""
    return CHILD in os.environ


def begin() -> None:
    """Ends a child when its parent ends, where the system can; for the child to call."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, _KILL)


def tell_joined() -> None:
    """Tells the parent, if there is one, that the processes of the run have met."""
    if is_child():
        os.write(int(os.environ[CHILD]), b"1")


def supervise(stop: Stop) -> int:
    """Runs this command once more as a child, and says how it ended if it cannot.

    Args:
      stop: Notices signals, which are handed on.

    Returns:
      The exit code: the child's; 2 if it died before the processes met, 75 if after.
    """
    read, write = os.pipe()
    child = subprocess.Popen(
        [sys.executable, *sys.orig_argv[1:]],
        env=os.environ | {CHILD: str(write)},
        pass_fds=(write,),
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,  # a terminal's Ctrl-C reaches the parent alone
    )
    os.close(write)
    assert child.stderr is not None
    copying = threading.Thread(target=_copy, args=(child.stderr,), daemon=True)
    copying.start()
    code = _wait(child, stop)
    copying.join()
    with os.fdopen(read, "rb") as pipe:
        joined = bool(pipe.read())
    if 0 <= code <= max(CODES.values()):
        return code
    return _died(code, joined=joined)


def _wait(child: subprocess.Popen[str], stop: Stop) -> int:
    """Waits for a child, and hands the first signal on."""
    told = False
    while (code := child.poll()) is None:
        if stop.signalled and not told:
            number = next(each for each, code in CODES.items() if code == stop.code)
            child.send_signal(number)
            told = True
        time.sleep(_TICK_S)
    return code


def _copy(lines: IO[str]) -> None:
    """Copies the lines that a child prints, without those of its C++ libraries."""
    sys.stderr.writelines(_sentences(lines))
    sys.stderr.flush()


def _sentences(lines: Iterable[str]) -> Iterable[str]:
    return (line for line in lines if not _NOISE.match(line))


def _died(code: int, *, joined: bool) -> int:
    how = f"signal {-code}" if code < 0 else f"exit code {code}"
    if joined:
        sys.stderr.write(
            f"swarmjax.train: error: this process of the run died ({how}), as it does when another "
            "one is gone. What was saved before is kept: go on with resume=auto.\n"
        )
        return REQUEUE
    sys.stderr.write(
        "swarmjax.train: error: the processes of the run did not meet within a minute: start as "
        "many as run.processes says, and check run.coordinator, the address of the first.\n"
    )
    return USER_ERROR
