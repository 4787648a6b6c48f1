"""From one cloud to a tiled map (DESIGN 2): the one place where tiles are cut and their ground is laid."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from mapvote.core.columns import map_points, tile_points
from mapvote.core.grid import TILE_CELLS, Lattice, TileIndex, tile_grid, tile_of_cells
from mapvote.core.points import ground_surface
from mapvote.core.types import F32, F64, MapTile, MapvoteError, PointMap

_EXTENT_M = 1e7


def cut_tiles(points_map: F64, lattice: Lattice) -> dict[TileIndex, F64]:
    """Points (n, 3) by tile, map metres, input order kept inside each tile; tiles in ascending order."""
    tile_row, tile_col = tile_of_cells(*lattice.cells_of(points_map))
    order = np.lexsort((tile_col, tile_row))
    row, col = tile_row[order], tile_col[order]
    starts = np.flatnonzero(np.r_[True, (np.diff(row) != 0) | (np.diff(col) != 0)])
    pieces = np.split(order, starts[1:])
    return {(int(row[s]), int(col[s])): points_map[piece] for s, piece in zip(starts, pieces, strict=True)}


def tile_ground(clouds: Mapping[TileIndex, F64], tile: TileIndex, lattice: Lattice) -> F32:
    """Ground of one tile, (256, 256) float32, from its points and its eight neighbours', so that tiles agree."""
    near = [clouds[key] for dr in (-1, 0, 1) for dc in (-1, 0, 1) if (key := (tile[0] + dr, tile[1] + dc)) in clouds]
    window = tile_grid(lattice, tile)
    halo = window.padded(TILE_CELLS)
    return ground_surface(np.concatenate(near), halo)[window.slices_in(halo)].copy()


def map_from_points(
    points_map: NDArray[np.floating],
    *,
    lattice: Lattice | None = None,
    map_id: str | None = None,
    georeference: Mapping[str, str] | None = None,
) -> PointMap:
    """A PointMap of points (n, 3) in map metres: cut into tiles, every point kept in its order, ground laid.

    ``map_id`` defaults to a hash of the points and the lattice. Raises MapvoteError if there are no points, or if
    some are not finite or lie beyond 10,000 km.
    """
    points = np.ascontiguousarray(points_map, dtype=np.float64)
    lattice = lattice or Lattice()
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise MapvoteError(f"a map needs points: got an array of shape {points.shape}, expected (n, 3) with n > 0")
    bad = ~(np.abs(points) < _EXTENT_M).all(axis=1)
    if bad.any():
        raise MapvoteError(
            f"{int(bad.sum())} of {len(points)} map points are not finite or beyond 10,000 km "
            f"(first: point {int(np.argmax(bad))}); remove them first"
        )
    # The ground is measured on the points as they are stored, so that a map read back lays the same ground.
    stored = {tile: tile_points(tile_grid(lattice, tile), p) for tile, p in cut_tiles(points, lattice).items()}
    clouds = {tile: map_points(tile_grid(lattice, tile), p) for tile, p in stored.items()}
    tiles = {tile: MapTile(stored[tile], tile_ground(clouds, tile, lattice)) for tile in stored}
    if map_id is None:
        digest = hashlib.sha256(np.array([lattice.x0, lattice.y0]).tobytes() + points.tobytes())
        map_id = digest.hexdigest()[:16]
    return PointMap(map_id, lattice, tiles, dict(georeference or {}))


def all_points(point_map: PointMap) -> F64:
    """Every point (n, 3) of a map in map metres, tile by tile in ascending order."""
    clouds = [map_points(tile_grid(point_map.lattice, t), point_map.tiles[t].points) for t in sorted(point_map.tiles)]
    return np.concatenate(clouds) if clouds else np.zeros((0, 3))
