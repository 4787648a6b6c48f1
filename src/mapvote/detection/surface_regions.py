"""What a drive's evidence says together: the rules of surfaces that look beyond a voxel, and beyond a cell.

Support makes a change, and not area: a pole is narrow and tall, a speck is neither. What no ray decided goes along with
what it touches. And what stands is met at least as often as rays go by where it is.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy import ndimage

from mapvote.core.columns import neighbourhood
from mapvote.core.types import I32, I64, U64, Bool

SUPPORT = 6
"""Voxels that a change must be decided by, over its 8-connected cells: a pole of 1.8 m, or half a square metre.
docs/decisions/evidence.md has what other numbers do."""
EVERY_SIDE = np.ones((3, 3))
_BESIDE = np.int64(1)
"""One cell to all sides; no literal, for which :func:`neighbourhood` would be compiled once more."""


def supported(cells: Bool, voxels: U64) -> Bool:
    """(rows, cols) those of ``cells`` whose 8-connected group has SUPPORT set bits in ``voxels`` (rows, cols)."""
    group, count = ndimage.label(cells, structure=EVERY_SIDE)
    votes = np.bincount(group.ravel(), weights=np.bitwise_count(voxels).ravel(), minlength=count + 1)
    return np.asarray(cells & (votes >= SUPPORT)[group])


def lasting(cells: Bool, met: I32, passes: I32) -> Bool:
    """(rows, cols) those of ``cells`` whose 8-connected group was ``met`` in as many scans as a ray's ``passes``
    through it, or more, counted by cell over the voxels in question: what drove there was met once or twice, and
    passed many times before and after."""
    group, count = ndimage.label(cells, structure=EVERY_SIDE)
    less = np.bincount(group.ravel(), weights=(met - passes).ravel(), minlength=count + 1)
    return np.asarray(cells & (less >= 0)[group])


def grown(strong: Bool, weak: Bool) -> Bool:
    """(rows, cols) ``strong`` cells, and ``weak`` ones that touch them (8) directly or through each other: hysteresis
    (Canny 1986). Few rays cross the far wall of what fell, and none of them met it."""
    return np.asarray(ndimage.binary_propagation(strong, EVERY_SIDE, mask=strong | weak))


def settled(gone: U64, stands: U64, mapped: U64, base: I32) -> U64:
    """(rows, cols) ``gone``, and those ``mapped`` voxels that neither plane holds and that it reaches before ``stands``
    does, from voxel to touching voxel (26); where both come at once, they stand. So does what touches a voxel of
    ``stands``: a leaf or a ledge that one vehicle met others may see past."""
    return _settle(gone, stands, mapped, base, np.flatnonzero(mapped & ~gone & ~stands))


@numba.njit(cache=True, nogil=True)
def _settle(gone: U64, stands: U64, mapped: U64, base: I32, cells: I64) -> U64:
    """``cells`` (n,), flat: those with anything undecided. Round by round, so that their order says nothing."""
    fell, stood, wide = gone.copy(), stands.copy(), gone.shape[1]
    falls, stays = np.empty(len(cells), np.uint64), np.empty(len(cells), np.uint64)
    more = True
    while more:
        more = False
        for i in range(len(cells)):
            r, c = cells[i] // wide, cells[i] % wide
            left = mapped[r, c] & ~fell[r, c] & ~stood[r, c]
            stays[i] = left & neighbourhood(stood, base, r, c, _BESIDE) if left else left
            falls[i] = left & ~stays[i] & neighbourhood(fell, base, r, c, _BESIDE) if left else left
        for i in range(len(cells)):
            if stays[i] | falls[i]:
                stood[cells[i] // wide, cells[i] % wide] |= stays[i]
                fell[cells[i] // wide, cells[i] % wide] |= falls[i]
                more = True
    for r in range(fell.shape[0]):
        for c in range(fell.shape[1]):
            if fell[r, c]:
                fell[r, c] &= ~neighbourhood(stands, base, r, c, _BESIDE)
    return fell
