"""Large parts of a round on disk: those of a city's tiles do not fit in memory."""

from __future__ import annotations

import os
import pickle
import tempfile
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from threading import Lock

from mapvote.codec.planes import compress, zstd
from mapvote.fusion.decision_record import Record
from mapvote.fusion.gravity import Remains
from mapvote_server.errors import Unavailable


@dataclass(frozen=True, slots=True)
class Bulk:
    """The large parts of one fused tile."""

    record: Record | None = None
    """The decision; None if the tile itself could not be read."""
    planes: Mapping[str, bytes] | None = None
    """The planes of the edited tile that its version changes, by hash; None if it does not change."""
    undecided: Remains | None = None
    """Its remains, if tiles around it decide what falls in it."""


class RoundFile:
    """A file without a name that ends with its last reader; thread-safe.

    It lies in the folder for temporary files (``TMPDIR``).
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        self._lock = Lock()
        self._end = 0
        weakref.finalize(self, self._file.close)

    def put(self, bulk: Bulk) -> OnDisk:
        """Write one tile's parts. Unavailable if the disk is full."""
        data = compress(pickle.dumps(bulk, protocol=5), 1)
        with self._lock:
            start = self._end
            self._end += len(data)
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.pwrite(self._file.fileno(), rest, start + len(data) - len(rest)) :]
        except OSError as error:
            mend = "free space there, or set TMPDIR to a larger disk"
            raise Unavailable(f"no room for a round in {tempfile.gettempdir()} ({error.strerror}): {mend}") from error
        return OnDisk(self, start, len(data))

    def read(self, start: int, size: int) -> Bulk:
        """Parts that were written there."""
        bulk: Bulk = pickle.loads(zstd.decompress(os.pread(self._file.fileno(), size, start)))
        return bulk


@dataclass(frozen=True, slots=True)
class OnDisk:
    """The place of one tile's large parts."""

    file: RoundFile
    start: int
    size: int

    def read(self) -> Bulk:
        """The parts, read again at each call."""
        return self.file.read(self.start, self.size)
