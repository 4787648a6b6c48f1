"""One world lattice of square cells; every grid, tile and window is an integer piece of it.

Cell index = floor((x - x0) / cell_size) in float64, half-open cells (paper II: 0.3 m). Rows follow y
and columns follow x, as in nav_msgs/OccupancyGrid. Laying one grid on another is a slice, never a
resampling.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CELL_SIZE = 0.3
"""Side of a cell and of a voxel, metres (paper II)."""
TILE_CELLS = 256
"""Cells along a tile's side: 76.8 m. The one tiling, for states, points and columns alike."""

TileIndex = tuple[int, int]
"""(row, col) of a tile: cells [256 row, 256 row + 256) x [256 col, 256 col + 256)."""


@dataclass(frozen=True, slots=True)
class Lattice:
    """Where cell (0, 0) has its lower-left corner, in map metres. Stored once per map."""

    x0: float = 0.0
    y0: float = 0.0

    def cells_of(self, xy: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(rows, cols), each (n,) int64, of points (n, 2+) in map metres."""
        col = np.floor((xy[:, 0].astype(np.float64) - self.x0) / CELL_SIZE).astype(np.int64)
        row = np.floor((xy[:, 1].astype(np.float64) - self.y0) / CELL_SIZE).astype(np.int64)
        return row, col

    def cell_of(self, x: float, y: float) -> tuple[int, int]:
        """(row, col) of one place, map metres: :meth:`cells_of` without arrays."""
        return math.floor((float(y) - self.y0) / CELL_SIZE), math.floor((float(x) - self.x0) / CELL_SIZE)

    def tile(self, index: TileIndex) -> Grid:
        """The window of one tile."""
        return Grid(self, index[0] * TILE_CELLS, index[1] * TILE_CELLS, TILE_CELLS, TILE_CELLS)


@dataclass(frozen=True, slots=True)
class Grid:
    """A window of a lattice: cells [row0, row0 + rows) x [col0, col0 + cols)."""

    lattice: Lattice
    row0: int
    col0: int
    rows: int
    cols: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.cols

    @property
    def x0(self) -> float:
        """Map x of the lower-left corner, metres."""
        return self.lattice.x0 + self.col0 * CELL_SIZE

    @property
    def y0(self) -> float:
        """Map y of the lower-left corner, metres."""
        return self.lattice.y0 + self.row0 * CELL_SIZE

    def indices_of(self, xy: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """(rows, cols, inside) of points (n, 2+) in map metres, relative to this window."""
        row, col = self.lattice.cells_of(xy)
        row -= self.row0
        col -= self.col0
        return row, col, (row >= 0) & (row < self.rows) & (col >= 0) & (col < self.cols)

    def value_at(self, plane: NDArray[Any], xy: NDArray[np.floating], outside: object = False) -> NDArray[Any]:
        """(n,) what ``plane`` (rows, cols) of this window holds at points (n, 2+) in map metres."""
        rows, cols, inside = self.indices_of(xy)
        out = np.full(len(xy), outside, dtype=plane.dtype)
        out[inside] = plane[rows[inside], cols[inside]]
        return out

    def to_map(self, points: NDArray[np.float32]) -> NDArray[np.float64]:
        """Points (n, 3) whose x, y are metres from this window's corner, in map metres, float64."""
        out = points.astype(np.float64)
        out[:, 0] += self.x0
        out[:, 1] += self.y0
        return out

    def from_map(self, points_map: NDArray[np.floating]) -> NDArray[np.float32]:
        """Points (n, 3) in map metres as float32 from this window's corner, kept inside the half-open window.

        Rounding to float32 must not carry a point over the far edge, into the next tile.
        """
        local = points_map.astype(np.float64)
        local[:, 0] -= self.x0
        local[:, 1] -= self.y0
        out = local.astype(np.float32)
        for axis, cells in ((0, self.cols), (1, self.rows)):
            edge = np.nextafter(np.float32(cells * CELL_SIZE), np.float32(0.0))
            out[:, axis] = np.clip(out[:, axis], np.float32(0.0), edge)
        return out

    @property
    def tile_index(self) -> TileIndex:
        """The tile whose lower-left corner is this window's; for windows made by :meth:`Lattice.tile`."""
        return self.row0 // TILE_CELLS, self.col0 // TILE_CELLS

    def centres(self) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """(x of each column, y of each row), map metres."""
        x: NDArray[np.floating] = self.x0 + (np.arange(self.cols, dtype=np.float64) + 0.5) * CELL_SIZE
        y: NDArray[np.floating] = self.y0 + (np.arange(self.rows, dtype=np.float64) + 0.5) * CELL_SIZE
        return x, y

    def intersection(self, other: Grid) -> Grid:
        """The common window; rows or cols are 0 where they do not overlap. Raises ValueError on different lattices."""
        if self.lattice != other.lattice:
            raise ValueError(f"grids of different lattices: {self.lattice} and {other.lattice}")
        row0 = max(self.row0, other.row0)
        col0 = max(self.col0, other.col0)
        rows = max(0, min(self.row0 + self.rows, other.row0 + other.rows) - row0)
        cols = max(0, min(self.col0 + self.cols, other.col0 + other.cols) - col0)
        return Grid(self.lattice, row0, col0, rows, cols)

    def union(self, other: Grid) -> Grid:
        """The smallest window that holds both."""
        if self.lattice != other.lattice:
            raise ValueError(f"grids of different lattices: {self.lattice} and {other.lattice}")
        row0 = min(self.row0, other.row0)
        col0 = min(self.col0, other.col0)
        row1 = max(self.row0 + self.rows, other.row0 + other.rows)
        col1 = max(self.col0 + self.cols, other.col0 + other.cols)
        return Grid(self.lattice, row0, col0, row1 - row0, col1 - col0)

    def slices_in(self, outer: Grid) -> tuple[slice, slice]:
        """Where this window lies in arrays of ``outer``. Raises ValueError if it is not wholly inside."""
        row = self.row0 - outer.row0
        col = self.col0 - outer.col0
        if row < 0 or col < 0 or row + self.rows > outer.rows or col + self.cols > outer.cols:
            raise ValueError(f"{self} is not inside {outer}")
        return slice(row, row + self.rows), slice(col, col + self.cols)

    def padded(self, cells: int) -> Grid:
        """The window grown by ``cells`` on each side."""
        return Grid(self.lattice, self.row0 - cells, self.col0 - cells, self.rows + 2 * cells, self.cols + 2 * cells)

    def tiles(self) -> Iterator[TileIndex]:
        """Indices of the tiles that this window touches, row by row."""
        for row in range(self.row0 // TILE_CELLS, -(-(self.row0 + self.rows) // TILE_CELLS)):
            for col in range(self.col0 // TILE_CELLS, -(-(self.col0 + self.cols) // TILE_CELLS)):
                yield row, col


def window_around(lattice: Lattice, x: float, y: float, side_m: float) -> Grid:
    """The square window of about ``side_m`` metres centred on the cell of (x, y) (paper III-A: 80 m)."""
    half = round(0.5 * side_m / CELL_SIZE)
    row, col = lattice.cell_of(x, y)
    return Grid(lattice, row - half, col - half, 2 * half + 1, 2 * half + 1)


CELLS = TILE_CELLS * TILE_CELLS
