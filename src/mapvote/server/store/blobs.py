"""A tile as content-addressed planes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.codec.arrays import compress, unpack_bytes
from mapvote.core.grid import CELLS, TILE_CELLS, Grid
from mapvote.core.memory import PLANES, Memory
from mapvote.core.tile import Tile
from mapvote.core.types import F32, U64, Bool, MapvoteError

_ZSTD_LEVEL = 3
MAX_PLANE_BYTES = CELLS * 64 * 12 * 4


@dataclass(frozen=True, slots=True)
class TileHashes:
    """One tile of a manifest. ``points`` is what ballots name as their base."""

    points: str
    ground: str
    free: str | None
    memory: str | None = field(default=None, compare=False)
    """What the server remembers of the tile; no part of the map, so tiles that differ in nothing else are equal."""

    @classmethod
    def none(cls) -> TileHashes:
        """Of a tile that a version does not have any more."""
        return cls("", "", None)


def pack_tile(tile: Tile, edited_from: tuple[Tile, TileHashes] | None = None) -> tuple[TileHashes, dict[str, bytes]]:
    """A tile's hashes and its planes by hash, each one zstd frame of little-endian C-order values.

    Of a tile ``edited_from`` another, only the planes that the other does not have: the ground is never edited.
    """
    blobs: dict[str, bytes] = {}
    old, known = edited_from or (None, TileHashes.none())

    def pack(plane: NDArray[Any], dtype: str) -> str:
        raw = np.ascontiguousarray(plane, dtype=dtype).tobytes()
        digest = hashlib.sha256(raw).hexdigest()
        blobs[digest] = compress(raw, _ZSTD_LEVEL)
        return digest

    points = pack(tile.points, "<f4")
    ground = known.ground if old is not None and tile.ground_z is old.ground_z else pack(tile.ground_z, "<f4")
    same = old is not None and tile.free is old.free
    free = known.free if same or tile.free is None else pack(tile.free, "<u8")
    if tile.memory is None:
        return TileHashes(points, ground, free), blobs
    memory, plane = pack_memory(tile.memory)
    return TileHashes(points, ground, free, memory), blobs | plane


def unpack_tile(
    window: Grid, hashes: TileHashes, points: bytes, ground: bytes, free: bytes | None, memory: bytes | None = None
) -> Tile:
    """A tile of its planes; MapvoteError if one is not what its hash says."""
    return Tile(
        window,
        points=unpack_points_plane(points, hashes.points),
        ground_z=unpack_ground_plane(ground, hashes.ground),
        free=None if free is None or hashes.free is None else unpack_free_plane(free, hashes.free),
        memory=None if memory is None or hashes.memory is None else unpack_memory_plane(memory, hashes.memory),
    )


def unpack_points_plane(data: bytes, digest: str) -> F32:
    """The points plane of a tile alone."""
    return np.frombuffer(_unpack(data, digest), dtype="<f4").reshape(-1, 3)


def unpack_ground_plane(data: bytes, digest: str) -> F32:
    """(256, 256) the ground plane of a tile alone."""
    return np.frombuffer(_unpack(data, digest), dtype="<f4").reshape(TILE_CELLS, TILE_CELLS)


def unpack_free_plane(data: bytes, digest: str) -> U64:
    """(256, 256) the plane of known-free column words of a tile alone."""
    return np.frombuffer(_unpack(data, digest), dtype="<u8").reshape(TILE_CELLS, TILE_CELLS)


def _unpack(data: bytes, digest: str) -> bytes:
    raw = unpack_bytes(data, MAX_PLANE_BYTES, f"tile plane {digest[:12]}")
    if hashlib.sha256(raw).hexdigest() != digest:
        raise MapvoteError(f"tile plane {digest[:12]} is not what its hash says; fetch it again")
    return raw


def pack_memory(memory: Memory) -> tuple[str, dict[str, bytes]]:
    """What a tile remembers as (hash, plane by hash)."""
    raw = np.ascontiguousarray(memory.planes, dtype="<u4").tobytes()
    digest = hashlib.sha256(raw).hexdigest()
    return digest, {digest: compress(raw, _ZSTD_LEVEL)}


def unpack_memory_plane(data: bytes, digest: str) -> Memory:
    """The inverse; MapvoteError if it is not what its hash says."""
    return Memory(np.frombuffer(_unpack(data, digest), dtype="<u4").reshape(PLANES, TILE_CELLS, TILE_CELLS))


def pack_cells(cells: Bool) -> bytes:
    """(256, 256) bool as a small blob."""
    return compress(np.packbits(cells.reshape(-1)).tobytes(), _ZSTD_LEVEL)


def unpack_cells(data: bytes) -> Bool:
    """The inverse of :func:`pack_cells`."""
    bits = np.unpackbits(np.frombuffer(unpack_bytes(data, CELLS // 8, "cells"), dtype=np.uint8))
    return bits.astype(np.bool_).reshape(TILE_CELLS, TILE_CELLS)
