"""What there is to see in each cell that a vehicle calls changed, of how sure it can be of that: how much of the thing
is in the cell.

How large the thing is, how many of the cells around changed likewise, how much of it the cell holds against those, and
of what is gone how high it rose. How often rays crossed what is gone, or which rule decided it, tells nothing beyond
(docs/measurements/probability.md).
"""

from __future__ import annotations

from collections.abc import Mapping

import numba
import numpy as np
from scipy import ndimage

from mapvote.codec.odds import changed_cells_of
from mapvote.core.grid import TILE_CELLS, Lattice, TileIndex
from mapvote.core.types import F32, F64, I32, I64, NO_VOTE, U8, U64, Bool, CellState
from mapvote.detection.counters import count_of
from mapvote.detection.regions import HALO, around
from mapvote.detection.surface_counts import MET

LOOKS = 4
MOST_CELLS = 200
"""A thing of more is as large as any: farther than HALO cells beyond its tile nobody looks."""
MOST_HEIGHT_M = 6.0
_BESIDE = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]


@numba.njit(cache=True, nogil=True)
def amounts(planes: U64, occupied: U64, new: U64) -> I32:
    """(rows, cols) how much of a thing is in each cell: the voxels that the map holds, else how often those of ``new``
    were met, from counters (rows, cols, WORDS)."""
    out = np.zeros(occupied.shape, dtype=np.int32)
    for r in range(occupied.shape[0]):
        for c in range(occupied.shape[1]):
            for bit in range(64 if occupied[r, c] | new[r, c] else 0):
                one = np.uint64(1) << np.uint64(bit)
                if occupied[r, c]:
                    out[r, c] += 1 if occupied[r, c] & one else 0
                elif new[r, c] & one:
                    out[r, c] += count_of(planes[r, c], MET, bit)
    return out


def looks(
    lattice: Lattice, tile: TileIndex, states: Mapping[TileIndex, U8], amount: Mapping[TileIndex, I32], height_m: F32
) -> F64:
    """(m, LOOKS) of the cells of ``tile`` that its ``states`` call changed, ascending.

    Of each: ln of 1 + the cells of the 8-connected thing it belongs to; which share of the eight cells around is alike;
    ln of how much of the thing it holds (``amount``, see :func:`amounts`) against the fullest of those; how high the
    map rises in it (``height_m`` (256, 256)), of what is gone. Cells of other tiles count.
    """
    inner = lattice.tile(tile)
    out = np.zeros((len(changed_cells_of(states[tile])), LOOKS))
    if not len(out):
        return out
    wide = inner.padded(HALO)
    said, full = around(lattice, states, wide, NO_VOTE), around(lattice, amount, wide, 0)
    cells = changed_cells_of(said[inner.slices_in(wide)])
    rows, cols = cells // TILE_CELLS, cells % TILE_CELLS
    for state in (CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY):
        mine = states[tile].reshape(-1)[cells] == state
        alike = said == state
        sizes, around_it, share = _of_things(alike, full, rows[mine] + HALO, cols[mine] + HALO)
        height = np.minimum(np.nan_to_num(height_m[rows[mine], cols[mine]]), MOST_HEIGHT_M)
        rises = height if state == CellState.CHANGED_EMPTY else np.zeros(len(height))
        out[mine] = np.column_stack([np.log1p(np.minimum(sizes, MOST_CELLS)), around_it / len(_BESIDE), share, rises])
    return out


def _of_things(alike: Bool, amount: I32, rows: I64, cols: I64) -> tuple[I64, I64, F64]:
    """Of the cells (n,): how many their 8-connected group of ``alike`` has, how many of the eight around are among
    them, and ln of their amount against the largest of those."""
    group, _ = ndimage.label(alike, structure=np.ones((3, 3)))
    sizes = np.bincount(group.ravel())[group[rows, cols]]
    mine = np.where(alike, amount, 0)
    beside = np.stack([alike[rows + i, cols + j] for i, j in _BESIDE])
    most = np.max([mine[rows + i, cols + j] for i, j in _BESIDE], axis=0)
    return sizes, beside.sum(axis=0), np.log1p(mine[rows, cols]) - np.log1p(most)
