"""A whole map: its tiles, made when they are read if they are more than memory holds; and the one place where a cloud
is cut into tiles and their ground is computed."""

from __future__ import annotations

import hashlib
import weakref
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapvote.core.columns import base_layers, column_bits, flat_cells
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Lattice, TileIndex
from mapvote.core.ground import lay_ground
from mapvote.core.record import record
from mapvote.core.tile import Tile
from mapvote.core.types import F32, F64, I32, I64, MapvoteError


@record()
@dataclass(frozen=True, slots=True)
class MapSizes:
    """Limits of a map's extent and of its memory."""

    extent_m: float = 1e7
    """Largest coordinate of a point."""
    near_origin_m: float = 50_000.0
    """Largest coordinate of maps that share the lattice at (0, 0); farther ones (UTM) get one of their own."""
    block_points: int = 1_000_000
    """Points of one block: a large cloud is never copied as a whole."""
    kept_points: int = 10_000_000
    """Points of the largest map that is held in memory whole. A larger map holds its tiles last used, up to so many
    points together."""
    tile_points: int = 50_000
    """Points that a tile counts for beside its own: its planes take 1 MB, a point 20 bytes."""


MAP_SIZES = MapSizes()


def held_points(points: int, sizes: MapSizes = MAP_SIZES) -> int:
    """Share of ``kept_points`` that a tile with so many ``points`` takes, an empty one too."""
    return points + sizes.tile_points


SOURCES = "sources"
"""The field of a merged map's points: bit k of each is set where the k-th map has a point in its voxel."""
SCANS = "scans"
"""The field of a built map's points: how many scans hit each one's voxel, 255 for more; 0 for points that votes added.
With it, `merge` judges strays by the scans of all surveys together."""


class LazyTiles(Mapping[TileIndex, Tile]):
    """A dict of tiles, in ascending order. While a tile is held anywhere, reading it again gives the same object."""

    def __init__(
        self,
        load: Callable[[TileIndex], Tile],
        points: Mapping[TileIndex, int],
        kept_points: int = MAP_SIZES.kept_points,
    ) -> None:
        """``load`` makes one tile; ``points``: number of points of every tile of the map; ``kept_points``: see
        :class:`MapSizes`."""
        self._load = load
        self._points = {index: points[index] for index in sorted(points)}
        self.kept_points = kept_points
        self._alive: weakref.WeakValueDictionary[TileIndex, Tile] = weakref.WeakValueDictionary()
        self._kept: OrderedDict[TileIndex, Tile] = OrderedDict()
        self._held = 0
        self._lock = RLock()

    def add(self, index: TileIndex, points: int) -> None:
        """One more tile can be had from here on."""
        self._points = dict(sorted({**self._points, index: points}.items()))

    def keep_only(self, indices: Collection[TileIndex]) -> None:
        """Let go of all other tiles, and of what they have worked out: they are made again when they are asked for."""
        with self._lock:
            for index in self._kept.keys() - set(indices):
                self._let_go(index)

    @property
    def points_of(self) -> dict[TileIndex, int]:
        """How many each tile holds."""
        return dict(self._points)

    @property
    def n_points(self) -> int:
        """Points of all tiles together; no tile is made to count them."""
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
                self._held += held_points(self._points[index])
                self._kept[index] = tile
            self._kept.move_to_end(index)
            while self._held > self.kept_points and len(self._kept) > 1:
                self._let_go(next(iter(self._kept)))
        return tile

    def _let_go(self, index: TileIndex) -> None:
        del self._kept[index]
        self._held -= held_points(self._points[index])

    def __contains__(self, index: object) -> bool:
        return index in self._points

    def __iter__(self) -> Iterator[TileIndex]:
        return iter(self._points)

    def __len__(self) -> int:
        return len(self._points)


def made_in_turn(
    load: Callable[[TileIndex], Tile], indices: Iterable[TileIndex], kept_points: int = MAP_SIZES.kept_points
) -> Mapping[TileIndex, Tile]:
    """Every tile made once, and all held unless they have more points than ``kept_points``."""
    made: dict[TileIndex, Tile] = {}
    points: dict[TileIndex, int] = {}
    total = 0
    for index in indices:
        tile = load(index)
        points[index] = len(tile.points)
        total += held_points(len(tile.points))
        if total <= kept_points:
            made[index] = tile
        else:
            made.clear()
    return made if total <= kept_points else LazyTiles(load, points, kept_points)


def with_changed(tiles: Mapping[TileIndex, Tile], changed: Mapping[TileIndex, Tile]) -> Mapping[TileIndex, Tile]:
    """``tiles`` with some in the place of theirs, or beside them; the others stay the objects that they are."""
    if not isinstance(tiles, LazyTiles):
        return dict(sorted({**tiles, **changed}.items()))
    counts = changed.points_of if isinstance(changed, LazyTiles) else {i: len(t.points) for i, t in changed.items()}
    points = tiles.points_of | counts
    return LazyTiles(lambda index: changed[index] if index in changed else tiles[index], points, tiles.kept_points)


