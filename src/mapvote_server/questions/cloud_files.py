"""COPC files of versions, which viewers read by ranges of bytes: each is made once and kept on disk."""

from __future__ import annotations

import hashlib
import tempfile
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import BinaryIO, ClassVar

from mapvote.core.record import record
from mapvote.core.types import MapvoteError
from mapvote.formats import export_map
from mapvote_server.questions.origins import with_origins
from mapvote_server.store.queries import version_of
from mapvote_server.store.store import Store


@record()
@dataclass(frozen=True, slots=True)
class CloudFileSizes:
    """Limits of the COPC files of a server."""

    points: int = 20_000_000
    """Points of the largest version of which the server makes a file: a minute of CPU."""
    kept_bytes: int = 2_000_000_000
    """Disk for files that are kept, bytes; the least recently used leave it first."""


CLOUD_FILE_SIZES = CloudFileSizes()


@dataclass(frozen=True, slots=True)
class CloudFile:
    """The file of one version."""

    media_type: ClassVar[str] = "application/vnd.laszip+copc"
    path: Path
    size: int
    """Bytes."""
    digest: str
    """SHA-256 of its content, in hex."""


class CloudFiles:
    """The COPC files of one store's versions, in a folder for temporary files; thread-safe."""

    def __init__(self, store: Store, sizes: CloudFileSizes = CLOUD_FILE_SIZES) -> None:
        self._store = store
        self._sizes = sizes
        self._lock = Lock()
        self._making = Lock()
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._made: OrderedDict[int, CloudFile] = OrderedDict()

    def ready(self, number: int) -> tuple[CloudFile, BinaryIO] | None:
        """(the file of a version, the same opened for reading: it can be read to the end, also if it is dropped
        meanwhile); None if it must be made. NotFound if there is no such version."""
        with self._store.database.reading() as connection:
            version_of(connection, number)
        with self._lock:
            made = self._made.get(number)
            if made is None:
                return None
            self._made.move_to_end(number)
            return made, made.path.open("rb")

    def open(self, number: int) -> tuple[CloudFile, BinaryIO]:
        """The same as :meth:`ready`; made if there is none yet. MapvoteError if the version is too large, or empty."""
        with self._making:  # of several requests, one makes it
            opened = self.ready(number)
            if opened is None:
                self._keep(number, self._make(number))
                opened = self.ready(number)
        assert opened is not None
        return opened

    def close(self) -> None:
        """Delete all files."""
        with self._lock:
            self._made.clear()
            if self._folder is not None:
                self._folder.cleanup()

    def _make(self, number: int) -> CloudFile:
        point_map = self._store.point_map(number)
        if point_map.n_points > self._sizes.points:
            raise MapvoteError(
                f"version {number} has {point_map.n_points:,} points; the server makes files of {self._sizes.points:,} "
                f"at most: mapvote export STORE cloud.copc.laz --version {number} writes larger ones"
            )
        with self._lock:
            if self._folder is None:
                self._folder = tempfile.TemporaryDirectory(prefix="mapvote-clouds-")
            path = Path(self._folder.name) / f"v{number}.copc.laz"
        export_map(with_origins(self._store, point_map), path)
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        return CloudFile(path, path.stat().st_size, digest)

    def _keep(self, number: int, made: CloudFile) -> None:
        """Keep one more, and drop what has no room."""
        with self._lock:
            self._made[number] = made
            while len(self._made) > 1 and sum(one.size for one in self._made.values()) > self._sizes.kept_bytes:
                _, dropped = self._made.popitem(last=False)
                dropped.path.unlink(missing_ok=True)
