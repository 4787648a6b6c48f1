"""Kernels of the moving-object filter: range images, looks into them, and cells that move together (moving.py)."""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.geometry import turn
from mapvote.core.types import F32, F64, I32, I64, U8, Bool
from mapvote.core.voxels import slot_of, voxel_key

NOTHING = np.float32(np.inf)
"""Of a range image: no return in that direction."""


@numba.njit(cache=True, nogil=True)
def range_image(points: F64, origin: F64, turns: int, slopes: int, slope_min: float, slope_step: float) -> F32:
    """(turns, slopes) nearest horizontal range among the returns in each direction and to its left and right."""
    out = np.full((turns, slopes), NOTHING, dtype=np.float32)
    per_slope = 1.0 / slope_step
    for i in range(len(points)):
        x, y, z = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        rho = np.float32(np.sqrt(x * x + y * y))
        if rho < 0.5:
            continue
        row = (z / rho - slope_min) * per_slope
        if row < 0.0 or row >= slopes:
            continue
        b = int(row)
        a = min(int(turn(np.float32(x), np.float32(y)) * turns), turns - 1)
        left = a - 1 if a > 0 else turns - 1
        right = a + 1 if a + 1 < turns else 0
        out[left, b] = min(out[left, b], rho)
        out[a, b] = min(out[a, b], rho)
        out[right, b] = min(out[right, b], rho)
    return out


@numba.njit(cache=True, nogil=True)
def voxels(points: F64, obstacle: Bool, origin: F64, reach: float, cell: float) -> tuple[I32, I64]:
    """(voxel_of (n,), first point of each voxel (m,)), voxels in order of their first points; -1 for no voxel."""
    n = len(points)
    size = 1024
    while size < 2 * obstacle.sum():
        size *= 2
    keys, rows = np.zeros(size, dtype=np.int64), np.empty(size, dtype=np.int32)
    first = np.empty(n, dtype=np.int64)
    voxel_of = np.full(n, -1, dtype=np.int32)
    m = 0
    for i in range(n):
        if not obstacle[i]:
            continue
        x, y = points[i, 0] - origin[0], points[i, 1] - origin[1]
        if x * x + y * y > reach * reach:
            continue
        key = voxel_key(points[i, 0], points[i, 1], points[i, 2], cell)
        slot = slot_of(key, keys)
        if keys[slot] == 0:
            keys[slot], rows[slot], first[m] = key, m, i
            m += 1
        voxel_of[i] = rows[slot]
    return voxel_of, first[:m].copy()


@numba.njit(cache=True, nogil=True)
def look(
    samples: F64,
    nearest: F32,
    origin: F64,
    slope_min: float,
    slope_step: float,
    margin: float,
    height: float,
    enough: int,
    free: I32,
    hit: I32,
    sides: U8,
    waiting: I32,
) -> int:
    """Ask one scan about the ``waiting`` samples: did it see through, did it hit, or neither? Counts go up in place.

    Rays within ``height`` above and below the sample bear witness. ``sides`` keeps whether a ray went through
    below (1) and above (2): a ray that only ever passes over a roof proves nothing about the roof. A sample of which
    ``enough`` scans said the same, and none the contrary, waits no longer; ``waiting`` is compacted in place
    and its new length returned.
    """
    turns, slopes = nearest.shape
    per_slope = 1.0 / slope_step
    left = 0
    for w in range(len(waiting)):
        i = waiting[w]
        waiting[left] = i
        left += 1
        x, y, z = samples[i, 0] - origin[0], samples[i, 1] - origin[1], samples[i, 2] - origin[2]
        rho = np.sqrt(x * x + y * y)
        if rho < 0.5:
            continue
        row = (z / rho - slope_min) * per_slope
        around = min(max(int(height / rho * per_slope), 2), 8)
        b = int(np.floor(row))
        if b < around or b + around >= slopes:
            continue
        a = min(int(turn(np.float32(x), np.float32(y)) * turns), turns - 1)
        below, above = NOTHING, NOTHING
        for k in range(1, around + 1):
            if nearest[a, b - k] < below:
                below = nearest[a, b - k]
            if nearest[a, b + k] < above:
                above = nearest[a, b + k]
        r = min(nearest[a, b], min(below, above))
        if r == NOTHING or r < rho - margin:
            continue
        if r > rho + margin:
            free[i] += 1
            if below < NOTHING:
                sides[i] |= 1
            if above < NOTHING:
                sides[i] |= 2
        else:
            hit[i] += 1
        if (free[i] == 0 and hit[i] >= enough) or (hit[i] == 0 and free[i] >= enough and sides[i] == 3):
            left -= 1
    return left


