"""What this process holds of memory and does not use, where the C library is glibc.

glibc gives each thread a heap of its own, and a heap keeps what was freed. XLA and TensorStore have
dozens of threads, so that half a gigabyte stays after compiling, and a long run seems to leak: its
heaps fill bit by bit. Elsewhere these functions do nothing.
"""

import contextlib
import ctypes

_M_ARENA_MAX = -8  # of glibc's malloc.h
_NOT_THERE = (AttributeError, OSError, TypeError)  # another C library or system


def share() -> None:
    """Lets all threads of this process share one heap; for a process that has no others yet."""
    with contextlib.suppress(*_NOT_THERE):
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)


def release() -> None:
    """Gives free memory back to the operating system."""
    with contextlib.suppress(*_NOT_THERE):
        ctypes.CDLL(None).malloc_trim(0)
