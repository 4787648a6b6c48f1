"""A map tile <-> content-addressed planes, each one zstd frame: in a server's store, on the wire, in a client's cache
and in a map folder (docs/decisions/data.md)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.codec.ballot import tile_key
from mapvote.codec.fields import decode_fields, pack_fields, unpack_fields
from mapvote.codec.manifest import TileHashes
from mapvote.codec.planes import compress, frame_size, raw_plane, unpack_bytes
from mapvote.core.grid import CELLS, TILE_CELLS, Grid
from mapvote.core.record import record
from mapvote.core.tile import PLANES, Memory, Tile
from mapvote.core.types import F32, U64, Bool, MapvoteError


@record()
@dataclass(frozen=True, slots=True)
class TilePlaneSizes:
    """Compression and largest sizes of a tile's planes."""

    zstd_level: int = 2
    """Level of zstd: noisy float32 gains nothing above level 3."""
    points: int = 50_000_000
    """Points of the densest tile: 8,000 per square metre, 600 MB."""
    plane_bytes: int = 16 * points
    """Bytes of the largest plane, 800 MB: 16 for each point of the densest tile."""


TILE_PLANE_SIZES = TilePlaneSizes()


def base_hash(tile: Tile | None) -> str:
    """The digest that a ballot names as its base: SHA-256 of a tile's points, "" where the map has none. Free space
    learned later changes no published point (docs/decisions/data.md)."""
    return "" if tile is None else hashlib.sha256(raw_plane(tile.points, "<f4")).hexdigest()


def pack_tile(tile: Tile, edited_from: tuple[Tile, TileHashes] | None = None) -> tuple[TileHashes, dict[str, bytes]]:
    """A tile's hashes and its planes by hash, each one zstd frame of little-endian C-order values.

    A tile ``edited_from`` another gives only the planes that the other lacks: the ground is never edited.
    """
    blobs: dict[str, bytes] = {}
    old, old_hashes = edited_from or (None, TileHashes.none())

    def pack(raw: bytes | memoryview, part: str) -> str:
        if len(raw) > TILE_PLANE_SIZES.plane_bytes:
            too_large = (
                f"{len(raw)} bytes, {TILE_PLANE_SIZES.plane_bytes} are the most: thin the map out, or leave fields out"
            )
            raise MapvoteError(f"tile {tile_key(tile.index)}: its {part} take {too_large}")
        digest, plane = _packed(raw)
        blobs.update(plane)
        return digest

    same_ground, same_free, same_fields = (
        old is not None and getattr(tile, plane) is getattr(old, plane) for plane in ("ground_z", "free", "fields")
    )
    hashes = TileHashes(
        points=pack(raw_plane(tile.points, "<f4"), "points"),
        ground=old_hashes.ground if same_ground else pack(raw_plane(tile.ground_z, "<f4"), "ground"),
        free=old_hashes.free if same_free or tile.free is None else pack(raw_plane(tile.free, "<u8"), "free columns"),
        memory=None if tile.memory is None else pack(_raw_memory(tile.memory), "memory"),
        fields=old_hashes.fields if same_fields else pack(pack_fields(tile.fields), "fields") if tile.fields else None,
    )
    return hashes, blobs


def unpack_tile(window: Grid, hashes: TileHashes, planes: Mapping[str, bytes]) -> Tile:
    """A tile of its ``planes`` by name, of those that ``hashes`` names; MapvoteError if one is not what its hash
    says."""
    points = unpack_points_plane(planes["points"], hashes.points)
    return Tile(
        window,
        points=points,
        ground_z=unpack_ground_plane(planes["ground"], hashes.ground),
        free=None if hashes.free is None else unpack_free_plane(planes["free"], hashes.free),
        memory=None if hashes.memory is None else unpack_memory_plane(planes["memory"], hashes.memory),
        fields={} if hashes.fields is None else unpack_fields_plane(planes["fields"], hashes.fields, len(points)),
    )


def unpack_points_plane(data: bytes, digest: str) -> F32:
    """The points plane of a tile alone."""
    return _values(data, digest, "<f4", (-1, 3))