@numba.njit(cache=True, nogil=True)
def flood(cells: I64, wanted: Bool, side: int) -> I32:
    """Label of each cell (m,) by 8-connected component of the wanted ones, from 0; -1 for the unwanted.

    ``cells`` (m,) are distinct indices row * side + col with 0 < row, col < side - 1.
    """
    plane = np.full(side * side, -1, dtype=np.int32)
    for k in range(len(cells)):
        if wanted[k]:
            plane[cells[k]] = k
    label = np.full(len(cells), -1, dtype=np.int32)
    stack = np.empty(len(cells), dtype=np.int32)
    count = 0
    for seed in range(len(cells)):
        if not wanted[seed] or label[seed] >= 0:
            continue
        label[seed] = count
        stack[0] = seed
        top = 1
        while top > 0:
            top -= 1
            at = cells[stack[top]]
            for dr in range(-1, 2):
                for dc in range(-1, 2):
                    k = plane[at + dr * side + dc]
                    if k >= 0 and label[k] < 0:
                        label[k] = count
                        stack[top] = k
                        top += 1
        count += 1
    return label


@numba.njit(cache=True, nogil=True)
def moving_components(
    rows: I64,
    cols: I64,
    side: int,
    seen: Bool,
    brief: Bool,
    min_voxels: int,
    share_whole: float,
    share_part: float,
) -> Bool:
    """Which voxels move (m,), from which were decidable (``seen``) and occupied only briefly (``brief``).

    Connected cells move together: a component of the plane moves as a whole if at least ``share_whole`` of its
    decidable voxels were brief. Where a mover touches something static, the component splits at the cells that are
    mostly static, and each remaining part moves if at least ``share_part`` of it was brief.
    """
    m = len(rows)
    plane = np.full(side * side, -1, dtype=np.int32)
    cell_of = np.empty(m, dtype=np.int32)
    cells = np.empty(m, dtype=np.int64)
    n_cells = 0
    for i in range(m):
        at = rows[i] * side + cols[i]
        if plane[at] < 0:
            plane[at] = n_cells
            cells[n_cells] = at
            n_cells += 1
        cell_of[i] = plane[at]
    cells = cells[:n_cells]
    n_seen = np.zeros(n_cells, dtype=np.int64)
    n_brief = np.zeros(n_cells, dtype=np.int64)
    for i in range(m):
        n_seen[cell_of[i]] += seen[i]
        n_brief[cell_of[i]] += brief[i]

    moves = np.zeros(n_cells, dtype=np.bool_)
    wanted = np.ones(n_cells, dtype=np.bool_)
    for share in (share_whole, share_part):
        label = flood(cells, wanted, side)
        total = np.zeros(n_cells, dtype=np.int64)
        moving = np.zeros(n_cells, dtype=np.int64)
        for k in range(n_cells):
            if label[k] >= 0:
                total[label[k]] += n_seen[k]
                moving[label[k]] += n_brief[k]
        for k in range(n_cells):
            c = label[k]
            if c >= 0 and moving[c] >= min_voxels and moving[c] >= share * total[c]:
                moves[k] = True
        for k in range(n_cells):
            wanted[k] = not moves[k] and 2 * n_brief[k] >= n_seen[k]
    out = np.empty(m, dtype=np.bool_)
    for i in range(m):
        out[i] = moves[cell_of[i]]
    return out
