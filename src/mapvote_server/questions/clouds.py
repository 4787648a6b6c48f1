"""The 3D page's point clouds: the levels of a store's tiles, overviews, points added and deleted."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapvote.codec.manifest import TileHashes
from mapvote.codec.tile_planes import unpack_fields_plane
from mapvote.core.brightness import in_bytes
from mapvote.core.grid import Lattice, TileIndex
from mapvote.core.record import record
from mapvote.core.tile import Tile
from mapvote.core.types import U8, MapvoteError
from mapvote.shapes.packed_cloud import Levels, came_and_went, make_levels
from mapvote_server.errors import Unavailable
from mapvote_server.store.queries import load_blob, load_tile, tiles_of, tiles_that_differ, version_of
from mapvote_server.store.store import Store


@record()
@dataclass(frozen=True, slots=True)
class OverviewSizes:
    """Sizes of the overview of a map."""

    points: int = 150_000
    """Points of an overview: 1.2 MB, one to two seconds of a slow connection."""
    spare: int = 2
    """Points that a tile keeps for later overviews, as a multiple of its even share, rounded up to a power of two: a
    map of any size fits in memory."""
    threads: int = 2
    """Threads for an overview: reading and sorting release the interpreter."""
    kept_bytes: int = 256_000_000
    """Memory of overviews that are kept, bytes."""


OVERVIEW_SIZES = OverviewSizes()
_ANYWHERE = Lattice().tile((0, 0))
"""Coordinates of levels begin at the tile's corner, so the window does not matter."""
_HEAD = "<i4,<i4,<i4,<u4,<f4,<f4"
_OVERVIEW_MAGIC = 0x3143564F


class _Drawn(NamedTuple):
    """Planes that the coarse picture of a tile follows from."""

    points: str
    ground: str
    fields: str | None
    share: int
    """Points that it keeps at most."""

    @classmethod
    def of(cls, hashes: TileHashes, share: int) -> _Drawn:
        """The coarse picture of a tile with these planes."""
        return cls(hashes.points, hashes.ground, hashes.fields, share)


