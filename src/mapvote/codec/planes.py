"""Planes of a tile <-> bytes: raw and little-endian under zstd, sizes checked before anything is allocated.

A plane of column words holds only the words that are not zero: masks and free space mark few of a tile's 65,536 cells.
The steps from each cell to the next are stored as two planes of bytes, then the words as eight. Bytes of equal meaning
lie together, which packs a fifth smaller than whole words.
"""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mapvote.core.columns import EVERY_BIT
from mapvote.core.grid import CELLS
from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import I32, NO_VOTE, U8, U64, Bool, MapvoteError

if sys.version_info >= (3, 14):
    from compression import zstd as zstd
else:
    from backports import zstd as zstd

FRAME_HEAD = 18
"""Bytes of the longest header of a zstd frame (RFC 8878, 3.1.1.1)."""
_own = threading.local()
_WAY, _WORD = 2, 8
"""Bytes of the way to a cell, and of its word."""
_BITS = np.arange(64, dtype=np.uint64)
ZSTD_LEVEL = 15
"""For ballots, which travel by radio: level 19 takes five times as long for 2 % of their states. Tiles of noisy float32
gain nothing above level 3."""


def compress(raw: bytes | memoryview, level: int = ZSTD_LEVEL) -> bytes:
    """One zstd frame that states the size of its content.

    Each thread keeps one compressor for each quick level, up to 3: making one takes as long as packing a small plane.
    Those of high levels hold tens of megabytes, and are made in a hundredth of the time that a plane takes them.
    """
    if level > 3:
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


def unpack_bytes(data: bytes, limit: int, part: str) -> bytes:
    """Decompress at most ``limit`` bytes of one frame. MapvoteError beyond ``limit`` (a decompression bomb stops here),
    on damage, and where something follows the frame."""
    try:
        size = zstd.get_frame_info(data).decompressed_size
        if size is not None and size > limit:
            raise MapvoteError(f"{part} is larger than {limit} bytes when decompressed")
        frame = zstd.ZstdDecompressor()
        raw = frame.decompress(data, limit + 1 if size is None else size)
    except zstd.ZstdError as error:
        raise MapvoteError(f"{part} is damaged ({error}); fetch or send it again") from error
    if len(raw) > limit or not frame.eof:
        raise MapvoteError(f"{part} is truncated or larger than {limit} bytes when decompressed")
    if frame.unused_data:
        raise MapvoteError(f"{part} is damaged ({len(frame.unused_data)} bytes follow it); fetch or send it again")
    return raw


def frame_size(head: bytes, part: str) -> int:
    """How many bytes a frame of ours holds, from its header; MapvoteError if the header does not state it."""
    try:
        size = zstd.get_frame_info(head).decompressed_size
    except zstd.ZstdError as error:
        raise MapvoteError(f"{part} is damaged ({error}); fetch or send it again") from error
    if size is None:
        raise MapvoteError(f"{part} does not say how large it is; fetch or send it again")
    return size


