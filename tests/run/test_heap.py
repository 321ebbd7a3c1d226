"""Threads share a heap, and free memory goes back to the operating system."""

import os
import platform
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="other C libraries are not told anything"
)

# Has glibc write down its heaps after eight threads have allocated.
_THREADS = """
import ctypes, sys, threading
from swarmjax.run import heap
if sys.argv[1] == "share":
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


def _heaps(word: str) -> int:
    words = [sys.executable, "-c", _THREADS, word]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment)
    return done.stdout.count("<heap nr=")


def test_threads_share_one_heap() -> None:
    assert _heaps("share") == 1
    assert _heaps("leave") > 1


# Every hundredth block stays, so that none of the pages between lies at the end of the heap.
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
    # Of 100 MB, all but the pages of 4 KiB in which one of the 1,000 lies.
    assert int(done.stdout) > 80e6
