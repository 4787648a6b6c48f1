"""The map of a live vehicle: from a file or store, or a server's.

A server's tiles are downloaded before the vehicle arrives, and newer versions when they are published.
"""

from __future__ import annotations

import logging
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from mapvote.client import Manifest, MapClient, Refused, Unreachable
from mapvote.codec.ballot import tile_index
from mapvote.core.grid import Lattice, TileIndex, window_around
from mapvote.core.point_map import LazyTiles, PointMap
from mapvote.core.record import record
from mapvote.core.tile import Tile
from mapvote.core.types import F64, MapvoteError
from mapvote.matching.ndt_map import tiles_within

log = logging.getLogger("mapvote.live")


@record()
@dataclass(frozen=True, slots=True)
class RoadMapReach:
    """Reaches and waits of the map around a live vehicle."""

    kept_m: float = 300.0
    """Half the side of the square whose tiles stay in memory, metres; the columns and words of farther tiles go,
    too."""
    moved_m: float = 30.0
    """Distance after which the tiles are chosen anew, metres."""
    ahead_m: float = kept_m
    """Half the side of the square whose tiles are downloaded, metres."""
    needed_m: float = 160.0
    """Half the side of the square without whose tiles no scan is used, metres. The local map of a vehicle reaches two
    tiles, 154 m."""
    poll_s: float = 60.0
    """Time between two requests of the newest version where events do not come, seconds."""
    retry_s: float = 5.0
    """Time between two attempts to reach a server, seconds."""


ROAD_MAP_REACH = RoadMapReach()


class Maps(Protocol):
    """The source of a live vehicle's map."""

    def current(self) -> PointMap:
        """The newest version there is: the next ballot holds to it."""

    def covers(self, position: F64 | None) -> bool:
        """Whether the tiles that a vehicle at (3,), map metres, compares with are here. None: it is not known where it
        is. Those farther ahead are asked for."""


class OneMap:
    """A map from a file or a store: all of it is here, and it has one version."""

    def __init__(self, point_map: PointMap) -> None:
        self._tiles = point_map.tiles if isinstance(point_map.tiles, LazyTiles) else _copied(point_map.tiles)
        self._point_map = replace(point_map, tiles=self._tiles)
        self._position: F64 | None = None

    def current(self) -> PointMap:
        """See :class:`Maps`."""
        return self._point_map

    def covers(self, position: F64 | None) -> bool:
        """See :class:`Maps`. Frees what was computed from tiles far from there."""
        if position is not None and has_moved(position, self._position):
            self._position = position
            self._tiles.keep_only(tiles_within(self._point_map, position, ROAD_MAP_REACH.kept_m))
        return True


def _copied(tiles: Mapping[TileIndex, Tile]) -> LazyTiles:
    """Tiles that share the arrays of these, and keep what they work out apart from them."""
    return LazyTiles(lambda index: tiles[index].but(), {index: len(tile.points) for index, tile in tiles.items()})


def has_moved(position: F64, since: F64 | None) -> bool:
    """Whether the vehicle is so far from where it was that other tiles matter."""
    return since is None or float(np.abs(position[:2] - since[:2]).max()) > ROAD_MAP_REACH.moved_m


class Version:
    """One version of the server's map: those of its tiles that are here."""

    def __init__(self, manifest: Manifest, client: MapClient, shared: weakref.WeakValueDictionary[str, Tile]) -> None:
        """``shared``: tiles of other versions by the hashes of their planes; those that stayed the same are shared."""
        self._client = client
        self._shared = shared
        lattice = Lattice(manifest.lattice.x0, manifest.lattice.y0)
        self.planes = {tile_index(key): planes for key, planes in manifest.tiles.items()}
        self.tiles = LazyTiles(self._load, {})
        georeference = manifest.georeference
        number = manifest.version
        self.point_map = PointMap(manifest.map_id, lattice, self.tiles, georeference, version=number)

    def around(self, position: F64 | None, half_m: float) -> list[TileIndex]:
        """Its tiles that a square around (3,) touches; all of them where ``position`` is None."""
        if position is None:
            return sorted(self.planes)
        window = window_around(self.point_map.lattice, float(position[0]), float(position[1]), 2 * half_m)
        return [tile for tile in window.tiles() if tile in self.planes]

    def missing(self, position: F64 | None, half_m: float) -> list[TileIndex]:
        """Those of :meth:`around` that are not here."""
        return [tile for tile in self.around(position, half_m) if tile not in self.tiles]

    def _load(self, index: TileIndex) -> Tile:
        name = " ".join(self.planes[index].planes().values())
        tile = self._shared.get(name)
        if tile is None:
            window = self.point_map.lattice.tile(index)
            tile = self._shared[name] = self._client.tile(window, self.planes[index])
        return tile


