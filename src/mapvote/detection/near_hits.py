"""What a hit speaks for: the surfaces that lie within its own error, in whichever voxel they are."""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.columns import layer_bit
from mapvote.core.grid import CELL_SIZE
from mapvote.core.types import F64, I32, U64, Bool
from mapvote.perception.frontend import Observation
from mapvote.perception.raycast import find_obstacles

HIT_REACH_M = 0.1
"""How far from it a hit may speak for a surface: range noise and pose sigma together, three times over (docs/decisions/
evidence.md has what other reaches do)."""


@numba.njit(inline="always")
def _column(cell: int, lowest: int, highest: int, base: I32) -> np.uint64:
    """The word of the layers ``lowest`` to ``highest`` of the world in one column."""
    low, high = layer_bit(lowest, base[cell]), layer_bit(highest, base[cell])
    return (np.uint64(2) << np.uint64(high)) - (np.uint64(1) << np.uint64(low))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mark_near(
    points: F64, cell: I32, chosen: Bool, base: I32, occupied: U64, cols: int, corner: tuple[float, float],
    reach: float, near: U64, apart: U64,
) -> None:  # fmt: skip
    """Enter into ``near`` the voxels that come within ``reach`` cells, along each axis, of the points, and into
    ``apart`` the voxel of each that has none of the map's so near; the planes are flat, ``cols`` wide."""
    last_row, last_col = len(base) // cols - 1, cols - 1
    for i in range(np.uint64(0), np.uint64(len(points))):
        if not chosen[i] or cell[i] < 0:
            continue
        x, y = (points[i, 0] - corner[0]) / CELL_SIZE, (points[i, 1] - corner[1]) / CELL_SIZE
        left, right = max(int(x - reach), 0), min(int(x + reach), last_col)
        first, last = cols * max(int(y - reach), 0), cols * min(int(y + reach), last_row)
        z = points[i, 2] / CELL_SIZE
        lowest, highest = int(np.floor(z - reach)), int(np.floor(z + reach))
        mapped = np.uint64(0)
        for column in (first + left, first + right, last + left, last + right):  # mostly the same one four times
            word = _column(np.uint64(column), lowest, highest, base)
            near[np.uint64(column)] |= word
            mapped |= occupied[np.uint64(column)] & word
        if not mapped:
            own, layer = np.uint64(cell[i]), int(np.floor(z))
            apart[own] |= _column(own, layer, layer, base)


def near_hits(seen: Observation) -> tuple[U64, U64]:
    """(rows, cols) words, twice: the voxels that come within HIT_REACH_M of an obstacle point that does not move; and
    those that hold such a point from which no voxel of the map is so near, so that nothing of the map explains it."""
    here, scan, grid = seen.reference, seen.scan, seen.view.grid
    near, apart = np.zeros(grid.shape, dtype=np.uint64), np.zeros(grid.shape, dtype=np.uint64)
    cell = scan.cell if here is scan.reference else find_obstacles(scan.points_map, here)[1]
    chosen, reach, corner = scan.obstacle & ~seen.moving, HIT_REACH_M / CELL_SIZE, (grid.x0, grid.y0)
    _mark_near(
        scan.points_map, cell, chosen, here.base.ravel(), here.occupied.ravel(), grid.shape[1], corner,
        reach, near.ravel(), apart.ravel(),
    )  # fmt: skip
    return near, apart
