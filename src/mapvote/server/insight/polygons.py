"""Sets of lattice cells: which hang together, and the polygons they cover. Knows nothing of tiles, so none can show."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import scipy

from mapvote.core.types import I32, I64

Ring = I64
"""(n, 2) corners (col, row) of the lattice, closed: the first corner is repeated at the end."""
_RIGHT, _ABOVE = (0, 1), (1, 0)
_DIAGONALS = (1, -1), (1, 1)
_SHIFT = np.int64(32)
_STEP = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)], dtype=np.int64)
"""(col, row) step of each edge direction: counter-clockwise round a cell, which lies to the left."""


@dataclass(frozen=True, slots=True)
class Pieces:
    """Labels (n,) of n cells; numbers follow the cells' order, by row and then by column, of their first cell."""

    objects: I32
    """8-connected: what counts as one change."""
    polygons: I32
    """4-connected: what one polygon can cover, as two squares that meet at a corner are two polygons."""


def pieces(rows: I64, cols: I64, kinds: I64) -> Pieces:
    """Connected cells of the same kind; cells (n,) on the lattice, sorted by row, then column, each once."""
    key = _key(rows, cols)
    straight = [_pairs(key, kinds, rows + dr, cols + dc) for dr, dc in (_RIGHT, _ABOVE)]
    diagonal = [_pairs(key, kinds, rows + dr, cols + dc) for dr, dc in _DIAGONALS]
    return Pieces(_labels(straight + diagonal, len(rows)), _labels(straight, len(rows)))


def rings(rows: I64, cols: I64, polygons: I32) -> list[list[Ring]]:
    """The outline of every 4-connected piece: first its outer ring, counter-clockwise, then its holes, clockwise.

    ``polygons`` (n,) are the labels of the cells, 0 ... k - 1. Rings are simple, turn at every corner and begin at
    their lowest, then leftmost corner: valid by RFC 7946 and OGC Simple Features, equal for equal cells.
    """
    if not len(rows):
        return []
    cell = _key(rows, cols)
    start, direction, label = [], [], []
    corners = ((0, 0), (1, 0), (1, 1), (0, 1))
    beyond = ((-1, 0), (0, 1), (1, 0), (0, -1))
    for d in range(4):
        other = _find(cell, _key(rows + beyond[d][0], cols + beyond[d][1]))
        open_side = (other < 0) | (polygons[other] != polygons)
        start.append(np.stack([cols + corners[d][0], rows + corners[d][1]], axis=1)[open_side])
        direction.append(np.full(int(open_side.sum()), d, dtype=np.int64))
        label.append(polygons[open_side].astype(np.int64))
    corner, way, owner = np.concatenate(start), np.concatenate(direction), np.concatenate(label)
    order = np.lexsort((way, corner[:, 0], corner[:, 1], owner))
    corner, way, owner = corner[order], way[order], owner[order]
    follow = _successors(corner, way, owner)
    out: list[list[Ring]] = [[] for _ in range(int(owner[-1]) + 1)]
    turns, ends = _walk(way, follow)
    for edges in np.split(turns, ends[:-1]):
        out[int(owner[edges[0]])].append(np.concatenate([corner[edges], corner[edges[:1]]]))
    return out


def _key(rows: I64, cols: I64) -> I64:
    """One sortable number per cell: by row, then by column; indices within +-2^30."""
    key: I64 = (rows << _SHIFT) + cols
    return key


def _find(sorted_keys: I64, wanted: I64) -> I64:
    """Index of each wanted key in ``sorted_keys``, -1 where it is missing."""
    at = np.minimum(np.searchsorted(sorted_keys, wanted), len(sorted_keys) - 1)
    return np.where(sorted_keys[at] == wanted, at, -1)


def _pairs(key: I64, kinds: I64, rows: I64, cols: I64) -> tuple[I64, I64]:
    """(i, j) of cells i whose neighbour at (rows, cols) is cell j of the same kind."""
    other = _find(key, _key(rows, cols))
    joined = np.flatnonzero((other >= 0) & (kinds[other] == kinds))
    return joined, other[joined]


def _labels(pairs: list[tuple[I64, I64]], n: int) -> I32:
    i = np.concatenate([a for a, _ in pairs])
    j = np.concatenate([b for _, b in pairs])
    graph = scipy.sparse.coo_array((np.ones(len(i), dtype=np.int8), (i, j)), shape=(n, n))
    _, found = scipy.sparse.csgraph.connected_components(graph, directed=False)
    _, first, label = np.unique(found, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    return rank[label]


def _successors(corner: I64, way: I64, owner: I64) -> I64:
    """The edge that follows each edge of its polygon.

    Where two edges of one polygon leave a corner, the right turn keeps to the same cell outside, so that a ring
    never touches itself: what it encloses becomes a hole of its own.
    """
    n = len(way)
    stop = corner + _STEP[way]
    _, vertex = np.unique(
        np.concatenate([_key(corner[:, 1], corner[:, 0]), _key(stop[:, 1], stop[:, 0])]), return_inverse=True
    )
    place = owner * (2 * n) + vertex[:n]
    next_place = owner * (2 * n) + vertex[n:]
    name = place * 4 + way
    by_name = np.argsort(name)
    follow = np.full(n, -1, dtype=np.int64)
    for turn in (1, 0, -1):  # the last that fits is kept: right before straight before left
        found = _find(name[by_name], next_place * 4 + (way + turn) % 4)
        follow = np.where(found >= 0, by_name[found], follow)
    return follow


@numba.njit(cache=True, nogil=True)
def _walk(way: I64, follow: I64) -> tuple[I64, I64]:
    """(edges that begin at a turn, ring after ring; the end of each ring in that list)."""
    n = len(way)
    done = np.zeros(n, dtype=np.bool_)
    edges = np.empty(n, dtype=np.int64)
    ends = np.empty(n, dtype=np.int64)
    found, count = 0, 0
    for first in range(n):
        if done[first]:
            continue
        edge = first
        before = -1
        while not done[edge]:
            done[edge] = True
            if way[edge] != before:
                edges[found] = edge
                found += 1
            before = way[edge]
            edge = follow[edge]
        ends[count] = found
        count += 1
    return edges[:found], ends[:count]