@dataclass(frozen=True, slots=True, repr=False)
class PointMap:
    """A whole map. Edited tiles make a new PointMap; tiles themselves never change."""

    map_id: str
    lattice: Lattice
    tiles: Mapping[TileIndex, Tile]
    georeference: Mapping[str, str] = field(default_factory=dict)
    """Free text carried along (CRS, projector, origin)."""
    driven: tuple[F64, ...] = ()
    """(n, 3) the sensor's positions along each drive that the map was made of, map metres; none if unknown."""
    version: int | None = None
    """How often the map was published; ballots name it. None: of a format that does not say."""
    surveyed_ns: int | None = None
    """When the last drive that the map was made of ended, since 1970; None if unknown."""

    def __repr__(self) -> str:
        return f"PointMap({self.map_id!r}: {self.n_points:,} points in {len(self.tiles)} tiles)"

    @property
    def n_points(self) -> int:
        """Points of all tiles together."""
        if isinstance(self.tiles, LazyTiles):
            return self.tiles.n_points
        return sum(len(tile.points) for tile in self.tiles.values())

    @property
    def field_names(self) -> list[str]:
        """Names of the fields of its points; a map larger than memory names those of its largest tiles."""
        largest = self.tiles.largest(3) if isinstance(self.tiles, LazyTiles) else list(self.tiles)
        return sorted({name for index in largest for name in self.tiles[index].fields})

    def tile(self, index: TileIndex) -> Tile:
        """One tile; the empty one where the map has none."""
        return self.tiles.get(index) or Tile.empty(self.lattice.tile(index))

    def by_tile(self, points_map: NDArray[np.floating]) -> Iterator[tuple[Tile, I64, tuple[I64, I64]]]:
        """(tile, indices (m,), cell) of the points (n, 3), map metres, that lie in each tile of the map; the cell is
        (rows (m,), cols (m,)), so that ``tile.ground_z[cell]`` is the ground under them."""
        for index, chosen in cut_tiles(points_map, self.lattice):
            if index in self.tiles:
                tile = self.tiles[index]
                rows, cols, _ = tile.window.indices_of(points_map[chosen])
                yield tile, chosen, (rows, cols)

    def ground_under(self, points_map: NDArray[np.floating]) -> F64:
        """(n,) height of the ground in the cell of each of the points (n, 3), map metres; NaN where it is unknown."""
        out = np.full(len(points_map), np.nan)
        for tile, chosen, cell in self.by_tile(points_map):
            out[chosen] = tile.ground_z[cell]
        return out


def cut_tiles(points_map: NDArray[np.floating], lattice: Lattice) -> Iterator[tuple[TileIndex, I64]]:
    """Which of the points (n, 3) lie in each tile, input order kept inside each tile; tiles in ascending order."""
    if not len(points_map):
        return
    tiles = np.empty((len(points_map), 2), dtype=np.int32)
    for start in range(0, len(points_map), MAP_SIZES.block_points):
        piece = slice(start, start + MAP_SIZES.block_points)
        rows, cols = lattice.cells_of(points_map[piece])
        tiles[piece, 0] = rows // TILE_CELLS
        tiles[piece, 1] = cols // TILE_CELLS
    number = _numbered(tiles)
    order = np.argsort(number, kind="stable")
    seams = np.flatnonzero(np.diff(number[order])) + 1
    for piece_of_order in np.split(order, seams):
        row, col = tiles[piece_of_order[0]].tolist()
        yield (row, col), piece_of_order


def _numbered(tiles: I32) -> NDArray[np.integer]:
    """(n,) a number for each of the tiles (n, 2), ascending as they do; of two bytes if these are enough, for numpy
    sorts such ten times as fast."""
    low = tiles.min(axis=0).astype(np.int64)
    high = tiles.max(axis=0).astype(np.int64)
    rows, cols = (high - low + 1).tolist()
    kind = np.uint16 if rows * cols <= 1 << 16 else np.int64
    return ((tiles[:, 0] - low[0]) * cols + (tiles[:, 1] - low[1])).astype(kind)


def _stored(points_map: NDArray[np.floating], lattice: Lattice) -> dict[TileIndex, F32]:
    """The points as tiles keep them, so that the ground is computed from the points that a map read back holds."""
    return {tile: lattice.tile(tile).from_map(points_map[chosen]) for tile, chosen in cut_tiles(points_map, lattice)}


def lattice_of(points: NDArray[np.floating]) -> Lattice:
    """The lattice at (0, 0), or for points (n, 2+) far from it one that starts at a multiple of a tile's side below
    them: the keys of voxels reach 314 km."""
    low = points[:, :2].min(axis=0).astype(np.float64)
    high = points[:, :2].max(axis=0).astype(np.float64)
    if max(np.abs(low).max(), np.abs(high).max()) < MAP_SIZES.near_origin_m:
        return Lattice()
    side = TILE_CELLS * CELL_SIZE
    x0, y0 = np.floor(low / side) * side
    return Lattice(round(float(x0), 1), round(float(y0), 1))


