"""What one scan saw, passed through and could not see, as planes over the local grid (paper III-A).

Rays are gathered into fans of about a beam's width in azimuth. A fan is walked once over the cells
it crosses; in each cell, every ray that is still on its way marks the voxels between its height on
entering and on leaving. One walk thus serves all beams of a firing, and the 3D question becomes a 2D one.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numba
import numpy as np
from numpy.typing import NDArray

from mapvote.core.columns import GROUND_MARGIN_M, TOP_BIT, column_bit, height_above
from mapvote.core.geometry import turn
from mapvote.core.grid import CELL_SIZE, Grid
from mapvote.core.types import F32, F64, I32, U8, U64, Bool, Reference

FANS = 2048
"""Fans in a turn (0.18 deg, a firing or two): two cross every cell at 40 m. A fan's direction is its rays' mean."""
CLEARANCE_M = 0.45
"""A ray proves emptiness only up to here before its own hit: half a voxel's diagonal, range noise and pose error."""
FULL_RANGE_M = 25.0
"""Nearer than this every second fan suffices for two to a cell, nearer than half of it every fourth, and so on."""
INFINITY = np.float32(np.inf)


class Sight(IntEnum):
    """How far a cell could be seen, the best of all fans that cross it."""

    NEVER = 0
    """No ray was fired that way: the scan says nothing."""
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
    """:class:`Sight` of the cell."""


@numba.njit(cache=True, nogil=True)
def _obstacles(
    points: F64, ground_z: F32, base: I32, lattice: tuple[float, float], corner: tuple[int, int],
    cell: I32, obstacle: NDArray[np.bool_],
) -> None:  # fmt: skip
    rows, cols = ground_z.shape
    for i in range(len(points)):  # cells as Lattice.cells_of has them, to the last bit
        c = int(np.floor((points[i, 0] - lattice[0]) / CELL_SIZE)) - corner[1]
        r = int(np.floor((points[i, 1] - lattice[1]) / CELL_SIZE)) - corner[0]
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


@numba.njit(cache=True, nogil=True)
def _enter_hits(points: F64, cell: I32, keep: NDArray[np.bool_], base: I32, counts: I32, hit: U64) -> None:
    """Stationary obstacle points into counts and hit words (flat planes, in place)."""
    for i in range(len(points)):
        if keep[i] and cell[i] >= 0:
            k = cell[i]
            hit[k] |= np.uint64(1) << np.uint64(column_bit(points[i, 2], base[k]))
            counts[k] += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rays(points: F64, origin: F64, clearance: float) -> tuple[F32, F32, F32, I32]:
    """(reach, slope, stop, fan) of every ray, each (n,): see :func:`_gather`. No branches, so that it vectorises."""
    n = len(points)
    reach, slope, stop = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    fan = np.empty(n, np.int32)
    for i in range(n):
        dx, dy = np.float32(points[i, 0] - origin[0]), np.float32(points[i, 1] - origin[1])
        dz = np.float32(points[i, 2] - origin[2])
        h = np.sqrt(dx * dx + dy * dy)
        reach[i] = h
        slope[i] = dz / (np.float32(CELL_SIZE) * h)
        stop[i] = h - np.float32(clearance) * h / np.sqrt(h * h + dz * dz)
        fan[i] = min(np.int32(turn(dx, dy) * np.float32(FANS)), np.int32(FANS - 1))
    return reach, slope, stop, fan


@numba.njit(cache=True, nogil=True)
def _gather(
    points: F64, obstacle: NDArray[np.bool_], origin: F64, clearance: float
) -> tuple[I32, F32, F32, F64, F32, F32]:
    """Sort rays into fans: (start (FANS + 1,), slope, stop, direction (FANS, 2), nearest, farthest).

    ``slope`` voxels of height per metre of horizontal way; ``stop`` horizontal metres to the end of what the ray
    proves, descending within a fan; ``nearest`` obstacle and ``farthest`` return of each fan, horizontal metres.
    """
    reach, rise, end, fan = _rays(points, origin, clearance)
    start = np.zeros(FANS + 1, np.int32)
    direction = np.zeros((FANS, 2))
    nearest = np.full(FANS, INFINITY, np.float32)
    farthest = np.zeros(FANS, np.float32)
    for i in range(len(points)):
        h, f = reach[i], fan[i]
        if not h >= CELL_SIZE:  # the sensor's own cell proves nothing
            continue
        start[f + 1] += 1
        direction[f, 0] += (points[i, 0] - origin[0]) / h
        direction[f, 1] += (points[i, 1] - origin[1]) / h
        farthest[f] = max(farthest[f], h)
        if obstacle[i] and h < nearest[f]:
            nearest[f] = h
    for f in range(FANS):
        start[f + 1] += start[f]
        norm = np.sqrt(direction[f, 0] ** 2 + direction[f, 1] ** 2)
        if norm > 0.0:
            direction[f, 0] /= norm
            direction[f, 1] /= norm
    slope = np.empty(start[FANS], np.float32)
    stop = np.empty(start[FANS], np.float32)
    filled = start[:FANS].copy()
    for i in range(len(points)):
        if not reach[i] >= CELL_SIZE:
            continue
        f = fan[i]
        k = filled[f]
        while k > start[f] and stop[k - 1] < end[i]:  # insertion: a fan has a few dozen rays, mostly in order
            stop[k] = stop[k - 1]
            slope[k] = slope[k - 1]
            k -= 1
        stop[k] = end[i]
        slope[k] = rise[i]
        filled[f] += 1
    return start, slope, stop, direction, nearest, farthest


