"""The votes and new points of one drive, kept tile by tile so that memory follows the road, not its length in scans."""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.grid import CELL_SIZE, Grid, Lattice, TileIndex, tile_of_cells
from mapvote.core.types import F32, F64, I32, U64, Bool, Reference
from mapvote.core.voxels import voxel_keys
from mapvote.perception.frontend import Observation, PlacedScan
from mapvote.perception.raycast import find_obstacles

_COMPACT_AT = 200_000
REACH_M = 70.0
"""New points are taken up to here, farther than votes are cast: a tile's width around the vehicle is laid out."""


@numba.njit(cache=True, nogil=True)
def select(points: F64, cell: I32, stationary: Bool, words: U64, base: I32) -> Bool:
    """(n,) which of the ``stationary`` points (n, 3) lie in a voxel of ``words`` (cells,); ``cell`` (n,) -1 outside."""
    out = np.zeros(len(points), dtype=np.bool_)
    for i in range(len(points)):
        if stationary[i] and cell[i] >= 0 and words[cell[i]]:
            bit = int(np.floor(points[i, 2] / CELL_SIZE)) - base[cell[i]]
            out[i] = (words[cell[i]] >> np.uint64(min(max(bit, 0), 63))) & np.uint64(1) != 0
    return out


class NewPoints:
    """One point per 0.3 m voxel, the first that was offered: candidates for changed-occupied cells."""

    def __init__(self, lattice: Lattice, beyond: bool = True) -> None:
        """``beyond``: also what lies outside the local grid. The paper has none of it, and the filter of moving objects
        does not look there: only rules that ask more of a new voxel than that a scan struck it can take it."""
        self.lattice, self.beyond = lattice, beyond
        self._outer: Reference | None = None
        self._unmapped: U64 = np.zeros((0, 0), dtype=np.uint64)
        self._points = np.zeros((0, 3))
        self._waiting: list[F64] = []
        self._count = 0

    def gather(self, seen: Observation, may_be_new: U64) -> None:
        """The points of one scan: of its view, those in voxels of ``may_be_new`` (rows, cols); and what lies beyond."""
        scan = seen.scan
        chosen = select(
            scan.points_map, scan.cell, scan.obstacle & ~seen.moving, may_be_new.ravel(), _flat_base(scan.reference)
        )
        self.offer(scan.points_map[chosen])
        if self.beyond:
            self.offer(self._strange_beyond(scan))

    def _strange_beyond(self, scan: PlacedScan) -> F64:
        """(m, 3) obstacle points outside the local grid, within reach, in voxels that the map does not hold.

        They cast no vote. But the upper storeys of what is new can be seen only from afar, below the sensor's top beam.
        """
        if self._outer is not scan.outer:
            self._outer, self._unmapped = scan.outer, ~scan.outer.occupied
        outside = scan.points_map[scan.cell < 0]
        off = outside[:, :2] - scan.origin_map[:2]
        far = outside[np.einsum("ij,ij->i", off, off) < REACH_M**2]
        obstacle, cell = find_obstacles(far, scan.outer)
        return far[select(far, cell, obstacle, self._unmapped.ravel(), _flat_base(scan.outer))]

    def offer(self, points_map: F64) -> None:
        """Points (n, 3), map metres."""
        if len(points_map):
            self._waiting.append(points_map)
            self._count += len(points_map)
            if self._count > _COMPACT_AT:
                self._compact()

    def _compact(self) -> None:
        every = np.concatenate([self._points, *self._waiting])
        keys = voxel_keys(every, self.lattice.x0, self.lattice.y0)
        _, first = np.unique(keys, return_index=True)  # sorted by key; the earliest of each
        self._points, self._waiting, self._count = every[first], [], 0

    def by_tile(self) -> dict[TileIndex, F64]:
        """Points (m, 3) in map metres of each tile, sorted by voxel key."""
        self._compact()
        rows, cols = tile_of_cells(*self.lattice.cells_of(self._points))
        tiles = sorted({(int(r), int(c)) for r, c in zip(*np.unique([rows, cols], axis=1), strict=True)})
        return {(r, c): self._points[(rows == r) & (cols == c)] for r, c in tiles}


def points_in(window: Grid, points_map: F64, words: U64, base: I32) -> F32:
    """Those of ``points_map`` (n, 3) that lie in voxels of ``words`` (256, 256) of a tile, float32 from its corner."""
    rows, cols, _ = window.indices_of(points_map)
    cell = (rows * window.cols + cols).astype(np.int32)
    wanted = select(points_map, cell, np.ones(len(points_map), np.bool_), words.ravel(), base.ravel())
    return window.from_map(points_map[wanted])


def _flat_base(reference: Reference) -> I32:
    return np.ascontiguousarray(reference.base).ravel()
