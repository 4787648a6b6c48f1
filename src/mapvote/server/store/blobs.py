"""A tile as content-addressed planes, and which cells of two tiles hold the same points."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from mapvote.codec.arrays import compress, pack_plane, unpack_bytes, unpack_plane
from mapvote.core.grid import CELLS, TILE_CELLS, Grid
from mapvote.core.tile import Tile
from mapvote.core.types import F32, I64, U64, Bool, MapvoteError

_ZSTD_LEVEL = 3
MAX_PLANE_BYTES = CELLS * 64 * 12 * 4


@dataclass(frozen=True, slots=True)
class TileHashes:
    """One tile of a manifest. ``points`` is what ballots name as their base."""

    points: str
    ground: str
    free: str | None


def pack_tile(tile: Tile) -> tuple[TileHashes, dict[str, bytes]]:
    """A tile's hashes and its planes by hash, each one zstd frame of little-endian C-order values."""
    blobs: dict[str, bytes] = {}

    def pack(plane: NDArray[Any], dtype: str) -> str:
        raw = np.ascontiguousarray(plane, dtype=dtype).tobytes()
        digest = hashlib.sha256(raw).hexdigest()
        blobs[digest] = compress(raw, _ZSTD_LEVEL)
        return digest

    points = pack(tile.points, "<f4")
    ground = pack(tile.ground_z, "<f4")
    return TileHashes(points, ground, None if tile.free is None else pack(tile.free, "<u8")), blobs


def unpack_tile(window: Grid, hashes: TileHashes, points: bytes, ground: bytes, free: bytes | None) -> Tile:
    """A tile of its planes; MapvoteError if one is not what its hash says."""
    return Tile(
        window,
        points=unpack_points_plane(points, hashes.points),
        ground_z=np.frombuffer(_unpack(ground, hashes.ground), dtype="<f4").reshape(window.shape),
        free=None
        if free is None or hashes.free is None
        else np.frombuffer(_unpack(free, hashes.free), dtype="<u8").reshape(window.shape),
    )


def unpack_points_plane(data: bytes, digest: str) -> F32:
    """The points plane of a tile alone."""
    return np.frombuffer(_unpack(data, digest), dtype="<f4").reshape(-1, 3)


def _unpack(data: bytes, digest: str) -> bytes:
    raw = unpack_bytes(data, MAX_PLANE_BYTES, f"tile plane {digest[:12]}")
    if hashlib.sha256(raw).hexdigest() != digest:
        raise MapvoteError(f"tile plane {digest[:12]} is not what its hash says; fetch it again")
    return raw


def same_cells(a: F32 | None, b: F32 | None, grid: Grid) -> Bool:
    """(256, 256) where two versions of a tile's points hold the same, bit for bit and in the same order."""
    return np.asarray(_digests(a, grid) == _digests(b, grid)).reshape(TILE_CELLS, TILE_CELLS)


def _digests(points: F32 | None, grid: Grid) -> U64:
    if points is None or not len(points):
        return np.zeros(CELLS, dtype=np.uint64)
    return _cell_digests(grid.flat_cells(points), np.ascontiguousarray(points).view(np.uint32))


@numba.njit(cache=True, nogil=True)
def _cell_digests(cells: I64, words: NDArray[np.uint32]) -> U64:
    """(65536,) a 64-bit FNV-1a hash over the words of each cell's points (n, 3), 0 for a cell without points."""
    out = np.zeros(65536, dtype=np.uint64)
    for i in range(len(cells)):
        h = out[cells[i]]
        if h == 0:
            h = np.uint64(0xCBF29CE484222325)
        for k in range(3):
            h = (h ^ np.uint64(words[i, k])) * np.uint64(0x100000001B3)
        out[cells[i]] = h
    return out


def pack_cells(cells: Bool) -> bytes:
    """(256, 256) bool as a small blob."""
    return pack_plane(np.packbits(cells.reshape(-1)), _ZSTD_LEVEL)


def unpack_cells(data: bytes) -> Bool:
    """The inverse of :func:`pack_cells`."""
    bits = np.unpackbits(unpack_plane(data, "<u1", (CELLS // 8,), "cells of a version"))
    return bits.astype(np.bool_).reshape(TILE_CELLS, TILE_CELLS)