@numba.njit(cache=True, nogil=True)
def _voxels_between(
    slope: F32, stop: F32, active: int, height: np.float32, t0: np.float32, t1: np.float32, base: int
) -> np.uint64:
    """Bits of a column that ``active`` rays touch between horizontal distances t0 and t1, heights in voxels."""
    word = np.uint64(0)
    for k in range(active):
        enter = np.int64(np.floor(height + slope[k] * t0)) - base
        leave = np.int64(np.floor(height + slope[k] * min(t1, stop[k]))) - base
        low = np.uint64(min(max(int(min(enter, leave)), 0), TOP_BIT))
        high = np.uint64(min(max(int(max(enter, leave)) + 1, 0), TOP_BIT))
        word |= (np.uint64(1) << high) - (np.uint64(1) << low)
    return word


@numba.njit(cache=True, nogil=True)
def _walk(
    start: I32, slope: F32, stop: F32, direction: F64, nearest: F32, farthest: F32,
    origin: F64, x0: float, y0: float, base: I32, passed: U64, sight: U8,
) -> None:  # fmt: skip
    """Walk every fan from the sensor to the edge of the window (Amanatides and Woo 1987), marking planes in place."""
    rows, cols = base.shape
    layer = int(np.floor(origin[2] / CELL_SIZE))
    height = np.float32(origin[2] / CELL_SIZE - layer)
    x, y = (origin[0] - x0) / CELL_SIZE, (origin[1] - y0) / CELL_SIZE
    for f in range(FANS):
        active = start[f + 1] - start[f]
        if active == 0:
            continue
        fan_slope, fan_stop = slope[start[f] : start[f + 1]], stop[start[f] : start[f + 1]]
        dx, dy = direction[f]
        c, r = int(np.floor(x)), int(np.floor(y))
        step_c, step_r = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        far = 1e18
        next_c = far if dx == 0.0 else ((c + (dx > 0)) - x) / dx * CELL_SIZE
        next_r = far if dy == 0.0 else ((r + (dy > 0)) - y) / dy * CELL_SIZE
        width_c = far if dx == 0.0 else CELL_SIZE / abs(dx)
        width_r = far if dy == 0.0 else CELL_SIZE / abs(dy)
        t0 = 0.0
        marks_from, turn = FULL_RANGE_M, f
        while turn % 2 == 0 and marks_from > CELL_SIZE:
            marks_from, turn = 0.5 * marks_from, turn // 2
        marks_from = 0.0 if marks_from <= CELL_SIZE else marks_from
        while 0 <= r < rows and 0 <= c < cols:
            t1 = min(next_c, next_r)
            level = 1 if t0 > farthest[f] else (2 if t0 > nearest[f] else 3)
            if sight[r, c] < level:
                sight[r, c] = level
            while active > 0 and fan_stop[active - 1] <= t0:
                active -= 1
            if active > 0 and t1 > marks_from:
                passed[r, c] |= _voxels_between(
                    fan_slope, fan_stop, active, height, np.float32(t0), np.float32(t1), base[r, c] - layer
                )
            t0 = t1
            if next_c < next_r:
                c += step_c
                next_c += width_c
            else:
                r += step_r
                next_r += width_r


def cast_rays(
    points_map: F64, origin_map: F64, obstacle: Bool, moving: Bool, reference: Reference, cell: I32 | None = None
) -> ScanView:
    """One scan's planes over ``reference.grid``, which must hold the sensor.

    ``points_map`` (n, 3) and ``origin_map`` (3,) map metres; ``obstacle`` (n,) as :func:`find_obstacles` gives it
    (which also gives ``cell``, if it is not to be computed again). Points of ``moving`` objects occlude but do not
    occupy (docs/decisions/paper.md); the rays of ground points prove emptiness above the ground.
    """
    if cell is None:
        _, cell = find_obstacles(points_map, reference)
    grid = reference.grid
    counts = np.zeros(grid.shape, dtype=np.int32)
    hit = np.zeros(grid.shape, dtype=np.uint64)
    passed = np.zeros(grid.shape, dtype=np.uint64)
    sight = np.zeros(grid.shape, dtype=np.uint8)
    base = np.ascontiguousarray(reference.base)
    _enter_hits(points_map, cell, obstacle & ~moving, base.ravel(), counts.ravel(), hit.ravel())
    fans = _gather(points_map, obstacle, origin_map, CLEARANCE_M)
    _walk(*fans, origin_map, grid.x0, grid.y0, base, passed, sight)
    return ScanView(grid, counts, hit, passed, sight)
