"""Columns of evidence: every 0.3 m cell is one 64-bit word, bit i = voxel i of that column (METHOD 4).

Voxels lie on the world lattice: layer = floor(z / 0.3). Bit 0 is the layer that holds the ground of the
cell (``base``), so words follow the terrain and 64 bits reach 19.2 m above the road; the top bit
stands for everything from there upwards. Neighbouring cells are compared by shifting by their bases' difference.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Grid, tile_grid, window_around
from mapvote.core.points import _lower_envelope
from mapvote.core.types import F32, F64, I32, I64, U64, PointMap, Reference

GROUND_MARGIN_M = 0.3
"""Points lower than this above the ground are ground: they never make a cell occupied (METHOD 2)."""
TOP_BIT = 63


def base_layers(ground_z: F32) -> I32:
    """(rows, cols) lattice layer of bit 0: floor(ground_z / 0.3), unknown cells filled from the nearest known one."""
    known = np.isfinite(ground_z)
    if not known.any():
        return np.zeros(ground_z.shape, dtype=np.int32)
    low = np.where(known, ground_z, np.inf).astype(np.float64)
    _lower_envelope(low, 0.02 * CELL_SIZE, 0.02 * CELL_SIZE * np.sqrt(2.0))
    filled = np.where(known, ground_z.astype(np.float64), low)
    return np.floor(filled / CELL_SIZE).astype(np.int32)


@numba.njit(cache=True, nogil=True)
def fill_columns(
    rows: I64,
    cols: I64,
    z: F64,
    ground_z: F32,
    base: I32,
    margin: float,
    words: NDArray[np.uint64],
    counts: I32,
    bottom_z: F32,
    top_z: F32,
) -> None:
    """Enter points (cell indices inside the window, z in map metres) above ``ground + margin`` into the planes.

    Points of cells whose ground is unknown are measured from the filled base. Planes are changed in place.
    """
    for i in range(len(z)):
        r, c = rows[i], cols[i]
        if r < 0 or c < 0 or r >= words.shape[0] or c >= words.shape[1]:
            continue
        g = ground_z[r, c]
        if np.isnan(g):
            g = base[r, c] * CELL_SIZE
        if z[i] - g < margin:
            continue
        bit = int(np.floor(z[i] / CELL_SIZE)) - base[r, c]
        bit = min(max(bit, 0), TOP_BIT)
        words[r, c] |= np.uint64(1) << np.uint64(bit)
        counts[r, c] += 1
        bottom_z[r, c] = min(bottom_z[r, c], z[i])
        top_z[r, c] = max(top_z[r, c], z[i])


def reference_window(point_map: PointMap, grid: Grid) -> Reference:
    """The map's planes over ``grid`` (any window; what lies outside every tile is unknown and empty)."""
    ground_z = np.full(grid.shape, np.nan, dtype=np.float32)
    free = np.zeros(grid.shape, dtype=np.uint64)
    learned = False
    clouds = []
    for tile in grid.tiles():
        if tile not in point_map.tiles:
            continue
        content = point_map.tiles[tile]
        window = tile_grid(point_map.lattice, tile)
        common = window.intersection(grid)
        ground_z[common.slices_in(grid)] = content.ground_z[common.slices_in(window)]
        if content.free is not None:
            learned = True
            free[common.slices_in(grid)] = content.free[common.slices_in(window)]
        clouds.append(map_points(window, content.points))
    base = base_layers(ground_z)
    occupied = np.zeros(grid.shape, dtype=np.uint64)
    counts = np.zeros(grid.shape, dtype=np.int32)
    bottom_z = np.full(grid.shape, np.inf, dtype=np.float32)
    top_z = np.full(grid.shape, -np.inf, dtype=np.float32)
    for cloud in clouds:
        rows, cols, _ = grid.indices_of(cloud)
        fill_columns(rows, cols, cloud[:, 2], ground_z, base, GROUND_MARGIN_M, occupied, counts, bottom_z, top_z)
    return Reference(grid, ground_z, base, occupied, counts, bottom_z, top_z, free if learned else None)


