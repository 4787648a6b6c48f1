"""Arrays <-> bytes: raw little-endian planes under zstd, sizes checked before anything is allocated."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
import zstandard
from numpy.typing import DTypeLike, NDArray

from mapvote.core.types import U8, MapvoteError

FRAME_HEAD = 18
"""Bytes of the longest header of a zstd frame (RFC 8878, 3.1.1.1)."""
_own = threading.local()
_STEP = 1024
_QUICK = 3
ZSTD_LEVEL = 15
"""For ballots, which travel by radio: level 19 takes five times as long for 2 % of their states. Tiles of noisy float32
gain nothing above level 3."""


def compress(raw: bytes | memoryview, level: int = ZSTD_LEVEL) -> bytes:
    """One zstd frame that says how large its content is."""
    return _compressor(level).compress(raw)


def pack_plane(plane: NDArray[Any], level: int = ZSTD_LEVEL) -> bytes:
    """An array's little-endian C-order bytes, zstd-compressed."""
    return compress(raw_plane(plane, plane.dtype.newbyteorder("<")), level)


def raw_plane(plane: NDArray[Any], dtype: DTypeLike) -> memoryview:
    """An array's C-order bytes as ``dtype``, without a copy where they are these already."""
    return np.ascontiguousarray(plane, dtype=dtype).reshape(-1).view(np.uint8).data


def unpack_bytes(data: bytes, limit: int, what: str) -> bytes:
    """Decompress at most ``limit`` bytes; MapvoteError beyond it or on damage (a decompression bomb stops here).

    A frame says how large it is, and one that says so is written into a buffer of that size, never beyond.
    """
    try:
        size = zstandard.frame_content_size(data)
        if 0 <= size <= limit:
            return _decompressor().decompress(data, read_across_frames=False, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise MapvoteError(f"{what} is damaged ({error}); fetch or send it again") from error
    if size > limit:
        raise MapvoteError(f"{what} is larger than {limit} bytes when decompressed")
    return _unpack_unsaid(data, limit, what)


def frame_size(head: bytes, what: str) -> int:
    """How many bytes a frame of ours holds, which it says at its beginning; MapvoteError if it does not."""
    try:
        size = zstandard.frame_content_size(head)
    except zstandard.ZstdError as error:
        raise MapvoteError(f"{what} is damaged ({error}); fetch or send it again") from error
    if size < 0:
        raise MapvoteError(f"{what} does not say how large it is; fetch or send it again")
    return size


def _unpack_unsaid(data: bytes, limit: int, what: str) -> bytes:
    """A frame that does not say how large it is."""
    frame = zstandard.ZstdDecompressor().decompressobj()
    raw = bytearray()
    try:
        for start in range(0, len(data), _STEP):  # a few kilobytes of frame hold 100 MB at the very most
            raw += frame.decompress(data[start : start + _STEP])
            if len(raw) > limit or frame.eof:
                break
    except zstandard.ZstdError as error:
        raise MapvoteError(f"{what} is damaged ({error}); fetch or send it again") from error
    if len(raw) > limit or not frame.eof or frame.unused_data or start + _STEP < len(data):
        raise MapvoteError(f"{what} is truncated or larger than {limit} bytes when decompressed")
    return bytes(raw)


def _compressor(level: int) -> zstandard.ZstdCompressor:
    """One for each thread and quick level, used again and again, as :func:`_decompressor`. Those of high levels keep
    tens of megabytes, and take longer for a plane than to be made."""
    if level > _QUICK:
        return zstandard.ZstdCompressor(level=level)
    own: dict[int, zstandard.ZstdCompressor] = _own.__dict__.setdefault("compressors", {})
    if level not in own:
        own[level] = zstandard.ZstdCompressor(level=level)
    return own[level]


def _decompressor() -> zstandard.ZstdDecompressor:
    """One for each thread, used again and again: making one takes as long as unpacking a small plane."""
    if not hasattr(_own, "decompressor"):
        _own.decompressor = zstandard.ZstdDecompressor()
    decompressor: zstandard.ZstdDecompressor = _own.decompressor
    return decompressor


def unpack_into(data: bytes, plane: U8, what: str) -> None:
    """Fill ``plane`` (n,) with a frame's n bytes. MapvoteError if it is damaged, or smaller or larger than that.

    What follows a frame is ignored: :func:`unpack_bytes` looks at that when a ballot comes in.
    """
    try:
        if zstandard.frame_content_size(data) == len(plane):
            with _decompressor().stream_reader(data) as reader:
                n = reader.readinto(plane)
        else:  # it does not say how large it is, or it is of another size
            raw = unpack_bytes(data, len(plane), what)
            n = len(raw)
            plane[:n] = np.frombuffer(raw, dtype=np.uint8)
    except zstandard.ZstdError as error:
        raise MapvoteError(f"{what} is damaged ({error}); fetch or send it again") from error
    if n != len(plane):
        raise MapvoteError(f"{what} has {n} bytes, expected {len(plane)}")


def unpack_plane(data: bytes, dtype: str, shape: tuple[int, ...], what: str) -> NDArray[Any]:
    """The array that :func:`pack_plane` took; ``dtype`` little-endian, e.g. "<u8". MapvoteError if damaged.

    ``what`` names the plane in messages, e.g. "ballot: states".
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    raw = unpack_bytes(data, size, what)
    if len(raw) != size:
        raise MapvoteError(f"{what} has {len(raw)} bytes, expected {size}")
    return np.frombuffer(raw, dtype=dtype).reshape(shape)
