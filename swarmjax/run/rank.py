"""Supervises a process that trains together with others.

If the other processes are gone, JAX aborts a process from inside and prints pages of stack trace.
So each process trains in a child. The parent does not load JAX, and reports in one sentence how the
child ended.
"""

import ctypes
import os
import re
import signal
import subprocess
import sys

from swarmjax.exit_codes import REQUEUE
from swarmjax.run.settings import RunConfig
from swarmjax.run.signals import CODES

CHILD = "SWARMJAX_CHILD"  # environment variable of a process that has a supervising parent
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl(2)
# Output of JAX's C++ parts: log lines, and the stack trace of an abort.
_NOISE = re.compile(
    r"[IWEF]\d{4} |\*\*\*|\s+@ |PC: @|\[Gloo\]|RPC: |=== Source|external/|Additional GRPC"
)


def needs_parent(options: RunConfig) -> bool:
    """Returns whether a run has several processes, and this one has no parent yet."""
    return options.distributed and CHILD not in os.environ


def follow_parent() -> None:
    """Lets this process, if it has a parent, end together with it, on Linux."""
    if CHILD in os.environ and sys.platform == "linux":
        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)


def supervise() -> int:
    """Runs this command again as a child, and reports how the child died, if it did.

    Returns:
      The child's exit code; 75 if the child died.
    """
    child = subprocess.Popen(
        [sys.executable, *sys.orig_argv[1:]],
        env=os.environ | {CHILD: "1"},
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,  # a terminal's Ctrl-C reaches only the parent
    )
    for number in CODES:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda number, _: child.send_signal(number))
    assert child.stderr is not None
    sys.stderr.writelines(line for line in child.stderr if not _NOISE.match(line))
    code = child.wait()
    if 0 <= code <= max(CODES.values()):
        return code
    sys.stderr.write(
        f"swarmjax.train: error: this process of the run died (signal {-code}), probably because "
        "another process has ended. What was saved before is kept: go on with resume=auto.\n"
    )
    return REQUEUE