def above_ground_points(point_map: PointMap, grid: Grid) -> U64:
    """(rows, cols) all bits where the map holds a ground point in the cell or next to it, else none.

    A stand-in for the known-free columns of a map that came without: whoever measured the ground there looked through
    the air above it, so an obstacle would most likely be in the map. Where there is no ground point, nobody can say.
    """
    wide = grid.padded(1)
    seen = np.zeros(wide.shape, dtype=np.bool_)
    for tile in wide.tiles():
        if tile in point_map.tiles:
            window = tile_grid(point_map.lattice, tile)
            content = point_map.tiles[tile]
            rows, cols, inside = window.indices_of(map_points(window, content.points))
            low = content.points[:, 2] - content.ground_z[rows * inside, cols * inside] < GROUND_MARGIN_M
            r, c = rows[low & inside] + window.row0 - wide.row0, cols[low & inside] + window.col0 - wide.col0
            here = (r >= 0) & (c >= 0) & (r < wide.rows) & (c < wide.cols)
            seen[r[here], c[here]] = True
    near = ndimage.binary_dilation(seen, structure=np.ones((3, 3)))[1:-1, 1:-1]
    return np.where(near, ~np.uint64(0), np.uint64(0))


def cut_reference(outer: Reference, window: Grid) -> Reference:
    """The planes of ``outer`` over ``window``, which lies inside it; views, nothing is copied."""
    cut = window.slices_in(outer.grid)
    return Reference(
        window,
        outer.ground_z[cut],
        outer.base[cut],
        outer.occupied[cut],
        outer.counts[cut],
        outer.bottom_z[cut],
        outer.top_z[cut],
        None if outer.free is None else outer.free[cut],
    )


class Surroundings:
    """The reference around a vehicle on the move: laid out over the tiles about it, anew only when it has left them."""

    def __init__(self, point_map: PointMap, window_m: float) -> None:
        self.point_map, self.window_m = point_map, window_m
        self.outer: Reference | None = None
        """The planes last laid out; windows are views into them."""

    def at(self, origin_map: F64) -> tuple[Reference, Reference]:
        """(the partial reference map R_i, ``window_m`` wide around ``origin_map`` (3,); the planes it is cut from)."""
        lattice = self.point_map.lattice
        window = window_around(lattice, origin_map[0], origin_map[1], self.window_m)
        if self.outer is None or window.intersection(self.outer.grid) != window:
            row, col = window.row0 + window.rows // 2, window.col0 + window.cols // 2
            centre = tile_grid(lattice, (row // TILE_CELLS, col // TILE_CELLS))
            self.outer = reference_window(self.point_map, centre.padded(max(TILE_CELLS, window.rows)))
        return cut_reference(self.outer, window), self.outer


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


@numba.njit(cache=True, nogil=True, inline="always")
def shifted(word: np.uint64, layers: int) -> np.uint64:
    """A column seen from a base ``layers`` lower (layers > 0: bits move up, what passes bit 63 is gone)."""
    if layers >= 64 or layers <= -64:
        return np.uint64(0)
    return word << np.uint64(layers) if layers >= 0 else word >> np.uint64(-layers)


@numba.njit(cache=True, nogil=True)
def neighbourhood(words: U64, base: I32, r: int, c: int, reach: int) -> np.uint64:
    """Voxels of column (r, c) within ``reach`` cells (a square) and one layer of a set bit; bases may differ."""
    rows, cols = words.shape
    near = np.uint64(0)
    for i in range(max(r - reach, 0), min(r + reach + 1, rows)):
        for j in range(max(c - reach, 0), min(c + reach + 1, cols)):
            if words[i, j]:
                near |= shifted(words[i, j], base[i, j] - base[r, c])
    return near | (near << np.uint64(1)) | (near >> np.uint64(1))


@numba.njit(cache=True, nogil=True)
def dilated(words: U64, base: I32, reach: int) -> U64:
    """:func:`neighbourhood` of every column, (rows, cols)."""
    out = np.empty_like(words)
    for r in range(words.shape[0]):
        for c in range(words.shape[1]):
            out[r, c] = neighbourhood(words, base, r, c, reach)
    return out
