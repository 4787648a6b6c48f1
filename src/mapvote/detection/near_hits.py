"""What a hit speaks for: the surfaces that lie within its own error, in whichever voxel they are."""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.columns import column_bit
from mapvote.core.grid import CELL_SIZE
from mapvote.core.types import F64, I32, U64, Bool
from mapvote.perception.frontend import Observation
from mapvote.perception.raycast import find_obstacles

HIT_REACH_M = 0.1
"""How far from it a hit may speak for a surface: range noise and pose sigma together, three times over (docs/decisions/
evidence.md has what other reaches do)."""


@numba.njit(cache=True, nogil=True)
def _mark_near(
    points: F64, cell: I32, chosen: Bool, base: I32, corner: tuple[float, float], reach: float, near: U64
) -> None:
    """Enter into ``near`` (rows, cols) the voxels that come within ``reach`` metres, along each axis, of the points."""
    rows, cols = base.shape
    for i in range(len(points)):
        if not chosen[i] or cell[i] < 0:
            continue
        r, c = cell[i] // cols, cell[i] % cols
        x, y, z = points[i, 0] - corner[0] - c * CELL_SIZE, points[i, 1] - corner[1] - r * CELL_SIZE, points[i, 2]
        last_r, last_c = min(r + (y > CELL_SIZE - reach), rows - 1), min(c + (x > CELL_SIZE - reach), cols - 1)
        for k in range(max(r - (y < reach), 0), last_r + 1):
            for j in range(max(c - (x < reach), 0), last_c + 1):
                low, high = column_bit(z - reach, base[k, j]), column_bit(z + reach, base[k, j])
                near[k, j] |= (np.uint64(2) << np.uint64(high)) - (np.uint64(1) << np.uint64(low))


def near_hits(seen: Observation) -> U64:
    """(rows, cols) words of the voxels that come within HIT_REACH_M of an obstacle point that does not move."""
    here, scan, grid = seen.reference, seen.scan, seen.view.grid
    near, base = np.zeros(grid.shape, dtype=np.uint64), np.ascontiguousarray(here.base)
    cell = scan.cell if here is scan.reference else find_obstacles(scan.points_map, here)[1]
    _mark_near(scan.points_map, cell, scan.obstacle & ~seen.moving, base, (grid.x0, grid.y0), HIT_REACH_M, near)
    return near
