"""The NDT map around a vehicle in a finished map, made of tiles whose voxels are summed up before they are needed."""

from __future__ import annotations

import numpy as np

from mapvote.core.grid import TILE_CELLS, TileIndex, window_around
from mapvote.core.point_map import PointMap
from mapvote.core.tile import Tile
from mapvote.core.types import F64
from mapvote.localisation.ndt import (
    CENTRAL_M,
    HALF_WINDOW_M,
    LEVELS,
    Level,
    NdtMap,
    entered,
    refreshed,
    room_for_voxels,
)
from mapvote.localisation.ndt_voxels import Voxels, Window

_SLAB_M = 252.0
"""Height of one block, a whole number of voxels at every level: a stray point costs no tower."""
_AHEAD_M, _KEPT_M = HALF_WINDOW_M + 2 * CENTRAL_M, HALF_WINDOW_M + 4 * CENTRAL_M
"""Tiles this near are made ready, and tiles this near are kept."""


class MapWindow:
    """Built anew when the vehicle leaves its middle: in a millisecond or two where :meth:`prepare` has been called, and
    in the memory of the one before, which earlier callers must not use any longer.

    Memory is bounded by the tiles around the vehicle.
    """

    def __init__(self, point_map: PointMap) -> None:
        self.point_map = point_map
        self.ndt_map: NdtMap | None = None
        self._ready: dict[TileIndex, list[list[Voxels]]] = {}
        """By tile, by level."""

    def __call__(self, position: F64) -> NdtMap:
        if self.ndt_map is None or not self.ndt_map.is_central(position):
            return self._laid_out(position)
        return self.ndt_map

    def go_on_in(self, point_map: PointMap) -> None:
        """The map is another version from here on: what is ready of tiles that stayed the same remains so."""
        old, self.point_map, self.ndt_map = self.point_map, point_map, None
        same = {tile for tile in self._ready if old.tiles.get(tile) is point_map.tiles.get(tile)}
        self._ready = {tile: ready for tile, ready in self._ready.items() if tile in same}

    def prepare(self, position: F64) -> None:
        """One step ahead: one level of the nearest tile that is not ready. For every scan, so that none has it all."""
        ahead = [tile for tile in self._around(position, _AHEAD_M) if len(self._ready.get(tile, [])) < len(LEVELS)]
        if ahead:
            rows, cols = self.point_map.lattice.cells_of(position[None, :2])
            here = np.array([rows[0], cols[0]]) / TILE_CELLS - 0.5
            self._step(min(ahead, key=lambda tile: float(np.hypot(*(tile - here)))))

    def _step(self, tile: TileIndex) -> None:
        """One more level of a tile."""
        ready = self._ready.setdefault(tile, [])
        ready.append(tile_voxels(self.point_map.tiles[tile], LEVELS[len(ready)]))

    def _around(self, position: F64, half_m: float) -> list[TileIndex]:
        return tiles_within(self.point_map, position, half_m)

    def _laid_out(self, position: F64) -> NdtMap:
        kept = set(self._around(position, _KEPT_M))
        self._ready = {tile: ready for tile, ready in self._ready.items() if tile in kept}
        here = self._around(position, HALF_WINDOW_M)
        for tile in here:
            while len(self._ready.get(tile, [])) < len(LEVELS):
                self._step(tile)
        if self.ndt_map is None:
            self.ndt_map = NdtMap(position)
        else:
            self.ndt_map.begin_anew(position)
        for i, grid in enumerate(self.ndt_map.levels):
            grid.join([voxels for tile in here for voxels in self._ready[tile][i]])
        return self.ndt_map


def tiles_within(point_map: PointMap, position: F64, half_m: float = HALF_WINDOW_M) -> list[TileIndex]:
    """The map's tiles that a square around ``position`` (3,) touches, in ascending order."""
    window = window_around(point_map.lattice, float(position[0]), float(position[1]), 2 * half_m)
    return [tile for tile in window.tiles() if tile in point_map.tiles]


def tile_voxels(tile: Tile, level: Level) -> list[Voxels]:
    """The voxels of all points of a tile, in one piece for each slab of height."""
    points = tile.points_map
    slab = np.floor(points[:, 2] / _SLAB_M)
    return [_voxels_of(points[slab == height], level) for height in np.unique(slab)]


def _voxels_of(points_map: F64, level: Level) -> Voxels:
    lowest = np.floor(points_map.min(axis=0) / level.voxel_m).astype(np.int64)
    shape = np.floor(points_map.max(axis=0) / level.voxel_m).astype(np.int64) - lowest + 1
    window = Window(np.full(shape, -1, dtype=np.int32), lowest, level.voxel_m)
    voxels, n, touched = entered(points_map, window, room_for_voxels(1024), 0)
    for rows in touched:
        refreshed(voxels, rows, level)
    return Voxels(voxels.place[:n].copy(), voxels.sums[:n].copy(), voxels.cells[:n].copy())