class RoadMap:
    """A server's map for a vehicle on the move (:class:`Maps`).

    A newer version is the current one as soon as its tiles around the vehicle are here. Without a network the vehicle
    drives on what it has. Two threads, of which one only listens for versions.
    """

    def __init__(self, open_client: Callable[[], MapClient], *, poll_s: float = ROAD_MAP_REACH.poll_s) -> None:
        """``open_client`` opens a connection: each thread, and who reads tiles, has its own. MapvoteError if the server
        is away and no version of its map is kept here."""
        self._reader = open_client()
        self._fetcher = open_client()
        self._listener = open_client()
        self._shared: weakref.WeakValueDictionary[str, Tile] = weakref.WeakValueDictionary()
        self._poll_s = poll_s
        self._position: F64 | None = None
        self._located = False
        """Whether it was asked for tiles at all."""
        self._wake = threading.Event()
        self._refresh = threading.Event()
        self._ended = threading.Event()
        self._asked_s = -np.inf
        self.events = False
        """Whether the server's events arrive."""
        self.away = ""
        """Why the server gives no tiles now; "" while it does."""
        try:
            manifest = self._fetcher.manifest()
        except Unreachable as error:
            kept = self._fetcher.kept_manifest()
            if kept is None:
                raise
            log.warning("%s. Version %d is kept here and used", error, kept.version)
            manifest = kept
            self.away = str(error)
        self._coming = self._current = self._used = self._version(manifest)
        works = ((self._fetch, self._fetcher), (self._listen, self._listener))
        self._threads = [threading.Thread(target=_closing, args=work, daemon=True) for work in works]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Ask for nothing more. Waits up to 5 s for a request for tiles or the manifest. Each thread closes its own
        client when it ends: that of events at the next line from the server."""
        self._ended.set()
        self._wake.set()
        self._threads[0].join(5.0)
        self._reader.close()

    def current(self) -> PointMap:
        """See :class:`Maps`."""
        self._used = self._current
        return self._used.point_map

    def covers(self, position: F64 | None) -> bool:
        """See :class:`Maps`: of the version that was asked for last."""
        if position is None or has_moved(position, self._position):
            self._position = position
            self._located = True
            self._used.tiles.keep_only(self._used.around(position, ROAD_MAP_REACH.kept_m))
            self._wake.set()
        return not self._used.missing(position, ROAD_MAP_REACH.needed_m)

    @property
    def tiles(self) -> int:
        """How many tiles of the version in use are here."""
        return len(self._used.tiles)

    @property
    def version(self) -> int:
        """Version of the map that the open ballot is cast on."""
        return self._used.point_map.version or 0

    def _version(self, manifest: Manifest) -> Version:
        """With every tile that ``home`` has around the vehicle."""
        version = Version(manifest, self._reader, self._shared)
        for tile in version.planes:
            if self._fetcher.has(version.planes[tile]):
                version.tiles.add(tile, self._fetcher.points_of(version.planes[tile]))
        return version

    def _fetch(self) -> None:
        while not self._ended.is_set():
            wait_s = self._poll_s
            try:
                self._step()
                self.away = ""
            except (MapvoteError, OSError) as error:
                if not self.away:
                    log.warning("%s. The vehicle drives on the %d tiles that it has", error, self.tiles)
                self.away = str(error)
                wait_s = ROAD_MAP_REACH.retry_s
            self._wake.wait(wait_s)
            self._wake.clear()

    def _step(self) -> None:
        """Ask for the newest version if it is time, and for the tiles ahead."""
        if self._refresh.is_set() or time.monotonic() - self._asked_s >= self._poll_s:
            self._refresh.clear()
            manifest = self._fetcher.manifest()
            self._asked_s = time.monotonic()
            if manifest.version != self._coming.point_map.version:
                self._coming = self._version(manifest)
                self._fetcher.forget([*self._coming.planes.values(), *self._used.planes.values()])
        if not self._located:
            return
        for version in dict.fromkeys((self._used, self._coming)):
            for tile in version.missing(self._position, ROAD_MAP_REACH.ahead_m):
                if self._ended.is_set():
                    return
                try:
                    self._fetcher.download(version.planes[tile])
                except Refused:
                    if version is self._coming:
                        raise
                    break  # the server has dropped the planes of this version alone: the next one is coming
                version.tiles.add(tile, self._fetcher.points_of(version.planes[tile]))
        if self._current is not self._coming:
            self._current = self._coming
            log.info("version %d of the map is here", self._coming.point_map.version)

    def _listen(self) -> None:
        while not self._ended.is_set():
            try:
                for version in self._listener.versions():
                    if self._ended.is_set():
                        return
                    if not self.events or version not in (None, self._coming.point_map.version):
                        self._refresh.set()  # at the start, too: something may have come since the last question
                        self._wake.set()
                    self.events = True
            except (MapvoteError, ValueError, KeyError):  # no events, or no server: it is polled
                pass
            self.events = False
            self._ended.wait(self._poll_s)


def _closing(work: Callable[[], None], client: MapClient) -> None:
    """``work``, then close its client: closed by another thread, a request would fail or leave its socket open."""
    with client:
        work()
