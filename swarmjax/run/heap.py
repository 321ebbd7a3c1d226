"""Memory that this process holds and does not use."""

import contextlib
import ctypes


def release() -> None:
    """Gives free memory back to the operating system, where the C library is glibc.

    glibc keeps what was freed: half a gigabyte once XLA has compiled. Other processes cannot use
    it, and it fills again bit by bit, so that a long run seems to leak.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library or system
        ctypes.CDLL(None).malloc_trim(0)
