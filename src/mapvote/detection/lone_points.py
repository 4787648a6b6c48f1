"""Points of a map that touch no other: mixed pixels, and rooms that a pane mirrored.

Inside a house that was pulled down the map holds points on nothing, met once through a window or past an edge. Rays
cross them now, rightly, and no surface of the world has gone. A real surface is met in voxels that touch each other,
but for where it was hardly seen at all; so a lone point follows what goes around it, and is no change of its own.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy import ndimage

from mapvote.core.columns import shifted
from mapvote.core.types import I32, U8, U64, Bool, CellState

FIRM_BESIDE = 3
"""Of the eight cells around one that holds lone points only, how many must go for it to go (docs/decisions/
evidence.md has what other numbers do)."""
_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])


@numba.njit(cache=True, nogil=True)
def lone_cells(occupied: U64, base: I32) -> Bool:
    """(rows, cols) cells of the words ``occupied`` in which no set voxel touches (26) another one, of any cell."""
    out = np.zeros(occupied.shape, dtype=np.bool_)
    for r in range(occupied.shape[0]):
        for c in range(occupied.shape[1]):
            word, others = occupied[r, c], np.uint64(0)
            if not word or word & (word << np.uint64(1)):
                continue
            for i in range(max(r - 1, 0), min(r + 2, occupied.shape[0])):
                for j in range(max(c - 1, 0), min(c + 2, occupied.shape[1])):
                    if (i != r or j != c) and occupied[i, j]:
                        others |= shifted(occupied[i, j], base[i, j] - base[r, c])
            others |= others << np.uint64(1) | others >> np.uint64(1)
            out[r, c] = not word & others
    return out


def no_change(states: U8, lone: Bool) -> Bool:
    """(rows, cols) those of the ``lone`` cells decided changed-empty around which fewer than FIRM_BESIDE cells are."""
    gone = states == CellState.CHANGED_EMPTY
    beside = ndimage.convolve(gone.astype(np.int32), _AROUND, mode="constant")
    return np.asarray(gone & lone & (beside < FIRM_BESIDE))
