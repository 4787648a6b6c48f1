"""Groups of cells of a plane that lie near each other. scipy.ndimage does the same, but its import takes longer than a
drive's groups, and 30 MB."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from mapvote.core.kernel import kernel
from mapvote.core.types import I32, I64, U32, U64, Bool, read_only

Plane = TypeVar("Plane", Bool, U32)


def groups_of(words: U64, reach: int, rows: I64, cols: I64) -> I32:
    """(rows, cols) int32: the number, from 1 on, of each group of ``words`` (rows, cols) that one of the cells (n,) is
    in, in their order; 0 elsewhere. Cells with a word are of one group if they are at most ``reach`` rows and columns
    apart; with a reach of 1 groups are 8-connected."""
    labels = np.zeros(words.shape, np.int32)
    stack = np.empty(np.count_nonzero(words), np.int64)
    seeds = read_only(np.ascontiguousarray(rows)), read_only(np.ascontiguousarray(cols))
    _label_near(*seeds, read_only(np.ascontiguousarray(words)), reach, labels, stack)
    return labels


@kernel
def _label_near(rows: I64, cols: I64, words: U64, reach: int, labels: I32, stack: I64) -> None:
    """:func:`groups_of` into ``labels``, zeros. ``stack`` (as many as there are words): memory."""
    height, width = words.shape
    count = 0
    for k in range(len(rows)):
        if labels[rows[k], cols[k]]:
            continue
        count += 1
        labels[rows[k], cols[k]] = count
        stack[0] = rows[k] * width + cols[k]
        n = 1
        while n > 0:
            n -= 1
            r = stack[n] // width
            c = stack[n] % width
            for a in range(max(r - reach, 0), min(r + reach + 1, height)):
                for b in range(max(c - reach, 0), min(c + reach + 1, width)):
                    if words[a, b] and not labels[a, b]:
                        labels[a, b] = count
                        stack[n] = a * width + b
                        n += 1


def widened(cells: Plane, reach: int) -> Plane:
    """(rows, cols) the cells at most ``reach`` rows and columns away from one of ``cells`` (rows, cols); of words, the
    bits of those cells."""
    out = cells.copy()
    for _ in range(reach):
        along = out.copy()
        along[1:] |= out[:-1]
        along[:-1] |= out[1:]
        out = along.copy()
        out[:, 1:] |= along[:, :-1]
        out[:, :-1] |= along[:, 1:]
    return out
