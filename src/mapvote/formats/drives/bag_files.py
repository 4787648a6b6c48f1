"""The files of a bag, also of a recording that was not stopped properly: without metadata.yaml, or cut off at its end.

An MCAP file (mcap.dev/spec) that is cut off lacks its summary and footer. Its whole records are read as ``mcap
recover`` would write them: the index of its chunks is made anew and given to the reader behind them.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path, PurePath
from typing import Any, BinaryIO, cast

from mapvote.core.types import MapvoteError
from mapvote.formats.listing import plain_name
from mapvote.formats.reading import first_line, read_yaml

STORAGES = {
    ".mcap": "mcap recover {0} -o recovered.mcap",
    ".db3": 'sqlite3 {0} ".recover" | sqlite3 recovered.db3',
    ".bag": "rosbag reindex {0}",
}
"""Suffixes of files that hold messages, and the command that repairs such a file."""
UNFINISHED = ".active"
"""Suffix of a ROS 1 bag while it is being recorded."""
_METADATA = "metadata.yaml"
_MAGIC = b"\x89MCAP0\r\n"
_RECORD_HEAD = struct.Struct("<BQ")
"""Opcode of a record, length of its content."""


def is_bag(path: Path) -> bool:
    """Whether a bag lies at ``path``: a storage file, or a folder with the metadata.yaml of ROS 2."""
    return (path / _METADATA).is_file() or (path.is_file() and _suffix(path) in (*STORAGES, UNFINISHED))


def is_bag_without_metadata(path: Path) -> bool:
    """Whether ``path`` is a folder of storage files whose metadata.yaml is missing."""
    return path.is_dir() and not (path / _METADATA).is_file() and bool(_beside(path))


class Opcode(IntEnum):
    """Kinds of records in an MCAP file."""

    FOOTER = 0x02
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    STATISTICS = 0x0B
    DATA_END = 0x0F


@dataclass(frozen=True, slots=True)
class BagFiles:
    """Files given to a reader of bags, and their mends."""

    paths: list[Any]
    """A member of the reader's path protocol."""
    mended: list[str]
    """Faults of the files, in words, and the part that is read nevertheless."""


def bag_files(path: Path) -> BagFiles:
    """The files of the bag at ``path``. MapvoteError if there is nothing that can be read, naming what repairs it."""
    if path.is_file():
        return _storage_files([path], [])
    files = _beside(path)
    about = path / _METADATA
    if not about.is_file():
        _one_recording(path, files)
        return _storage_files(files, [f"{path}: no {_METADATA}; read without it: {_names(files)}"])
    wrong = _wrong_in_metadata(about)
    if not wrong:
        cut = [file for file in files if _suffix(file) == ".mcap" and not _is_whole(file)]
        if not cut:
            return BagFiles([path], [])
        return _storage_files(files, [])
    if not files:
        raise MapvoteError(f"{about}: {wrong}, and no storage file ({', '.join(STORAGES)}) beside it; copy it again")
    _one_recording(path, files)
    return _storage_files(files, [f"{about}: {wrong}; read without it: {_names(files)}"])


def mend_of(path: Path) -> str:
    """The command that repairs the files at ``path``, of whatever storage."""
    files = [path] if path.is_file() else _beside(path)
    compressed = [file for file in path.glob("*") if _suffix(file) in (".zstd", ".zst")] if path.is_dir() else []
    if compressed and not files:
        return f"zstd -d {compressed[0]}"
    if not files:
        return "copy the bag again"
    suffix = _suffix(files[0])
    return STORAGES[".bag" if suffix == UNFINISHED else suffix].format(files[0])


def _suffix(file: Path) -> str:
    return file.suffix.lower()


def _names(files: list[Path]) -> str:
    return ", ".join(file.name for file in files)


def _beside(folder: Path) -> list[Path]:
    """The storage files of a folder, NAME_2 before NAME_10."""
    files = [f for f in folder.iterdir() if _suffix(f) in STORAGES and f.is_file() and not f.name.startswith(".")]
    return sorted(files, key=lambda f: [int(w) if w.isdigit() else w for w in re.split(r"(\d+)", f.name)])


