"""Free memory back to the system: what comes and goes with every scan leaves holes in the heap, and they add up. And
the collector of cycles, which has little to do here.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def give_back_free_pages() -> None:
    """Let the allocator return every whole page that nothing uses, also between things that are in use.

    Only glibc keeps them and has a call for it; elsewhere nothing is done. It takes some milliseconds, and the next
    allocations map pages anew: call it once in a hundred scans, not for each.
    """
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
        trim(0)


def zero_pages(n_bytes: int) -> mmap.mmap:
    """Zeros in pages of their own. The system gives a page when it is first written to, and takes all back at the end.

    Shared pages, which Python maps by default, it would give when they are read too; huge ones 2 MB at a time.
    """
    if not hasattr(mmap, "MADV_NOHUGEPAGE"):  # of Linux
        return mmap.mmap(-1, n_bytes)
    pages = mmap.mmap(-1, n_bytes, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    pages.madvise(mmap.MADV_NOHUGEPAGE)
    return pages


@contextmanager
def seldom_collecting() -> Iterator[None]:
    """Modules and what a compiler makes are small objects by the million that live on: the collector would walk over
    them again and again, a tenth of the time that it takes to import or to compile them."""
    usual = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(50_000, 50, 50)
    try:
        yield
    finally:
        gc.set_threshold(*usual)
        gc.unfreeze()
