"""Bytes that are kept for long, in blocks of their own: laid among what comes and goes with every scan, each would keep
a hole open around it, and the process would grow by its holes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mapvote.core.types import U8

BLOCK = 64 << 20
"""Bytes of a block: more than the heap ever takes for itself (32 MB), so that the system lends it apart from the heap,
and lends memory only for what is written."""


class Place(NamedTuple):
    """Where something lies on a shelf."""

    block: int
    start: int
    stop: int


class Shelf:
    """Bytes are put down one after another, and never moved. What is put down is not taken away again."""

    def __init__(self) -> None:
        self._blocks: list[U8] = []
        self._used = 0
        """Bytes of the last block."""

    def put(self, data: bytes | memoryview) -> Place:
        """Where a copy of ``data`` lies."""
        if not self._blocks or self._used + len(data) > len(self._blocks[-1]):
            self._blocks.append(np.empty(max(BLOCK, len(data)), dtype=np.uint8))
            self._used = 0
        start, self._used = self._used, self._used + len(data)
        self._blocks[-1][start : self._used] = np.frombuffer(data, dtype=np.uint8)
        return Place(len(self._blocks) - 1, start, self._used)

    def read(self, place: Place) -> U8:
        """(n,) what lies there; a view."""
        return self._blocks[place.block][place.start : place.stop]
