"""The tiles of a map that is larger than memory: each is made when it is first read, and the last few are kept."""

from __future__ import annotations

import weakref
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from threading import RLock

from mapvote.core.grid import TileIndex
from mapvote.core.tile import Tile

KEPT_POINTS = 10_000_000
"""Maps of no more are held in memory as they are; of larger ones the tiles last used, up to so many points together."""


class LazyTiles(Mapping[TileIndex, Tile]):
    """As a dict of tiles, in ascending order. As long as anyone holds a tile, asking again gives the same object."""

    def __init__(self, load: Callable[[TileIndex], Tile], points: Mapping[TileIndex, int]) -> None:
        """``load`` makes one tile; ``points``: of every tile of the map, how many it holds."""
        self._load, self._points = load, {index: points[index] for index in sorted(points)}
        self._alive: weakref.WeakValueDictionary[TileIndex, Tile] = weakref.WeakValueDictionary()
        self._kept: OrderedDict[TileIndex, Tile] = OrderedDict()
        self._held, self._lock = 0, RLock()

    def add(self, index: TileIndex, points: int) -> None:
        """One more tile can be had from here on."""
        self._points = dict(sorted({**self._points, index: points}.items()))

    def keep_only(self, indices: Collection[TileIndex]) -> None:
        """Let go of all other tiles, and of what they have worked out: they are made again when they are asked for."""
        with self._lock:
            for index in self._kept.keys() - set(indices):
                del self._kept[index]
                self._held -= self._points[index]

    @property
    def points_of(self) -> dict[TileIndex, int]:
        """How many each tile holds."""
        return dict(self._points)

    @property
    def n_points(self) -> int:
        """Of all tiles together; none is made for it."""
        return sum(self._points.values())

    def largest(self, n: int) -> list[TileIndex]:
        """The tiles with the most points, ``n`` at most."""
        return sorted(self._points, key=lambda index: -self._points[index])[:n]

    def __getitem__(self, index: TileIndex) -> Tile:
        if index not in self._points:
            raise KeyError(index)
        with self._lock:
            tile = self._alive.get(index)
            if tile is None:
                tile = self._alive[index] = self._load(index)
            if index not in self._kept:
                self._held += self._points[index]
                self._kept[index] = tile
            self._kept.move_to_end(index)
            while self._held > KEPT_POINTS and len(self._kept) > 1:
                self._held -= self._points[self._kept.popitem(last=False)[0]]
        return tile

    def __contains__(self, index: object) -> bool:
        return index in self._points

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._points)

    def __len__(self) -> int:
        return len(self._points)


def is_small(n_points: int) -> bool:
    """Whether the tiles of a map of so many points are held in memory as they are."""
    return n_points <= KEPT_POINTS


def in_memory_if_small(tiles: LazyTiles) -> Mapping[TileIndex, Tile]:
    """All tiles made at once, unless there are too many points for that."""
    return dict(tiles) if is_small(tiles.n_points) else tiles


def made_in_turn(load: Callable[[TileIndex], Tile], indices: Iterable[TileIndex]) -> Mapping[TileIndex, Tile]:
    """Every tile made once, and all held unless there are too many points for that."""
    made: dict[TileIndex, Tile] = {}
    points: dict[TileIndex, int] = {}
    total = 0
    for index in indices:
        tile = load(index)
        points[index] = len(tile.points)
        total += len(tile.points)
        if is_small(total):
            made[index] = tile
        else:
            made.clear()
    return made if is_small(total) else LazyTiles(load, points)


def with_changed(tiles: Mapping[TileIndex, Tile], changed: Mapping[TileIndex, Tile]) -> Mapping[TileIndex, Tile]:
    """``tiles`` with some in the place of theirs, or beside them; the others stay the objects that they are."""
    if not isinstance(tiles, LazyTiles):
        return dict(sorted({**tiles, **changed}.items()))
    points = tiles.points_of | {index: len(tile.points) for index, tile in changed.items()}
    return LazyTiles(lambda index: changed[index] if index in changed else tiles[index], points)
