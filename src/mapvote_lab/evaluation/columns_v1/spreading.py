"""Cells that lie together or near each other: how far they spread, how far away they lie.

The eight cells around a cell are beside it. Kernels of our own, for scipy's take longer to import than to work.
"""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.types import I32, I64, Bool

_NOWHERE = 1 << 30


@numba.njit(cache=True, nogil=True)
def flood_on(reached: Bool, within: Bool, queue: I64, n: int, steps: int) -> int:
    """Go from the first ``n`` flat cells in ``queue``, which are ``reached``, through the cells of ``within``, so many
    ``steps`` at most; returns how many are in the queue now."""
    rows, cols = within.shape
    done = 0
    while done < n and steps > 0:
        ring = n
        while done < ring:
            r, c = queue[done] // cols, queue[done] % cols
            done += 1
            for i in range(max(r - 1, 0), min(r + 2, rows)):
                for j in range(max(c - 1, 0), min(c + 2, cols)):
                    if within[i, j] and not reached[i, j]:
                        reached[i, j] = True
                        queue[n] = i * cols + j
                        n += 1
        steps -= 1
    return n


@numba.njit(cache=True, nogil=True)
def flooded(seeds: Bool, within: Bool, steps: int) -> Bool:
    """(rows, cols) the seeds, and the cells of ``within`` so many ``steps`` at most from one, through others."""
    reached, queue = seeds.copy(), np.empty(seeds.size, np.int64)
    n = np.int64(0)  # no literal, for which all that it is given to would be compiled once more
    for r in range(seeds.shape[0]):
        for c in range(seeds.shape[1]):
            if seeds[r, c]:
                queue[n] = r * seeds.shape[1] + c
                n += 1
    flood_on(reached, within, queue, n, steps)
    return reached


@numba.njit(cache=True, nogil=True)
def steps_to(cells: Bool) -> I32:
    """(rows, cols) how many steps it is to the nearest of ``cells``, over whatever lies between."""
    rows, cols = cells.shape
    out = np.empty((rows + 2, cols + 2), np.int32)  # with a border, so that nobody asks where the window ends
    out[:] = _NOWHERE
    for r in range(1, rows + 1):
        for c in range(1, cols + 1):
            if cells[r - 1, c - 1]:
                out[r, c] = 0
                continue
            before = min(min(out[r - 1, c - 1], out[r - 1, c]), min(out[r - 1, c + 1], out[r, c - 1]))
            out[r, c] = before + 1
    for r in range(rows, 0, -1):
        for c in range(cols, 0, -1):
            after = min(min(out[r + 1, c + 1], out[r + 1, c]), min(out[r + 1, c - 1], out[r, c + 1]))
            if after < out[r, c]:
                out[r, c] = after + 1
    return out[1:-1, 1:-1]
