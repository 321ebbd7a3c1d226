"""Checks that threads share a heap, and that freed memory returns to the operating system."""

import os
import platform
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="other C libraries are not told anything"
)

# A program that makes glibc print its heaps after eight threads have allocated memory.
_THREADS = """
import ctypes, sys, threading
from swarmjax.run import heap
heap.os.cpu_count = lambda: int(sys.argv[1])
if sys.argv[1] != "0":
    heap.share()
together = threading.Barrier(8)
def allocate():
    kept = [bytes(1000) for _ in range(100)]
    together.wait()
threads = [threading.Thread(target=allocate) for _ in range(8)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
libc = ctypes.CDLL(None)
libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
libc.fflush(None)
"""


def _heaps(cores: int) -> int:
    words = [sys.executable, "-c", _THREADS, str(cores)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment)
    return done.stdout.count("<heap nr=")


def test_two_cores_share_a_heap() -> None:
    assert _heaps(1) == 1
    assert _heaps(2) == 1
    assert _heaps(6) == 3
    assert _heaps(0) > 3  # not limited


# A program that frees blocks. It keeps every hundredth block, so that the free pages do not lie at
# the end of the heap.
_BLOCKS = """
import psutil
from swarmjax.run import heap
blocks = [bytes(1000) for _ in range(100_000)]
kept = blocks[::100]
del blocks
before = psutil.Process().memory_info().rss
heap.release()
print(before - psutil.Process().memory_info().rss)
"""


def test_freed_memory_is_given_back() -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    words = [sys.executable, "-c", _BLOCKS]
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment)
    # The blocks fill 100 MB. All of this memory is released, except the 4 KiB pages that hold the
    # 1,000 kept blocks.
    assert int(done.stdout) > 80e6
