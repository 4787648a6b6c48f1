"""What one scan saw, passed through and could not see, as planes over the local grid (paper III-A).

The walk over the cells is in mapvote.perception.fans: the 3D question becomes a 2D one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from mapvote.core.columns import GROUND_MARGIN_M, column_bit, height_above
from mapvote.core.geometry import rows_from
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.kernel import kernel
from mapvote.core.types import F32, F64, I32, U8, U64, Bool, Reference
from mapvote.perception.fans import Rays, follow_rays, gather_rays, mark_passed
from mapvote.perception.free_rays import mark_sight

CLEARANCE_M = 0.45
"""A ray proves emptiness only up to here before its own hit: half a voxel's diagonal, range noise and pose error."""


class Sight(IntEnum):
    """How far a cell could be seen, the best of all fans that cross it."""

    NEVER = 0
    """No ray was fired in this direction: no observation."""
    BEYOND = 1
    """Behind the farthest return of every fan."""
    BEHIND = 2
    """Behind a fan's nearest obstacle, but before its farthest return: visible under ``farthest_return``."""
    CLEAR = 3
    """Before or at the nearest obstacle of some fan: visible under ``first_hit``."""


@dataclass(frozen=True, slots=True)
class ScanView:
    """One scan on the local grid. All planes are (rows, cols) of ``grid``."""

    grid: Grid
    counts: I32
    """Obstacle points of stationary objects in the cell: n of paper Eq. (1)."""
    hit: U64
    """Column words of those points."""
    passed: U64
    """Column words of voxels that a ray passed well before its own hit. Bit 63 (all above) is never passed."""
    sight: U8
    """:class:`Sight` of the cell; (0, 0) if not requested."""


@kernel
def _obstacles(
    points: F64, ground_z: F32, base: I32, lattice: tuple[float, float], corner: tuple[int, int],
    cell: I32, obstacle: NDArray[np.bool_],
) -> None:  # fmt: skip
    rows, cols = ground_z.shape
    (x0, y0), (row0, col0) = lattice, corner
    for i in range(len(points)):  # cells as Lattice.cells_of has them, to the last bit
        c = int(np.floor((points[i, 0] - x0) / CELL_SIZE)) - col0
        r = int(np.floor((points[i, 1] - y0) / CELL_SIZE)) - row0
        cell[i] = -1
        obstacle[i] = False
        if r < 0 or c < 0 or r >= rows or c >= cols:
            continue
        cell[i] = r * cols + c
        obstacle[i] = height_above(points[i, 2], ground_z[r, c], base[r, c]) >= GROUND_MARGIN_M


def find_obstacles(points_map: F64, reference: Reference) -> tuple[Bool, I32]:
    """(obstacle (n,) bool, cell (n,) int32) of points (n, 3), map metres.

    By the rule that built the reference, see :func:`mapvote.core.columns.height_above`. ``cell`` is row * cols + col in
    the reference's grid, -1 outside it.
    """
    cell = np.empty(len(points_map), dtype=np.int32)
    obstacle = np.empty(len(points_map), dtype=np.bool_)
    grid = reference.grid
    lattice, corner = (grid.lattice.x0, grid.lattice.y0), (grid.row0, grid.col0)
    _obstacles(points_map, reference.ground_z, reference.base, lattice, corner, cell, obstacle)
    return obstacle, cell


@kernel
def _enter_hits(points: F64, cell: I32, keep: NDArray[np.bool_], base: I32, counts: I32, hit: U64) -> None:
    """Stationary obstacle points into counts and hit words (flat planes, in place)."""
    for i in range(len(points)):
        if keep[i] and cell[i] >= 0:
            k = cell[i]
            hit[k] |= np.uint64(1) << np.uint64(column_bit(points[i, 2], base[k]))
            counts[k] += 1


def cast_rays(
    points_map: F64,
    origin_map: F64,
    obstacle: Bool,
    moving: Bool,
    reference: Reference,
    cell: I32 | None = None,
    with_sight: bool = True,
    sky: Callable[[Rays], Rays] | None = None,
) -> ScanView:
    """One scan's planes over ``reference.grid``, which must hold the sensor.

    ``points_map`` (n, 3) and ``origin_map`` (3,) map metres; ``obstacle`` (n,) as :func:`find_obstacles` gives it
    (which also gives ``cell``, if it is not to be computed again). Points of ``moving`` objects occlude but do not
    occupy (docs/method.md); the rays of ground points prove emptiness above the ground. Without ``with_sight``
    the view has none: rays are followed to their ends only. ``sky``: which rays passed into the
    sky (perception/free_rays.py); they are followed, too.
    """
    if cell is None:
        _, cell = find_obstacles(points_map, reference)
    grid = reference.grid
    counts = np.zeros(grid.shape, dtype=np.int32)
    hit = np.zeros(grid.shape, dtype=np.uint64)
    passed = np.zeros(grid.shape, dtype=np.uint64)
    sight = np.zeros(grid.shape if with_sight else (0, 0), dtype=np.uint8)
    base = np.ascontiguousarray(reference.base)
    _enter_hits(points_map, cell, obstacle & ~moving, base.ravel(), counts.ravel(), hit.ravel())
    rays = follow_rays(rows_from(points_map, origin_map), CLEARANCE_M)
    fans = gather_rays(rays)
    mark_passed(fans, origin_map, (grid.x0, grid.y0), base, passed.ravel())
    if sky is not None:
        mark_passed(gather_rays(sky(rays)), origin_map, (grid.x0, grid.y0), base, passed.ravel())
    if with_sight:
        mark_sight(rays, obstacle, fans, origin_map, (grid.x0, grid.y0), sight)
    return ScanView(grid, counts, hit, passed, sight)
