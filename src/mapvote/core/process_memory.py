"""Free memory back to the system: what comes and goes with every scan leaves holes in the heap, and they add up. And
the collector of cycles, which has little to do here.
"""

from __future__ import annotations

import ctypes
import gc
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
