"""What this process holds of memory and does not use, where the C library is glibc.

glibc gives each thread a heap of its own, and a heap keeps what was freed. XLA and TensorStore have
dozens of threads, so that half a gigabyte stays after compiling, and a long run seems to leak: its
heaps fill bit by bit. With a single heap, though, threads that compile wait for its lock: on 32
cores `stage=worlds` with a memory took 145 s to compile instead of 44 s. Elsewhere these functions
do nothing.
"""

import contextlib
import ctypes
import os

_M_ARENA_MAX = -8  # of glibc's malloc.h
_NOT_THERE = (AttributeError, OSError, TypeError)  # another C library or system


def share() -> None:
    """Limits this process to a heap for every two cores; for a process that has no threads yet."""
    heaps = max(1, (os.cpu_count() or 1) // 2)
    with contextlib.suppress(*_NOT_THERE):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, heaps)


def release() -> None:
    """Gives free memory back to the operating system."""
    with contextlib.suppress(*_NOT_THERE):
        ctypes.CDLL(None).malloc_trim(0)
