"""Free memory goes back to the operating system."""

import platform

import psutil
import pytest

from swarmjax.run import heap


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc alone is told to release")
def test_freed_memory_is_given_back() -> None:
    blocks = [bytes(1000) for _ in range(100_000)]
    # Every hundredth block stays, so that none of the pages between lies at the end of the heap.
    kept = blocks[::100]
    del blocks
    before = psutil.Process().memory_info().rss
    heap.release()
    freed = before - psutil.Process().memory_info().rss
    assert len(kept) == 1000
    # Of 100 MB, all but the pages of 4 KiB in which one of the 1,000 lies.
    assert freed > 80e6
