"""Map tile <-> bytes: what lies in a map folder and what the server sends (docs/decisions/data.md)."""

from __future__ import annotations

import hashlib
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from mapvote.codec.arrays import pack_plane, unpack_plane
from mapvote.codec.fields import check_kind, kind_of
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Grid
from mapvote.core.tile import Tile
from mapvote.core.tile_history import PLANES, Memory
from mapvote.core.types import F32, U64, MapvoteError

TILE_VERSION = 1
MAX_TILE_POINTS = 50_000_000
"""8,000 points per square metre; 600 MB. Nothing honest is denser."""
_LEVEL = 3
_SHAPE = (TILE_CELLS, TILE_CELLS)


class _TileFile(msgspec.Struct, frozen=True, kw_only=True):
    """The envelope. Planes a newer version adds are ignored; a higher ``tile_version`` is refused."""

    tile_version: int
    n_points: int
    points: bytes
    ground_z: bytes
    free: bytes | None = None
    memory: bytes | None = None
    fields: dict[str, tuple[str, bytes]] = {}
    """Type and values of each field of the points."""


_TILE_FILE = msgspec.msgpack.Decoder(_TileFile)  # made when the module is loaded: see codec/ballot.py


def content_hash(tile_points: F32) -> str:
    """SHA-256 of a tile's points: free space learned later changes no published point (docs/decisions/data.md)."""
    return hashlib.sha256(np.ascontiguousarray(tile_points, dtype="<f4").tobytes()).hexdigest()


def base_hash(tile: Tile | None) -> str:
    """The content hash that a ballot gives for this tile: "" where the map has none."""
    return "" if tile is None else content_hash(tile.points)


def free_hash(free: U64 | None) -> str:
    """SHA-256 of a tile's known-free columns; "" where none were ever learned."""
    return "" if free is None else hashlib.sha256(np.ascontiguousarray(free, dtype="<u8").tobytes()).hexdigest()


def encode_tile(tile: Tile) -> bytes:
    """The tile as one self-contained byte string: equal tiles, equal bytes."""
    return msgspec.msgpack.encode(
        _TileFile(
            tile_version=TILE_VERSION,
            n_points=len(tile.points),
            points=pack_plane(tile.points, _LEVEL),
            ground_z=pack_plane(tile.ground_z, _LEVEL),
            free=None if tile.free is None else pack_plane(tile.free, _LEVEL),
            memory=None if tile.memory is None else pack_plane(tile.memory.planes, _LEVEL),
            fields={name: (kind_of(c), pack_plane(c, _LEVEL)) for name, c in tile.fields.items()},
        )
    )


def decode_tile(data: bytes, window: Grid, what: str = "tile") -> Tile:
    """The tile over ``window`` that :func:`encode_tile` took; ``what`` names it in a MapvoteError if it is unusable."""
    try:
        file = _TILE_FILE.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MapvoteError(f"{what}: not a map tile ({error}); fetch it again") from error
    if not 1 <= file.tile_version <= TILE_VERSION:
        raise MapvoteError(f"{what}: tile format {file.tile_version}, but this mapvote reads up to {TILE_VERSION}")
    if not 0 <= file.n_points <= MAX_TILE_POINTS:
        raise MapvoteError(f"{what}: claims {file.n_points} points; a tile holds at most {MAX_TILE_POINTS}")
    points = unpack_plane(file.points, "<f4", (file.n_points, 3), f"{what}: points")
    side = np.float32(TILE_CELLS * CELL_SIZE)
    if not (np.isfinite(points).all() and (points[:, :2] >= 0).all() and (points[:, :2] < side).all()):
        raise MapvoteError(f"{what}: holds a point outside the tile or not finite; fetch it again")
    ground_z = unpack_plane(file.ground_z, "<f4", _SHAPE, f"{what}: ground_z")
    free = None if file.free is None else unpack_plane(file.free, "<u8", _SHAPE, f"{what}: free")
    memory = None if file.memory is None else unpack_memory(file.memory, f"{what}: memory")
    fields = {name: _unpack_field(*about, file.n_points, f"{what}: {name}") for name, about in file.fields.items()}
    return Tile(window, points, ground_z, free, memory, fields)


def _unpack_field(kind: str, data: bytes, n: int, what: str) -> NDArray[Any]:
    """(n,) one field; MapvoteError if it is damaged or no column of numbers."""
    check_kind(kind, what)
    return unpack_plane(data, kind, (n,), what)


def unpack_memory(data: bytes, what: str) -> Memory:
    """What a tile remembers, of its packed planes; MapvoteError if damaged."""
    return Memory.of(unpack_plane(data, "<u4", (PLANES, *_SHAPE), what))
