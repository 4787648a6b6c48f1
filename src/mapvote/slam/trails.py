"""Trails of what drove through the survey, too far off for anything but a few rays to speak against them.

What stands is met as often as rays go by, as a whole if not in every voxel: at its edges rays pass more often than they
meet it. What drove was met once or twice in each place, and passed before and after. Vehicles that come later would
find the trail gone, one after the other; a map should not have it in the first place.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mapvote.core.grid import Lattice
from mapvote.core.types import F64, I64, Bool

TALL_M = 4.0
"""No lorry is taller (Directive 96/53/EC)."""


def trails(points: F64, balance: I64, height_m: F64, lattice: Lattice) -> Bool:
    """(n,) which of the points (n, 3), one a voxel, above the ground, are trails.

    ``balance`` (n,): in how many scans each point's voxel was met, less in how many rays passed it and met nothing;
    ``height_m`` (n,) over the ground, NaN where nobody knows that. What belongs to an 8-connected group of cells that
    was passed more often than met is a trail, but for cells that rise to TALL_M: those did not drive.
    """
    if not len(points):
        return np.zeros(0, dtype=np.bool_)
    cells, at = _cells(points, lattice)
    top = np.full(len(cells), -np.inf)
    np.maximum.at(top, at, np.nan_to_num(height_m, nan=np.inf))
    of_cell = np.bincount(at, weights=balance, minlength=len(cells))
    group, count = _groups(cells)
    passed = np.bincount(group, weights=of_cell, minlength=count)[group] < 0
    return np.asarray((passed & (top < TALL_M))[at])


def _cells(points: F64, lattice: Lattice) -> tuple[I64, I64]:
    """((m, 2) row and column of every cell that one of the points (n, 3) is in, (n,) which of them each is in)."""
    rows, cols = lattice.cells_of(points)
    width = int(cols.max()) + 1 - int(cols.min())  # one number a cell: pairs are sorted 20 times as slowly
    flat, at = np.unique((rows - rows.min()) * width + cols - cols.min(), return_inverse=True)
    return np.column_stack([flat // width, flat % width]), at


def _groups(cells: I64) -> tuple[I64, int]:
    """((n,) the 8-connected group of each of n cells (n, 2), how many there are)."""
    beside = cKDTree(cells).query_pairs(1.5, output_type="ndarray") if len(cells) else np.zeros((0, 2), np.int64)
    graph = coo_matrix((np.ones(len(beside), np.bool_), tuple(beside.T)), shape=(len(cells), len(cells)))
    count, group = connected_components(graph, directed=False)
    return group.astype(np.int64), int(count)