def _one_recording(folder: Path, files: list[Path]) -> None:
    """MapvoteError unless the files are pieces of one recording: NAME_0.mcap, NAME_1.mcap, .. of one storage."""
    recordings = {(re.sub(r"_\d+$", "", file.stem), _suffix(file)) for file in files}
    if len(recordings) > 1:
        raise MapvoteError(f"{folder}: several recordings and no {_METADATA}; give one of: {_names(files)}")


def _wrong_in_metadata(about: Path) -> str:
    """Why the reader cannot use a metadata.yaml, "" if it can. The compression of messages is written nowhere else, so
    such a file is left to the reader."""
    try:
        table = read_yaml(about)["rosbag2_bagfile_information"]
        storage = table["storage_identifier"]
        listed = table["relative_file_paths"]
        names = [plain_name(PurePath(name).name, about) for name in listed]  # of which the reader takes no more either
        missing = [name for name in names if not (about.parent / name).is_file()]
        table["topics_with_message_count"], table["version"]
    except (MapvoteError, KeyError, TypeError) as error:
        return f"not the metadata of a bag ({first_line(error)})"
    if table.get("compression_mode", "").lower() not in ("", "none"):
        return ""
    if storage not in ("mcap", "sqlite3"):
        return f"storage_identifier is {storage!r}, neither mcap nor sqlite3"
    return f"names files that are not there ({', '.join(missing)})" if missing else ""


def _storage_files(files: list[Path], mended: list[str]) -> BagFiles:
    """Each file as the reader takes it; an MCAP that is cut off is completed."""
    paths: list[Any] = []
    for file in files:
        if _suffix(file) != ".mcap" or _is_whole(file):
            paths.append(StorageFile(file))
            continue
        whole = _whole_records(file)
        paths.append(whole)
        lost = file.stat().st_size - whole.end
        problem = (
            f"{file}: cut off, the recording was not stopped properly; its last {lost:,} bytes are an incomplete record"
        )
        mended.append(f"{problem} and left out. `{mend_of(file)}` writes a whole file")
    return BagFiles(paths, mended)


def _is_whole(file: Path) -> bool:
    """Whether an MCAP file ends as it should."""
    with file.open("rb") as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(max(0, size - len(_MAGIC)))
        return size > 2 * len(_MAGIC) and stream.read() == _MAGIC


@dataclass(frozen=True, slots=True)
class StorageFile:
    """A storage file as the reader takes it: by its suffix in small letters, and with what is to follow its end."""

    path: Path
    end: int = -1
    """Bytes of it that are used; -1: all."""
    tail: bytes = b""
    """The bytes that follow them."""

    @property
    def suffix(self) -> str:
        return _suffix(self.path)

    @property
    def stem(self) -> str:
        return self.path.stem

    @property
    def name(self) -> str:
        return self.path.name

    def exists(self) -> bool:
        return self.path.exists()

    def is_dir(self) -> bool:
        return False

    def stat(self) -> Any:
        return self.path.stat()

    def open(self, *_: Any, **__: Any) -> BinaryIO:
        stream = self.path.open("rb")
        return stream if self.end < 0 else cast("BinaryIO", _Completed(stream, self.end, self.tail))

    def __str__(self) -> str:
        return str(self.path)


class _Completed(io.RawIOBase):
    """The first ``end`` bytes of a file, and ``tail`` after them."""

    def __init__(self, stream: BinaryIO, end: int, tail: bytes) -> None:
        self._stream = stream
        self._end = end
        self._tail = tail
        self._at = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._end + len(self._tail)}[whence]
        self._at = max(0, start + offset)
        return self._at

    def read(self, size: int = -1) -> bytes:
        stop = self._end + len(self._tail) if size < 0 else self._at + size
        self._stream.seek(self._at)
        out = self._stream.read(max(0, min(stop, self._end) - self._at))
        out += self._tail[max(0, self._at - self._end) : max(0, stop - self._end)]
        self._at += len(out)
        return out

    def close(self) -> None:
        self._stream.close()
        super().close()


