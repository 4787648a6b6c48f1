"""Kernels of the moving-object filter: the voxels of a scan, and cells that move together (moving_objects.py)."""

from __future__ import annotations

import numpy as np

from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import F64, I32, I64, Bool
from mapvote.core.voxels import grouped, voxel_key


@kernel
def _choose(points: F64, obstacle: Bool, origin: F64, reach: float, cell: float, chosen: I32, keys: I64) -> int:
    """How many points (n, 3) are obstacles within ``reach``: which, and the keys of their voxels, into the first of
    ``chosen`` (n,) and ``keys`` (n,)."""
    count = np.uint64(0)
    for i in range(np.uint64(0), np.uint64(len(points))):  # what is not chosen is written over: no branch to predict
        x, y = points[i, 0] - origin[0], points[i, 1] - origin[1]
        chosen[count] = i
        count += np.uint64(1) if obstacle[i] & (x * x + y * y <= reach * reach) else np.uint64(0)
    for k in range(count):
        p = np.uint64(chosen[k])
        keys[k] = voxel_key(points[p, 0], points[p, 1], points[p, 2], cell)
    return int(count)


def voxels(points: F64, obstacle: Bool, origin: F64, reach: float, cell: float) -> tuple[I32, F64]:
    """(voxel_of (n,), first point of each voxel (m, 3)), voxels in order of their first points; -1 for no voxel."""
    chosen, keys = np.empty(len(points), np.int32), np.empty(len(points), np.int64)
    count = _choose(points, obstacle, origin, reach, cell, chosen, keys)
    of, first = grouped(keys[:count])  # scans of 66,000 points have 7,000 voxels
    voxel_of = np.full(len(points), -1, dtype=np.int32)
    voxel_of[chosen[:count]] = of
    return voxel_of, points.take(chosen[first], axis=0)


@inlined
def _flood(cells: I64, n: int, wanted: I64, side: int, plane: I32, label: I64, stack: I64) -> None:
    """Label of each of n cells by 8-connected component of the wanted ones, from 0; -1 for the unwanted.

    ``cells`` (n,) are distinct indices row * side + col with 0 < row, col < side - 1; ``plane`` (side * side,) the
    place of each cell in them, -1 elsewhere. ``stack`` (n,): scratch.
    """
    for k in range(n):
        label[k] = -1
    count = 0
    for seed in range(n):
        if wanted[seed] == 0 or label[seed] >= 0:
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
                    if k >= 0 and wanted[k] != 0 and label[k] < 0:
                        label[k] = count
                        stack[top] = k
                        top += 1
        count += 1


@kernel
def _components(
    place: I64, side: int, seen: Bool, brief: Bool, min_voxels: int, share_whole: float, share_part: float, plane: I32,
    work: I64, out: Bool,
) -> None:  # fmt: skip
    """Into ``out`` (m,) which voxels move, see :func:`moving_components`; ``work`` (9, m): scratch, ``plane``
    (side * side,): scratch that holds -1."""
    cells, cell_of, n_seen, n_brief, total = work[0], work[1], work[2], work[3], work[4]
    moving, label, stack, wanted = work[5], work[6], work[7], work[8]
    n = 0
    for i in range(len(place)):
        at = place[i]
        if plane[at] < 0:
            plane[at] = n
            cells[n], n_seen[n], n_brief[n], wanted[n] = at, 0, 0, 1
            n += 1
        k = plane[at]
        cell_of[i] = k
        n_seen[k] += seen[i]
        n_brief[k] += brief[i]
        out[i] = False
    for pass_ in range(2):
        share = share_whole if pass_ == 0 else share_part
        _flood(cells, n, wanted, side, plane, label, stack)
        for k in range(n):
            total[k] = moving[k] = 0
        for k in range(n):
            if label[k] >= 0:
                total[label[k]] += n_seen[k]
                moving[label[k]] += n_brief[k]
        for k in range(n):  # 2: moves, and is flooded no more
            c = label[k]
            if c >= 0 and moving[c] >= min_voxels and moving[c] >= share * total[c]:
                stack[k] = 2
            else:
                stack[k] = 0
        for i in range(len(place)):
            out[i] |= stack[cell_of[i]] == 2
        for k in range(n):
            wanted[k] = 1 if stack[k] == 0 and 2 * n_brief[k] >= n_seen[k] else 0


def moving_components(
    place: I64, side: int, seen: Bool, brief: Bool, min_voxels: int, share_whole: float, share_part: float
) -> Bool:
    """Which voxels move (m,), from which were decidable (``seen``) and occupied only briefly (``brief``).

    ``place`` (m,): the cell of each, row * side + col with 0 < row, col < side - 1. Connected cells move together: a
    component of the plane moves as a whole if at least ``share_whole`` of its decidable voxels were brief, and
    ``min_voxels`` of them. Where a mover touches something static, the component splits at the cells that are mostly
    static, and each remaining part moves if at least ``share_part`` of it was brief.
    """
    out, plane = np.empty(len(place), dtype=np.bool_), np.full(side * side, -1, dtype=np.int32)
    work = np.empty((9, len(place)), dtype=np.int64)
    _components(place, side, seen, brief, min_voxels, share_whole, share_part, plane, work, out)
    return out
