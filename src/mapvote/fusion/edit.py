"""Delete and add points of one tile (paper IV). Everything else stays bit-identical."""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.columns import EVERY_BIT, GROUND_MARGIN_M, column_bit, height_above
from mapvote.core.grid import CELL_SIZE, CELLS
from mapvote.core.tile import Tile
from mapvote.core.types import F32, I32, I64, U8, U64, Bool


def delete_points(tile: Tile, gone: U64) -> tuple[Tile, int]:
    """The tile without the obstacle points whose voxel is marked in ``gone`` (256, 256), and how many went.

    Ground points are never deleted. In a tile whose ground nobody knows, words have no agreed beginning, so any mark
    takes the whole column.
    """
    if not tile.has_ground:
        gone = np.where(gone == 0, gone, EVERY_BIT)
    ground, base = tile.ground_z.reshape(-1), tile.base.reshape(-1)
    dropped = _marked(tile.points, tile.cells, gone.reshape(-1), ground, base)
    deleted = int(np.count_nonzero(dropped))
    return (tile.without(dropped), deleted) if deleted else (tile, 0)


@numba.njit(cache=True, nogil=True)
def _marked(points: F32, cells: I64, gone: U64, ground_z: F32, base: I32) -> Bool:
    """(n,) which points (n, 3) are obstacles in voxels that ``gone`` (cells,) marks."""
    found = np.zeros(len(cells), dtype=np.bool_)
    for i in range(len(cells)):
        cell = cells[i]
        if gone[cell]:
            z = np.float64(points[i, 2])
            marked = (gone[cell] >> np.uint64(column_bit(z, base[cell]))) & np.uint64(1)
            found[i] = marked and height_above(z, ground_z[cell], base[cell]) >= GROUND_MARGIN_M
    return found


def add_points(tile: Tile, points: F32, intensity: U8, cells: I64, voters: I32, min_votes: int) -> tuple[Tile, int]:
    """The tile with one representative per voxel that at least ``min_votes`` voters support, and how many came.

    ``points`` (m, 3) from the tile's corner, ``intensity`` (m,) 255 for 1.0, ``cells`` (m,) flat, ``voters`` (m,) small
    integers. A voter supports a voxel with a point in it or in the voxel above or below. Voxels that already hold a
    point of the map stay as they are. New points follow the old ones, ordered by cell and height.
    """
    if not len(points):
        return tile, 0
    voxels = _voxels(cells, points)
    order = np.argsort(voxels)
    taken = _taken(tile.points, tile.cells, voxels, order)
    chosen = _representatives(points, intensity, voxels, voters, taken, order, min_votes)
    if not len(chosen):
        return tile, 0
    return tile.with_new(points[chosen], intensity[chosen]), len(chosen)


@numba.njit(cache=True, nogil=True)
def _voxels(cells: I64, points: F32) -> I64:
    """(n,) a number for the voxel of each point, ascending by cell, then layer; neighbours above each other differ by
    one."""
    voxels = np.empty(len(cells), dtype=np.int64)
    for i in range(len(cells)):
        voxels[i] = cells[i] * (1 << 24) + int(np.floor(np.float64(points[i, 2]) / CELL_SIZE)) + (1 << 23)
    return voxels


@numba.njit(cache=True, nogil=True)
def _taken(points: F32, cells: I64, voxels: I64, order: I64) -> Bool:
    """(n,) which of the ``voxels``, that ``order`` sorts, hold one of the ``points`` (m, 3) in ``cells`` (m,)."""
    first = np.full(CELLS, len(order), dtype=np.int32)
    for k in range(len(order) - 1, -1, -1):
        first[voxels[order[k]] >> 24] = k
    taken = np.zeros(len(voxels), dtype=np.bool_)
    for i in range(len(cells)):
        k = first[cells[i]]
        if k < len(order):
            voxel = cells[i] * (1 << 24) + int(np.floor(np.float64(points[i, 2]) / CELL_SIZE)) + (1 << 23)
            while k < len(order) and voxels[order[k]] <= voxel:
                taken[order[k]] |= voxels[order[k]] == voxel
                k += 1
    return taken


@numba.njit(cache=True, nogil=True)
def _representatives(
    points: F32, intensity: U8, voxels: I64, voters: I32, taken: Bool, order: I64, min_votes: int
) -> I64:
    """Indices of one point per supported voxel, ascending by voxel: the one nearest to the mean of all offered there,
    of several the first by x, y, z, intensity.

    ``order`` sorts ``voxels``; within a voxel any order gives the same: the mean is a sum of whole micrometres.
    """
    n = len(voxels)
    out = np.empty(n, dtype=np.int64)
    found, last_voter = 0, -1
    for i in range(n):
        last_voter = max(last_voter, voters[i])
    seen = np.full(last_voter + 1, -1, dtype=np.int64)
    low, start = 0, 0
    while start < n:
        voxel = voxels[order[start]]
        stop = start + 1
        while stop < n and voxels[order[stop]] == voxel:
            stop += 1
        while voxels[order[low]] < voxel - 1:
            low += 1
        support = 0
        i = low
        while i < n and voxels[order[i]] <= voxel + 1:
            if seen[voters[order[i]]] != start:
                seen[voters[order[i]]] = start
                support += 1
            i += 1
        if support >= min_votes and not taken[order[start]]:
            out[found] = _nearest_to_mean(points, intensity, order[start:stop])
            found += 1
        start = stop
    return out[:found]


@numba.njit(cache=True, nogil=True)
def _nearest_to_mean(points: F32, intensity: U8, some: I64) -> int:
    mean = np.zeros(3)
    for k in range(3):
        total = 0
        for i in some:
            total += int(np.rint(np.float64(points[i, k]) * 1e6))
        mean[k] = total / (1e6 * len(some))
    best, nearest = some[0], np.inf
    for i in some:
        distance = 0.0
        for k in range(3):
            distance += (np.float64(points[i, k]) - mean[k]) ** 2
        if distance < nearest or (distance == nearest and _before(points, intensity, i, best)):
            best, nearest = i, distance
    return best


@numba.njit(cache=True, nogil=True)
def _before(points: F32, intensity: U8, one: int, other: int) -> bool:
    for k in range(3):
        if points[one, k] != points[other, k]:
            return points[one, k] < points[other, k]
    return intensity[one] < intensity[other]