def points_in_plane(head: bytes, digest: str) -> int:
    """How many points a points plane holds, of the first ``FRAME_HEAD`` bytes of its frame; MapvoteError if they are no
    frame's."""
    return frame_size(head, f"tile plane {digest[:12]}") // 12


def unpack_ground_plane(data: bytes, digest: str) -> F32:
    """(256, 256) the ground plane of a tile alone."""
    return _values(data, digest, "<f4", (TILE_CELLS, TILE_CELLS))


def unpack_free_plane(data: bytes, digest: str) -> U64:
    """(256, 256) the plane of known-free column words of a tile alone."""
    return _values(data, digest, "<u8", (TILE_CELLS, TILE_CELLS))


def _values(data: bytes, digest: str, dtype: str, shape: tuple[int, int]) -> NDArray[Any]:
    values = np.frombuffer(check_plane(data, digest), dtype="u1")
    row = abs(shape[1]) * np.dtype(dtype).itemsize
    if len(values) % row or (shape[0] >= 0 and len(values) != shape[0] * row):
        raise _wrong_size(len(values), digest)
    return values.view(dtype).reshape(shape)


def _wrong_size(size: int, digest: str) -> MapvoteError:
    return MapvoteError(f"tile plane {digest[:12]} has {size} bytes, which no plane of its kind has; fetch it again")


def unpack_fields_plane(data: bytes, digest: str, n: int) -> dict[str, NDArray[Any]]:
    """The fields of a tile's ``n`` points alone."""
    return unpack_fields(check_plane(data, digest), n, f"tile plane {digest[:12]}")


def names_in_plane(data: bytes, digest: str) -> list[str]:
    """The content of a plane of fields."""
    return list(decode_fields(check_plane(data, digest), f"tile plane {digest[:12]}"))


def check_plane(data: bytes, digest: str) -> bytes:
    """The content of a plane; MapvoteError if it is not what its hash says."""
    raw = unpack_bytes(data, TILE_PLANE_SIZES.plane_bytes, f"tile plane {digest[:12]}")
    if hashlib.sha256(raw).hexdigest() != digest:
        raise MapvoteError(f"tile plane {digest[:12]} does not match its hash; fetch it again")
    return raw


def pack_memory(memory: Memory) -> tuple[str, dict[str, bytes]]:
    """The memory of a tile as (hash, plane by hash)."""
    return _packed(_raw_memory(memory))


def _packed(raw: bytes | memoryview) -> tuple[str, dict[str, bytes]]:
    digest = hashlib.sha256(raw).hexdigest()
    return digest, {digest: compress(raw, TILE_PLANE_SIZES.zstd_level)}


def _raw_memory(memory: Memory) -> bytes:
    """The cells of which anything is remembered, for they are few: the way to each from the one before, two bytes, and
    then their values, plane by plane."""
    ways = memory.cells.copy()
    ways[1:] -= memory.cells[:-1]
    return ways.astype("<u2").tobytes() + memory.values.astype("<u4", order="C").tobytes()


def unpack_memory_plane(data: bytes, digest: str) -> Memory:
    """The memory of a tile; MapvoteError if it does not match its hash."""
    raw = check_plane(data, digest)
    n, rest = divmod(len(raw), 2 + 4 * PLANES)
    cells = np.cumsum(np.frombuffer(raw, dtype="<u2", count=n), dtype=np.int64)
    if rest or (n and cells[-1] >= CELLS):
        raise _wrong_size(len(raw), digest)
    return Memory(cells, np.frombuffer(raw, dtype="<u4", offset=2 * n).reshape(PLANES, n))


def pack_cells(cells: Bool) -> bytes:
    """(256, 256) bool as a small blob."""
    return compress(np.packbits(cells.reshape(-1)).tobytes(), TILE_PLANE_SIZES.zstd_level)


def unpack_cells(data: bytes) -> Bool:
    """The inverse of :func:`pack_cells`."""
    bits = np.unpackbits(np.frombuffer(unpack_bytes(data, CELLS // 8, "cells"), dtype=np.uint8))
    return bits.astype(np.bool_).reshape(TILE_CELLS, TILE_CELLS)