class Clouds:
    """Levels of detail of a store's tiles, made at the first request and cached (least recently used go); thread-safe.

    A tile's levels follow from its hashes alone, so the cache is never stale.
    """

    def __init__(self, store: Store, kept_bytes: int = OVERVIEW_SIZES.kept_bytes) -> None:
        self._store = store
        self._room = kept_bytes
        self._lock = threading.Lock()
        self._making = threading.Lock()
        self._made: OrderedDict[TileHashes, Levels] = OrderedDict()
        self._overview: tuple[int, bytes] = 0, b""
        self._coarse: dict[_Drawn, Levels] = {}
        """The tiles of the overview."""
        self._proposed: Mapping[TileHashes, Callable[[], Tile]] = {}

    def propose(self, tiles: Iterable[tuple[TileHashes, Callable[[], Tile]]]) -> None:
        """Tiles of no version yet, as a publish would make them; :meth:`levels` serves them until the next call."""
        self._proposed = {_drawn(hashes): make for hashes, make in tiles}

    def levels(self, hashes: TileHashes) -> Levels:
        """The levels of one tile; NotFound if no version ever held it and none is proposed."""
        with self._lock:
            kept = self._made.get(hashes)
            if kept is not None:
                self._made.move_to_end(hashes)
                return kept
        proposed = self._proposed.get(hashes)
        (tile,) = self._load(hashes) if proposed is None else (proposed(),)
        made = make_levels(tile.points, tile.ground_z, bright=self._bright(hashes, tile))
        with self._lock:
            if hashes not in self._made:
                self._made[hashes] = made
                self._room -= made.nbytes
            while self._room < 0 and len(self._made) > 1:
                _, dropped = self._made.popitem(last=False)
                self._room += dropped.nbytes
        return made

    def overview(self, version: int, stop: Callable[[], bool] = lambda: False) -> bytes:
        """All tiles of a version, coarse: as many whole levels as 150,000 points allow, or an even share of the first.

        uint32 0x3143564F, uint32 number of tiles; for each tile int32 row, int32 col, int32 last whole level (-1: a
        part of the first), uint32 points, float32 z0_m, float32 z_step_m; then all points as in :class:`Levels`, and if
        any tile has intensity then that of all, a byte each.
        ``stop`` ends the work early, with nothing to show. NotFound if there is no such version.
        """
        with self._making:  # of concurrent requests, one makes it
            if self._overview[0] != version:
                made = self._made_coarse(version, stop)
                if made is None:
                    return b""
                self._overview = version, _overview_bytes(made)
            return self._overview[1]

    def _made_coarse(self, version: int, stop: Callable[[], bool]) -> list[tuple[TileIndex, Levels]] | None:
        """Tiles that the last overview has too are not made again."""
        with self._store.database.reading() as connection:
            version_of(connection, version)
            tiles = tiles_of(connection, version)
        share = _share(len(tiles))

        def made(hashes: TileHashes) -> Levels | None:
            kept = self._coarse.get(_Drawn.of(hashes, share))
            if kept is not None or stop():
                return kept
            for tile in self._sound(hashes):
                return make_levels(tile.points, tile.ground_z, share, self._bright(hashes, tile))
            return None

        with ThreadPoolExecutor(OVERVIEW_SIZES.threads, "coarse") as pool:
            levels_of = dict(zip(tiles, pool.map(made, tiles.values()), strict=True))
        if stop():
            return None
        sound = {index: levels for index, levels in levels_of.items() if levels is not None}
        self._coarse = {_Drawn.of(tiles[index], share): levels for index, levels in sound.items()}
        return list(sound.items())

    def _bright(self, hashes: TileHashes, tile: Tile) -> U8 | None:
        """(n,) the intensity of a tile's points, 255 for 1.0; None if it has none, or that is damaged."""
        if hashes.fields is None:
            return None
        try:
            with self._store.database.reading() as connection:
                packed = load_blob(connection, hashes.fields)
            intensity = unpack_fields_plane(packed, hashes.fields, len(tile.points)).get("intensity")
        except Unavailable:
            raise
        except MapvoteError:
            return None
        return None if intensity is None else in_bytes(intensity)

    def _load(self, *states: TileHashes | None) -> list[Tile]:
        """Tiles, of which points and ground alone are read."""
        with self._store.database.reading() as connection:
            return [load_tile(connection, _ANYWHERE, hashes and _drawn(hashes)) for hashes in states]

    def _sound(self, *states: TileHashes | None) -> list[Tile]:
        """The same; none where one is damaged (a request for the tile itself gets the error)."""
        try:
            return self._load(*states)
        except Unavailable:
            raise
        except MapvoteError:
            return []

    def changed(self, old: int, new: int) -> bytes:
        """Points that differ from version ``old`` to ``new``: of each tile that differs int32 row, int32 col, the
        points that only ``old`` has, then those that only ``new`` has, both as :func:`cloud_bytes`. Damaged tiles are
        left out.

        NotFound if one of the versions does not exist.
        """
        with self._store.database.reading() as connection:
            differ = tiles_that_differ(connection, old, new)
        pairs = [self._sound(*states) for _, *states in differ]
        placed = [(index, pair) for (index, *_), pair in zip(differ, pairs, strict=True) if pair]
        return b"".join(came_and_went(before, after, index) for index, (before, after) in placed)


def _share(tiles: int) -> int:
    """Points that a tile of so many keeps at most: a power of two, so that it seldom changes while a map grows."""
    return 1 << (OVERVIEW_SIZES.spare * OVERVIEW_SIZES.points // max(tiles, 1)).bit_length()


def _drawn(hashes: TileHashes) -> TileHashes:
    """Levels of points and ground only."""
    return TileHashes(hashes.points, hashes.ground, None)


def _overview_bytes(made: Sequence[tuple[TileIndex, Levels]]) -> bytes:
    ends = np.array([levels.ends for _, levels in made]).reshape(len(made), -1)
    fits = np.flatnonzero(ends.sum(axis=0) <= OVERVIEW_SIZES.points)
    finest = int(fits[-1]) if len(fits) else -1
    share = OVERVIEW_SIZES.points // max(len(made), 1)
    rows = []
    clouds = []
    bright = []
    any_bright = any(levels.bright is not None for _, levels in made)
    for index, levels in made:
        whole = min(finest, int(np.searchsorted(levels.ends, len(levels.packed), side="right")) - 1)
        points = int(levels.ends[whole]) if whole >= 0 else min(share, len(levels.packed))
        rows.append((*index, whole, points, levels.z0_m, levels.z_step_m))
        clouds.append(np.ascontiguousarray(levels.packed[:points], dtype="<u2").tobytes())
        if any_bright:
            bright.append(bytes(points) if levels.bright is None else levels.bright[:points].tobytes())
    head = np.array([_OVERVIEW_MAGIC, len(made)], dtype="<u4").tobytes(), np.array(rows, dtype=_HEAD).tobytes()
    return b"".join([*head, *clouds, *bright])
