"""Kernels of the moving-object filter: the voxels of a scan, and cells that move together (moving_objects.py)."""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.types import F64, I32, I64, Bool
from mapvote.core.voxels import slot_of, voxel_key
from mapvote.perception.range_image import BOTH_SIDES, Counts

_SLOTS = np.int64(1 << 14)
"""Of the hash table that is tried first: scans of 66,000 points have 7,000 voxels, and this much the caches hold."""


@numba.njit(cache=True, nogil=True)
def voxels(points: F64, obstacle: Bool, origin: F64, reach: float, cell: float) -> tuple[I32, F64]:
    """(voxel_of (n,), first point of each voxel (m, 3)), voxels in order of their first points; -1 for no voxel."""
    n, count = np.uint64(len(points)), np.uint64(0)
    chosen, keys = np.empty(n, np.int32), np.empty(n, np.int64)
    for i in range(n):  # what is not chosen is written over, so that nothing hangs on a guess
        x, y = points[i, 0] - origin[0], points[i, 1] - origin[1]
        chosen[count] = i
        count += np.uint64(1) if obstacle[i] & (x * x + y * y <= reach * reach) else np.uint64(0)
    for k in range(count):
        p = np.uint64(chosen[k])
        keys[k] = voxel_key(points[p, 0], points[p, 1], points[p, 2], cell)
    voxel_of, first = np.full(n, -1, dtype=np.int32), np.empty(count, dtype=np.int64)
    slots, found = _SLOTS, -1
    while found < 0:
        found = _number(keys[:count], chosen, slots, voxel_of, first)
        slots *= 4
    samples = np.empty((found, 3))
    for v in range(found):
        for axis in range(3):
            samples[v, axis] = points[first[v], axis]
    return voxel_of, samples


@numba.njit(cache=True, nogil=True)
def _number(keys: I64, chosen: I32, slots: int, voxel_of: I32, first: I64) -> int:
    """Number the voxels ``keys`` of the points ``chosen``, see :func:`voxels`. Returns how many there are, -1 if more
    than half of the ``slots`` would be taken."""
    table, rows, m = np.zeros(slots, np.int64), np.empty(slots, np.int32), 0
    for k in range(np.uint64(len(keys))):
        slot = slot_of(keys[k], table)
        if table[slot] == 0:
            if 2 * m >= slots:
                return -1
            table[slot], rows[slot], first[m] = keys[k], m, chosen[k]
            m += 1
        voxel_of[np.uint64(chosen[k])] = rows[slot]
    return m


@numba.njit(cache=True, nogil=True)
def cells_in_plane(samples: F64, lowest: I64, cell: float) -> tuple[I64, I64]:
    """(rows (m,), cols (m,)) of places (m, 3) in a plane that begins at cell ``lowest`` (x, y) of the world."""
    m = np.uint64(len(samples))
    rows, cols = np.empty(m, np.int64), np.empty(m, np.int64)
    for i in range(m):
        rows[i] = np.int64(np.floor(samples[i, 1] / cell)) - lowest[1]
        cols[i] = np.int64(np.floor(samples[i, 0] / cell)) - lowest[0]
    return rows, cols


@numba.njit(cache=True, nogil=True)
def decidable(counts: Counts, min_free: int, free_share: float) -> tuple[Bool, Bool]:
    """(seen (m,), brief (m,)): which voxels ``min_free`` scans could see, and which of them were occupied briefly."""
    m = np.uint64(len(counts.free))
    seen, brief = np.empty(m, np.bool_), np.empty(m, np.bool_)
    for i in range(m):
        free, total = counts.free[i], counts.free[i] + counts.hit[i]
        seen[i] = total >= min_free
        brief[i] = (counts.sides[i] == BOTH_SIDES) & (free >= min_free) & (free >= free_share * total)
    return seen, brief


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
    voxel_of: I32,
) -> Bool:
    """Which points move (n,), from which voxels (m,) were decidable (``seen``) and occupied only briefly (``brief``).

    Connected cells move together: a component of the plane moves as a whole if at least ``share_whole`` of its
    decidable voxels were brief. Where a mover touches something static, the component splits at the cells that are
    mostly static, and each remaining part moves if at least ``share_part`` of it was brief. ``voxel_of`` (n,): the
    voxel of each point, -1 for none.
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
    out = np.empty(len(voxel_of), dtype=np.bool_)
    for i in range(len(voxel_of)):
        out[i] = voxel_of[i] >= 0 and moves[cell_of[voxel_of[i]]]
    return out