def map_from_points(
    points_map: NDArray[np.floating],
    *,
    lattice: Lattice | None = None,
    map_id: str | None = None,
    georeference: Mapping[str, str] | None = None,
    road: F64 | None = None,
    fields: Mapping[str, NDArray[Any]] | None = None,
) -> PointMap:
    """A PointMap of points (n, 3) in map metres: cut into tiles, every point kept in its order, ground computed.

    ``lattice``: default :func:`lattice_of` the points. ``road`` (m, 3), map metres: places known to be ground, from
    which it grows; without, it must be found. ``fields``: columns (n,) that stay with the points. ``map_id`` defaults
    to a hash of the points and the lattice.
    Raises MapvoteError if there are no points, or if some are not finite or lie beyond 10,000 km.
    """
    points = np.asarray(points_map)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise MapvoteError(f"a map needs points: got an array of shape {points.shape}, expected (n, 3) with n > 0")
    lattice = lattice or lattice_of(points)
    digest = hashlib.sha256(np.array([lattice.x0, lattice.y0]).tobytes())
    for start in range(0, len(points), MAP_SIZES.block_points):
        piece = np.ascontiguousarray(points[start : start + MAP_SIZES.block_points], dtype=np.float64)
        check_extent(piece, start)
        digest.update(piece.tobytes())
    stored = _stored(points, lattice)
    road_tiles = {} if road is None or len(road) == 0 else _stored(road, lattice)
    heights, road_heights = (
        {tile: (flat_cells(lattice.tile(tile), p), p[:, 2]) for tile, p in of_tiles.items()}
        for of_tiles in (stored, road_tiles)
    )
    ground = lay_ground(heights, road_heights, {tile: len(p) for tile, p in stored.items()})
    tiles = {tile: Tile(lattice.tile(tile), stored[tile], ground[tile]) for tile in stored}
    if fields:
        for tile, chosen in cut_tiles(points, lattice):
            tiles[tile] = replace(tiles[tile], fields={name: column[chosen] for name, column in fields.items()})
    return PointMap(map_id or digest.hexdigest()[:16], lattice, tiles, dict(georeference or {}))


def check_extent(points: F64, before: int = 0) -> None:
    """MapvoteError if some of the points (n, 3), before which came others, are not finite or beyond 10,000 km."""
    bad = ~(np.abs(points) < MAP_SIZES.extent_m).all(axis=1)
    if bad.any():
        raise MapvoteError(
            f"{int(bad.sum())} of {len(points)} map points are not finite or beyond 10,000 km "
            f"(first: point {before + int(np.argmax(bad))}); remove them first"
        )


def has_open_ground(point_map: PointMap, min_share: float = 0.2) -> bool:
    """Whether more than ``min_share`` of the cells with points hold ground and no obstacle. In a map whose ground was
    cut out the feet of walls are taken for ground, but hardly anything else: 12 % of the cells of a foreign campus map
    without ground look open, 49 % and more of clouds with it. A map larger than memory is judged by its largest tiles.
    """
    ground = 0
    any_point = 0
    tiles = point_map.tiles
    for tile in map(tiles.__getitem__, tiles.largest(9) if isinstance(tiles, LazyTiles) else tiles):
        held, stands = (np.zeros(tile.window.rows * tile.window.cols, dtype=np.bool_) for _ in range(2))
        # Not tile.cells, tile.base and tile.columns, which stay with it: a drive reaches few tiles of a large map.
        cells = flat_cells(tile.window, tile.points)
        base = base_layers(tile.ground_z).reshape(-1)[cells]
        held[cells] = True
        heights = tile.points[:, 2].astype(np.float64)
        stands[cells[column_bits(heights, tile.ground_z.reshape(-1)[cells], base)[1]]] = True
        any_point += int(held.sum())
        ground += int((held & ~stands & np.isfinite(tile.ground_z.reshape(-1))).sum())
    return ground > min_share * any_point


def all_points(point_map: PointMap) -> F64:
    """Every point (n, 3) of a map in map metres, tile by tile in ascending order."""
    clouds = [point_map.tiles[tile].points_map for tile in sorted(point_map.tiles)]
    return np.concatenate(clouds) if clouds else np.zeros((0, 3))


def all_fields(point_map: PointMap) -> dict[str, NDArray[Any]]:
    """The fields (n,) of :func:`all_points`, in the same order; 0 where a tile lacks one, all its points being new."""
    tiles = [point_map.tiles[index] for index in sorted(point_map.tiles)]
    kinds = {name: column.dtype for tile in tiles for name, column in tile.fields.items()}
    return {
        name: np.concatenate([t.fields.get(name, np.zeros(len(t.points), kind)).astype(kind) for t in tiles])
        for name, kind in kinds.items()
    }
