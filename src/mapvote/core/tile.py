"""From one cloud to a tiled map (DESIGN 2): the one place where tiles are cut and their ground is laid."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from mapvote.core.columns import GROUND_MARGIN_M, TOP_BIT
from mapvote.core.grid import CELL_SIZE, CELLS, TILE_CELLS, Grid, Lattice, TileIndex, tile_grid, tile_of_cells
from mapvote.core.ground import base_layers, ground_surface
from mapvote.core.types import F32, F64, I64, U64, Bool, MapTile, MapvoteError, PointMap

_EXTENT_M = 1e7
_CHUNK = 1_000_000
"""Points looked at together: a large cloud is never copied as a whole."""


def cut_tiles(points_map: NDArray[np.floating], lattice: Lattice) -> Iterator[tuple[TileIndex, NDArray[np.floating]]]:
    """Points (n, 3) tile by tile, map metres, input order kept inside each tile; tiles in ascending order."""
    tiles = np.empty((len(points_map), 2), dtype=np.int32)
    for start in range(0, len(points_map), _CHUNK):
        piece = slice(start, start + _CHUNK)
        tiles[piece, 0], tiles[piece, 1] = tile_of_cells(*lattice.cells_of(points_map[piece]))
    order = np.lexsort((tiles[:, 1], tiles[:, 0]))
    seams = np.flatnonzero((tiles[order[1:]] != tiles[order[:-1]]).any(axis=1)) + 1
    for piece_of_order in np.split(order, seams):
        row, col = tiles[piece_of_order[0]].tolist()
        yield (row, col), points_map[piece_of_order]


def tile_ground(stored: Mapping[TileIndex, F32], tile: TileIndex, lattice: Lattice) -> F32:
    """Ground of one tile, (256, 256) float32, from its points and its eight neighbours', so that tiles agree.

    ``stored``: each tile's points (n, 3) from its corner, as the map keeps them, so that a map read back lays the
    same ground.
    """
    around = [(tile[0] + dr, tile[1] + dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1)]
    near = [map_points(tile_grid(lattice, key), stored[key]) for key in around if key in stored]
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
    lattice = lattice or Lattice()
    points = np.asarray(points_map)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise MapvoteError(f"a map needs points: got an array of shape {points.shape}, expected (n, 3) with n > 0")
    digest = hashlib.sha256(np.array([lattice.x0, lattice.y0]).tobytes())
    for start in range(0, len(points), _CHUNK):
        piece = np.ascontiguousarray(points[start : start + _CHUNK], dtype=np.float64)
        bad = ~(np.abs(piece) < _EXTENT_M).all(axis=1)
        if bad.any():
            raise MapvoteError(
                f"{int(bad.sum())} of {len(piece)} map points are not finite or beyond 10,000 km "
                f"(first: point {start + int(np.argmax(bad))}); remove them first"
            )
        digest.update(piece.tobytes())
    stored = {
        tile: tile_points(tile_grid(lattice, tile), p.astype(np.float64)) for tile, p in cut_tiles(points, lattice)
    }
    tiles = {tile: MapTile(stored[tile], tile_ground(stored, tile, lattice)) for tile in stored}
    return PointMap(map_id or digest.hexdigest()[:16], lattice, tiles, dict(georeference or {}))


def all_points(point_map: PointMap) -> F64:
    """Every point (n, 3) of a map in map metres, tile by tile in ascending order."""
    clouds = [map_points(tile_grid(point_map.lattice, t), point_map.tiles[t].points) for t in sorted(point_map.tiles)]
    return np.concatenate(clouds) if clouds else np.zeros((0, 3))


def map_points(window: Grid, tile_points: F32) -> F64:
    """A tile's points (n, 3) from its corner to map metres, float64."""
    out = tile_points.astype(np.float64)
    out[:, 0] += window.x0
    out[:, 1] += window.y0
    return out


def tile_points(window: Grid, points: F64) -> F32:
    """Points (n, 3) in map metres to float32 from the tile's corner, kept inside the half-open tile.

    Rounding to float32 must not carry a point over the tile's far edge, nor into the next cell's tile.
    """
    local = points.astype(np.float64).copy()
    local[:, 0] -= window.x0
    local[:, 1] -= window.y0
    out = local.astype(np.float32)
    edge = np.nextafter(np.float32(TILE_CELLS * CELL_SIZE), np.float32(0.0))
    out[:, :2] = np.clip(out[:, :2], np.float32(0.0), edge)
    return out


def empty_tile() -> MapTile:
    """A tile where the map has nothing: no points, ground unknown."""
    shape = (TILE_CELLS, TILE_CELLS)
    return MapTile(np.empty((0, 3), dtype=np.float32), np.full(shape, np.nan, dtype=np.float32))


def cells_of(grid: Grid, points: F32) -> I64:
    """(n,) flat cell index within the tile of points from its corner; the outermost cells take what rounding moved."""
    rows, cols, _ = grid.indices_of(map_points(grid, points))
    flat: I64 = np.clip(rows, 0, TILE_CELLS - 1) * TILE_CELLS + np.clip(cols, 0, TILE_CELLS - 1)
    return flat


def columns_of(points: F32, cells: I64, ground_z: F32) -> tuple[I64, Bool]:
    """(bit, obstacle) of points that lie in the flat ``cells`` of a tile: bit of the column word, above the ground.

    The same reckoning as :func:`mapvote.core.columns.fill_columns`, by which vehicles see the map.
    """
    ground = ground_z.reshape(-1)[cells].astype(np.float64)
    unknown = ~np.isfinite(ground)
    base = np.floor(np.where(unknown, 0.0, ground) / CELL_SIZE).astype(np.int64)
    if unknown.any():  # only then it takes the whole tile to tell
        base[unknown] = base_layers(ground_z).reshape(-1)[cells[unknown]]
    ground = np.where(unknown, base * CELL_SIZE, ground)
    z = points[:, 2].astype(np.float64)
    bit = np.clip(np.floor(z / CELL_SIZE).astype(np.int64) - base, 0, TOP_BIT)
    return bit, z - ground >= GROUND_MARGIN_M


def obstacle_bits(tile: MapTile, grid: Grid) -> U64:
    """(256, 256) column words of the tile's obstacle points."""
    cells = cells_of(grid, tile.points)
    bit, obstacle = columns_of(tile.points, cells, tile.ground_z)
    words = np.zeros(CELLS, dtype=np.uint64)
    np.bitwise_or.at(words, cells[obstacle], np.uint64(1) << bit[obstacle].astype(np.uint64))
    return words.reshape(TILE_CELLS, TILE_CELLS)
