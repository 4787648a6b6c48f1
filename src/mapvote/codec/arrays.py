"""Arrays <-> bytes: raw little-endian planes under zstd, sizes checked before anything is allocated."""

from __future__ import annotations

import math
import sys
import threading
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mapvote.core.types import MapvoteError

if sys.version_info >= (3, 14):
    from compression import zstd as zstd
else:
    from backports import zstd as zstd

FRAME_HEAD = 18
"""Bytes of the longest header of a zstd frame (RFC 8878, 3.1.1.1)."""
_own = threading.local()
_QUICK = 3
ZSTD_LEVEL = 15
"""For ballots, which travel by radio: level 19 takes five times as long for 2 % of their states. Tiles of noisy float32
gain nothing above level 3."""


def compress(raw: bytes | memoryview, level: int = ZSTD_LEVEL) -> bytes:
    """One zstd frame that states the size of its content.

    Each thread keeps one compressor for each quick level: making one takes as long as packing a small plane. Those of
    high levels hold tens of megabytes, and are made in a hundredth of the time that a plane takes them.
    """
    if level > _QUICK:
        return zstd.compress(raw, level)
    own: dict[int, zstd.ZstdCompressor] = _own.__dict__.setdefault("compressors", {})
    if level not in own:
        own[level] = zstd.ZstdCompressor(level)
    return own[level].compress(raw, zstd.ZstdCompressor.FLUSH_FRAME)


def pack_plane(plane: NDArray[Any], level: int = ZSTD_LEVEL) -> bytes:
    """An array's little-endian C-order bytes, zstd-compressed."""
    return compress(raw_plane(plane, plane.dtype.newbyteorder("<")), level)


def raw_plane(plane: NDArray[Any], dtype: DTypeLike) -> memoryview:
    """An array's C-order bytes as ``dtype``, without a copy where they are these already."""
    return np.ascontiguousarray(plane, dtype=dtype).reshape(-1).view(np.uint8).data


def unpack_bytes(data: bytes, limit: int, what: str) -> bytes:
    """Decompress at most ``limit`` bytes of one frame. MapvoteError beyond ``limit`` (a decompression bomb stops here),
    on damage, and where something follows the frame."""
    try:
        size = zstd.get_frame_info(data).decompressed_size
        if size is not None and size > limit:
            raise MapvoteError(f"{what} is larger than {limit} bytes when decompressed")
        frame = zstd.ZstdDecompressor()
        raw = frame.decompress(data, limit + 1 if size is None else size)
    except zstd.ZstdError as error:
        raise MapvoteError(f"{what} is damaged ({error}); fetch or send it again") from error
    if len(raw) > limit or not frame.eof:
        raise MapvoteError(f"{what} is truncated or larger than {limit} bytes when decompressed")
    if frame.unused_data:
        raise MapvoteError(f"{what} is damaged ({len(frame.unused_data)} bytes follow it); fetch or send it again")
    return raw


def frame_size(head: bytes, what: str) -> int:
    """How many bytes a frame of ours holds, from its header; MapvoteError if the header does not state it."""
    try:
        size = zstd.get_frame_info(head).decompressed_size
    except zstd.ZstdError as error:
        raise MapvoteError(f"{what} is damaged ({error}); fetch or send it again") from error
    if size is None:
        raise MapvoteError(f"{what} does not say how large it is; fetch or send it again")
    return size


def unpack_plane(data: bytes, dtype: str, shape: tuple[int, ...], what: str) -> NDArray[Any]:
    """The array that :func:`pack_plane` took; ``dtype`` little-endian, e.g. "<u8". MapvoteError if damaged.

    ``what`` names the plane in messages, e.g. "ballot: states".
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    raw = unpack_bytes(data, size, what)
    if len(raw) != size:
        raise MapvoteError(f"{what} has {len(raw)} bytes, expected {size}")
    return np.frombuffer(raw, dtype=dtype).reshape(shape)
