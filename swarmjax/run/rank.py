"""Supervises a process that trains together with others.

If the other processes are gone, JAX aborts a process from inside and prints pages of stack trace.
So each process trains in a child. The parent does not load JAX, and reports in one sentence how the
child ended.
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

CHILD = "SWARMJAX_CHILD"  # environment variable: file descriptor for messages to the parent
_TICK_S = 0.05
_DIE_WITH_PARENT, _KILL = 1, 9  # PR_SET_PDEATHSIG and SIGKILL of prctl(2)
# Output of JAX's C++ parts: log lines, and the stack trace of an abort.
_NOISE = re.compile(
    r"[IWEF]\d{4} |\*\*\*|\s+@ |PC: @|\[Gloo\]|RPC: |=== Source|external/|Additional GRPC"
)


def is_child() -> bool:
    """Returns whether this process has a supervising parent."""
    return CHILD in os.environ


def begin() -> None:
    """Makes this child end together with its parent, on Linux. The child calls it."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, _KILL)


def tell_joined() -> None:
    """Tells the parent, if there is one, that the processes of the run have connected."""
    if is_child():
        os.write(int(os.environ[CHILD]), b"1")


def supervise(stop: Stop) -> int:
    """Runs this command again as a child, and reports how the child died, if it did.

    Args:
      stop: notices signals, which are passed on to the child.

    Returns:
      The child's exit code. If the child died, the code is 2 before the processes had connected,
      and 75 afterwards.
    """
    read, write = os.pipe()
    child = subprocess.Popen(
        [sys.executable, *sys.orig_argv[1:]],
        env=os.environ | {CHILD: str(write)},
        pass_fds=(write,),
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,  # a terminal's Ctrl-C reaches only the parent
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
    """Waits for a child, and passes the first signal on."""
    told = False
    while (code := child.poll()) is None:
        if stop.number is not None and not told:
            child.send_signal(stop.number)
            told = True
        time.sleep(_TICK_S)
    return code


def _copy(lines: IO[str]) -> None:
    """Copies the child's output, without the lines of C++ libraries."""
    sys.stderr.writelines(_sentences(lines))
    sys.stderr.flush()


def _sentences(lines: Iterable[str]) -> Iterable[str]:
    return (line for line in lines if not _NOISE.match(line))


def _died(code: int, *, joined: bool) -> int:
    how = f"signal {-code}" if code < 0 else f"exit code {code}"
    if joined:
        sys.stderr.write(
            f"swarmjax.train: error: this process of the run died ({how}), probably because "
            "another process has ended. What was saved before is kept: go on with resume=auto.\n"
        )
        return REQUEUE
    sys.stderr.write(
        "swarmjax.train: error: the processes of the run did not connect within a minute: start "
        "all of them, and check JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID.\n"
    )
    return USER_ERROR
