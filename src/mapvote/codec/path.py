"""Where a vehicle drove, as its ballot tells it: a cell of the lattice every few metres, for people to look at.

Cells as steps from one to the next, int32, under zstd: two hundred bytes for a kilometre.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from mapvote.codec.arrays import pack_plane, unpack_bytes
from mapvote.core.grid import TILE_CELLS, Lattice, TileIndex
from mapvote.core.types import F64, I64, MapvoteError

STEP_M = 5.0
"""Between two cells of a path, at least."""
MAX_CELLS = 100_000
_WHAT = "ballot: path"


def pack_path(positions: Sequence[F64], lattice: Lattice) -> bytes:
    """Positions (x, y, ..) in map metres, in the order driven, thinned to one every STEP_M; the first and last stay."""
    kept: list[F64] = []
    for position in positions:
        if not kept or np.hypot(*(position[:2] - kept[-1][:2])) >= STEP_M:
            kept.append(position)
    if len(positions):
        kept.append(positions[-1])
    cells = np.stack(lattice.cells_of(np.reshape(kept, (len(kept), -1))[:MAX_CELLS]), axis=1)
    return pack_plane(np.diff(cells, axis=0, prepend=0).astype(np.int32))


def unpack_path(data: bytes) -> I64:
    """(n, 2) rows and columns on the lattice; MapvoteError if damaged."""
    raw = unpack_bytes(data, 8 * MAX_CELLS, _WHAT)
    if len(raw) % 8:
        raise MapvoteError(f"{_WHAT} has {len(raw)} bytes, not a multiple of 8")
    return np.cumsum(np.frombuffer(raw, dtype="<i4").reshape(-1, 2).astype(np.int64), axis=0)


def check_path(data: bytes, tiles: Collection[TileIndex]) -> None:
    """MapvoteError unless the path is sound and never farther than a tile from ``tiles``, on which its drive voted."""
    passed = np.unique(unpack_path(data) // TILE_CELLS, axis=0)
    voted = np.array(list(tiles), dtype=np.int64).reshape(-1, 2)
    for tile in passed:
        if not (np.abs(voted - tile).max(axis=1, initial=0) <= 1).any():
            raise MapvoteError(f"{_WHAT} leads over tile {tile[0]},{tile[1]}, far from where the drive voted")
