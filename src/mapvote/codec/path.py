"""The path of a vehicle in its ballot: a cell of the lattice every few metres, for display.

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
    for tile in np.unique(unpack_path(data) // TILE_CELLS, axis=0):
        if not _is_near(tile, tiles):
            raise MapvoteError(f"{_WHAT} leads over tile {tile[0]},{tile[1]}, far from where the drive voted")


def path_near(data: bytes, tiles: Collection[TileIndex]) -> bytes:
    """The path without what is farther than a tile from ``tiles``."""
    cells = unpack_path(data)
    passed, which = np.unique(cells // TILE_CELLS, axis=0, return_inverse=True)
    near = np.array([_is_near(tile, tiles) for tile in passed], dtype=np.bool_)
    kept = cells[near[which.ravel()]]
    return pack_plane(np.diff(kept, axis=0, prepend=np.zeros((1, 2), np.int64)).astype(np.int32))


def _is_near(tile: I64, voted: Collection[TileIndex]) -> bool:
    others = np.array(list(voted), dtype=np.int64).reshape(-1, 2)
    return bool((np.abs(others - tile).max(axis=1, initial=0) <= 1).any())
