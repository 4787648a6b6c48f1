"""Free memory back to the system: what comes and goes with every scan leaves holes in the heap, and they add up."""

from __future__ import annotations

import ctypes
import sys


def give_back_free_pages() -> None:
    """Let the allocator return every whole page that nothing uses, also between things that are in use.

    glibc alone holds on to them and can be asked; elsewhere nothing is done. It takes some milliseconds, and what is
    asked for next is mapped anew: for once in a hundred scans, not for each.
    """
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
        trim(0)