def unpack_plane(data: bytes, dtype: str, shape: tuple[int, ...], part: str) -> NDArray[Any]:
    """The array that :func:`pack_plane` took; ``dtype`` little-endian, e.g. "<u8". MapvoteError if damaged.

    ``part`` names the plane in messages, e.g. "ballot: states".
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    raw = unpack_bytes(data, size, part)
    if len(raw) != size:
        raise MapvoteError(f"{part} has {len(raw)} bytes, expected {size}")
    return np.frombuffer(raw, dtype=dtype).reshape(shape)


class Words(NamedTuple):
    """The words of some cells; all others are zero."""

    cells: NDArray[np.intp]
    """(n,) flat cells of the tile, ascending."""
    words: U64
    """(n,)"""

    @classmethod
    def none(cls) -> Words:
        """No word at all."""
        return cls(np.empty(0, dtype=np.intp), np.empty(0, dtype=np.uint64))

    @classmethod
    def of(cls, plane: U64) -> Words:
        """From a (256, 256) plane."""
        flat = plane.reshape(-1)
        cells = np.flatnonzero(flat != 0)
        return cls(cells, flat[cells])

    @classmethod
    def whole(cls, cells: Bool) -> Words:
        """Every bit of the (256, 256) cells given."""
        flat = np.flatnonzero(cells)
        return cls(flat, np.full(len(flat), EVERY_BIT))

    def within(self, cells: Bool) -> Words:
        """Only those of the (256, 256) cells given."""
        return self.at(cells.reshape(-1)[self.cells])

    def where(self, others: Words) -> Words:
        """Only those of cells that ``others`` names too."""
        near = np.searchsorted(others.cells, self.cells)
        near[near == len(others.cells)] = 0
        return self.at(others.cells[near] == self.cells if len(others.cells) else near > 0)

    def outside(self, cells: NDArray[np.intp]) -> Words:
        """Only those not of the flat ``cells`` (m,), ascending."""
        near = np.minimum(np.searchsorted(cells, self.cells), len(cells) - 1)
        return self.at(cells[near] != self.cells) if len(cells) else self

    def at(self, keep: Bool | NDArray[np.intp]) -> Words:
        """Only those where ``keep`` (n,) is set, or of these indices."""
        return Words(self.cells[keep], self.words[keep])


def pack_words(words: Words) -> bytes:
    """Words of a tile as one zstd frame."""
    return compress(_by_byte(np.diff(words.cells, prepend=0), _WAY) + _by_byte(words.words, _WORD))


def unpack_sparse(data: bytes, part: str) -> Words:
    """The words that are not 0. MapvoteError if damaged; ``part`` names the plane in messages, e.g. "gone"."""
    raw = np.frombuffer(unpack_bytes(data, CELLS * (_WAY + _WORD), f"ballot: {part}"), dtype=np.uint8)
    n, left = divmod(len(raw), _WAY + _WORD)
    cells = np.empty(n, dtype=np.intp)
    words = np.empty(n, dtype=np.uint64)
    if left or not _ascending(raw, cells, words):
        raise MapvoteError(f"ballot: {part} is damaged ({len(raw)} bytes); fetch or send it again")
    return Words(cells, words)


@kernel
def _ascending(raw: U8, cells: NDArray[np.intp], words: U64) -> bool:
    """Fill ``cells`` and ``words`` (n,); whether cells ascend within the tile, and none is without a word."""
    n = len(cells)
    cell = np.int64(0)
    sound = True
    for i in range(n):
        way = np.int64(raw[i]) | (np.int64(raw[n + i]) << 8)
        cell += way
        word = np.uint64(0)
        for k in range(_WORD):
            word |= np.uint64(raw[(_WAY + k) * n + i]) << np.uint64(8 * k)
        cells[i] = cell
        words[i] = word
        sound &= (way > 0 or i == 0) and word != 0
    return bool(sound and cell < CELLS)


def _by_byte(values: NDArray[np.integer], size: int) -> bytes:
    """All lowest bytes first, then all that come next .."""
    return np.ascontiguousarray(values.astype(f"<u{size}").view(np.uint8).reshape(-1, size).T).tobytes()


def union(marked: Sequence[Words]) -> Words:
    """The bits that any of ``marked`` sets."""
    filled = [one for one in marked if len(one.cells)]
    if len(filled) < 2:
        return filled[0] if filled else Words.none()
    cells = np.concatenate([one.cells for one in filled])
    order = np.argsort(cells, kind="stable")
    cells = cells[order]
    words = np.concatenate([one.words for one in filled])[order]
    first = np.flatnonzero(np.append(True, cells[1:] != cells[:-1]))
    return Words(cells[first], np.bitwise_or.reduceat(words, first))


def nothing_reached(k: int, cells: int = CELLS) -> U64:
    """(k, cells) the bits that one, two .. k voters set, before the first voter; see :func:`mark`."""
    return np.zeros((k, cells), dtype=np.uint64)


def counted(cells: NDArray[np.intp], marked: Sequence[Words]) -> I32:
    """(n, 64) how many of ``marked`` set each bit of the flat ``cells`` (n,), few, ascending, all they name."""
    counts = np.zeros((len(cells), 64), dtype=np.int32)
    for one in marked:
        counts[np.searchsorted(cells, one.cells)] += bits_of(one.words)
    return counts


def bits_of(words: U64) -> Bool:
    """(n, 64) bits of words (n,); the inverse of :func:`words_of`."""
    return np.asarray((words[:, None] >> _BITS) & np.uint64(1)).astype(np.bool_)


def words_of(bits: Bool) -> U64:
    """(n,) words of bits (n, 64)."""
    return np.asarray((bits.astype(np.uint64) << _BITS).sum(axis=1, dtype=np.uint64))


@kernel
def mark(reached: U64, cells: NDArray[np.intp], words: U64) -> None:
    """One more voter in ``reached`` (k, cells), a running count of bits without a loop over them: bits that
    ``reached[i]`` had are now in ``reached[i + 1]`` where it sets them too. It ends as the bits that one, two .. k
    voters set."""
    for i in range(len(cells)):
        _mark_one(reached, cells[i], words[i])


@kernel
def mark_spoken(reached: U64, cells: NDArray[np.intp], words: U64, own: U8) -> None:
    """:func:`mark` of the cells of which the voter's ``own`` flat states (65536,) say anything."""
    for i in range(len(cells)):
        if own[cells[i]] != NO_VOTE:
            _mark_one(reached, cells[i], words[i])


@kernel
def mark_among(reached: U64, cells: NDArray[np.intp], words: U64, own: U8, said: int, among: NDArray[np.intp]) -> None:
    """:func:`mark` of the cells that are ``among`` these (n,), ascending too, and that the voter's ``own`` flat states
    (65536,) call ``said``; of ``reached`` (k, n) by their place among them."""
    k = 0
    for i in range(len(cells)):
        while k < len(among) and among[k] < cells[i]:
            k += 1
        if k < len(among) and among[k] == cells[i] and own[cells[i]] == said:
            _mark_one(reached, k, words[i])


@kernel
def agreeing(cells: NDArray[np.intp], own: U8, decided: U8, state: int, found: NDArray[np.intp]) -> int:
    """How many of the flat ``cells`` (n,) are ``state`` in a voter's ``own`` states and in the ``decided`` ones,
    (65536,) each; their indices into ``found`` (n,)."""
    n = 0
    for i in range(len(cells)):
        if decided[cells[i]] == state and own[cells[i]] == state:
            found[n] = i
            n += 1
    return n


@inlined
def _mark_one(reached: U64, cell: int, word: np.uint64) -> None:
    for level in range(reached.shape[0] - 1, 0, -1):
        reached[level, cell] |= reached[level - 1, cell] & word
    reached[0, cell] |= word
