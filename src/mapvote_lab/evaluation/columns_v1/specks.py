"""Groups of cells that are too small to be a thing."""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.types import Bool
from mapvote_lab.evaluation.columns_v1.spreading import flood_on


@numba.njit(cache=True, nogil=True)
def small_groups(cells: Bool, least: int) -> Bool:
    """(rows, cols) the cells that belong to a group of fewer than ``least``."""
    reached, small, queue = np.zeros_like(cells), np.zeros_like(cells), np.empty(cells.size, np.int64)
    cols, one = cells.shape[1], np.int64(1)
    for r in range(cells.shape[0]):
        for c in range(cols):
            if cells[r, c] and not reached[r, c]:
                reached[r, c], queue[0] = True, r * cols + c
                n = flood_on(reached, cells, queue, one, cells.size)
                for k in range(n if n < least else 0):
                    small[queue[k] // cols, queue[k] % cols] = True
    return small