def _whole_records(file: Path) -> StorageFile:
    """A cut-off MCAP file up to its last whole record, with an index of its chunks, an empty count of its messages and
    a footer behind it. MapvoteError if no record of it is whole."""
    index = b""
    chunk = b""
    offsets = b""
    chunk_start = chunk_end = 0
    with file.open("rb") as stream:
        if stream.read(len(_MAGIC)) != _MAGIC:
            raise MapvoteError(f"{file}: no MCAP file, or its beginning is lost; copy it again")
        end = len(_MAGIC)
        size = file.stat().st_size
        for opcode, start, stop in _records(stream, size):
            # The indexes of a chunk's messages follow it, one a channel.
            if opcode == Opcode.MESSAGE_INDEX and stop <= size:
                offsets += stream.read(2) + struct.pack("<Q", start)
            # Another record, even one that is cut off: they are complete.
            elif opcode != Opcode.MESSAGE_INDEX:
                index += _chunk_index(chunk, offsets, start - chunk_end)
                chunk = b""
                offsets = b""
            if stop > size:
                break
            if opcode == Opcode.CHUNK:
                chunk = _chunk_head(stream, start, stop)
                chunk_start = start
                chunk_end = stop
            end = stop
    if end == len(_MAGIC):
        raise MapvoteError(f"{file}: cut off before its first whole record; nothing of it can be read")
    if index and chunk:  # an index that may be incomplete would hide messages
        end = chunk_start
    counted = _record(Opcode.STATISTICS, struct.pack("<QHIIIIQQI", 0, 0, 0, 0, 0, 0, 0, 0, 0))
    summary = index + counted if index else b""
    data_end = _record(Opcode.DATA_END, struct.pack("<I", 0))
    footer = _record(Opcode.FOOTER, struct.pack("<QQI", end + len(data_end) if summary else 0, 0, 0))
    return StorageFile(file, end, data_end + summary + footer + _MAGIC)


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, int, int]]:
    """(opcode, start, end) of the records of the data section, of which only the last may end beyond ``size``;
    ``stream`` stands at the record's content."""
    start = stream.tell()
    while start < size and len(head := stream.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
        opcode, length = _RECORD_HEAD.unpack(head)
        if opcode in (Opcode.DATA_END, Opcode.FOOTER) or not 0 < opcode < 0x80:
            return
        end = start + _RECORD_HEAD.size + length
        yield opcode, start, end
        stream.seek(end)
        start = end


def _record(opcode: int, body: bytes) -> bytes:
    return _RECORD_HEAD.pack(opcode, len(body)) + body


def _chunk_head(stream: BinaryIO, start: int, end: int) -> bytes:
    """Times, place and sizes of the chunk record from ``start`` to ``end``, as its index begins and ends with them."""
    # Times of the first and last message of a chunk, its uncompressed size, its checksum.
    first_ns, last_ns, size, _ = struct.unpack("<QQQI", stream.read(28))
    (letters,) = struct.unpack("<I", stream.read(4))
    compression = stream.read(letters)
    (compressed,) = struct.unpack("<Q", stream.read(8))
    head = struct.pack("<QQQQ", first_ns, last_ns, start, end - start)
    return head + struct.pack("<I", letters) + compression + struct.pack("<QQ", compressed, size)


def _chunk_index(chunk: bytes, offsets: bytes, index_length: int) -> bytes:
    """The index record of a chunk whose message indexes lie at ``offsets``; nothing for a chunk without any."""
    if not chunk or not offsets:
        return b""
    places = struct.pack("<I", len(offsets)) + offsets + struct.pack("<Q", index_length)
    return _record(Opcode.CHUNK_INDEX, chunk[:32] + places + chunk[32:])
