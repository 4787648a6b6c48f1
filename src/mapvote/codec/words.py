"""Column words of a tile <-> bytes: only those that are not zero, for masks and free space mark few of its cells.

Under zstd lie the ways from each cell to the next as two planes of bytes, then the words as eight: bytes that mean the
same lie together, which packs a fifth smaller than the words as they are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapvote.codec.arrays import compress, unpack_bytes
from mapvote.core.grid import CELLS, TILE_CELLS
from mapvote.core.kernel import kernel
from mapvote.core.types import U8, U64, MapvoteError

_WAY, _WORD = 2, 8
"""Bytes of the way to a cell, and of its word."""


def pack_words(plane: U64) -> bytes:
    """A (256, 256) plane."""
    flat = plane.reshape(-1)
    cells = np.flatnonzero(flat)
    return compress(_by_byte(np.diff(cells, prepend=0), _WAY) + _by_byte(flat[cells], _WORD))


def unpack_sparse(data: bytes, what: str) -> tuple[NDArray[np.intp], U64]:
    """(flat cells (n,), ascending; their words (n,), none of them 0). MapvoteError if damaged.

    ``what`` names the plane in messages, e.g. "gone".
    """
    raw = np.frombuffer(unpack_bytes(data, CELLS * (_WAY + _WORD), f"ballot: {what}"), dtype=np.uint8)
    n, left = divmod(len(raw), _WAY + _WORD)
    cells, words = np.empty(n, dtype=np.intp), np.empty(n, dtype=np.uint64)
    if left or not _ascending(raw, cells, words):
        raise MapvoteError(f"ballot: {what} is damaged ({len(raw)} bytes); fetch or send it again")
    return cells, words


@kernel
def _ascending(raw: U8, cells: NDArray[np.intp], words: U64) -> bool:
    """Fill ``cells`` and ``words`` (n,); whether cells ascend within the tile, and none is without a word."""
    n, cell, sound = len(cells), np.int64(0), True
    for i in range(n):
        way = np.int64(raw[i]) | (np.int64(raw[n + i]) << 8)
        cell += way
        word = np.uint64(0)
        for k in range(_WORD):
            word |= np.uint64(raw[(_WAY + k) * n + i]) << np.uint64(8 * k)
        cells[i], words[i] = cell, word
        sound &= (way > 0 or i == 0) and word != 0
    return bool(sound and cell < CELLS)


def unpack_words(data: bytes, what: str) -> U64:
    """(256, 256) uint64; MapvoteError if damaged."""
    cells, words = unpack_sparse(data, what)
    plane = np.zeros(CELLS, dtype=np.uint64)
    plane[cells] = words
    return plane.reshape(TILE_CELLS, TILE_CELLS)


def _by_byte(values: NDArray[np.integer], size: int) -> bytes:
    """All lowest bytes first, then all that come next .."""
    return np.ascontiguousarray(values.astype(f"<u{size}").view(np.uint8).reshape(-1, size).T).tobytes()
