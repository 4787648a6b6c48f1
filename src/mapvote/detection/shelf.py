"""Bytes that are kept to the end of a drive and read once or twice. The first IN_MEMORY bytes stay in memory, the
others in an unnamed file, so a long road needs no more memory than a short one.
"""

from __future__ import annotations

import mmap
import tempfile
import weakref
from typing import BinaryIO, NamedTuple

from mapvote.core.types import MapvoteError

IN_MEMORY = 16 << 20
"""Bytes held before a file is opened: a drive of one or two kilometres writes nothing to disk. They are mapped apart
from the heap, because between the short-lived arrays of each scan they would fragment it."""


class Slot(NamedTuple):
    """The place of an item on a shelf, in bytes."""

    start: int
    stop: int


class Shelf:
    """Bytes are appended, never moved and never removed."""

    def __init__(self) -> None:
        self._memory: mmap.mmap | None = None
        self._file: BinaryIO | None = None
        self._used = self._in_file = 0
        """Bytes in memory and in the file."""

    def put(self, data: bytes | memoryview) -> Slot:
        """Store a copy of ``data`` and return its place. MapvoteError if memory is full and no file can be written."""
        if self._memory is None:
            self._memory = mmap.mmap(-1, IN_MEMORY)
        start, stop = self._used, self._used + len(data)
        if stop > IN_MEMORY:
            return self._put_in_file(memoryview(data))
        self._memory[start:stop] = data
        self._used = stop
        return Slot(start, stop)

    def _put_in_file(self, data: memoryview) -> Slot:
        start, stop = self._in_file, self._in_file + len(data)
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="mapvote_drive_", buffering=0)  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            self._file.seek(start)
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            raise MapvoteError(
                f"{tempfile.gettempdir()}: what a long drive keeps, 20 MB a kilometre, could not be written there "
                f"({error.strerror}): make room, or name another folder in TMPDIR"
            ) from error
        self._in_file = stop
        return Slot(IN_MEMORY + start, IN_MEMORY + stop)

    def read(self, place: Slot) -> bytes:
        """The bytes at a place."""
        if place.stop <= IN_MEMORY:
            return b"" if self._memory is None else self._memory[place.start : place.stop]
        assert self._file is not None
        self._file.seek(place.start - IN_MEMORY)
        return self._file.read(place.stop - place.start)
