"""What a drive's evidence says together: the rules of surfaces that look beyond a voxel, and beyond a cell.

Support makes a change, and not area: a pole is narrow and tall, a speck is neither. What few rays decided goes along
with what it touches. And what stands is met at least as often as rays go by where it is.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from mapvote.core.columns import dilated
from mapvote.core.types import I32, U64, Bool

SUPPORT = 6
"""Voxels that a change must be decided by, over its 8-connected cells: a pole of 1.8 m, or half a square metre.
docs/decisions/evidence.md has what other numbers do."""
EVERY_SIDE = np.ones((3, 3))


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


def detached(gone: U64, stands: U64, base: I32) -> U64:
    """(rows, cols) those of ``gone`` that touch (26) no voxel of ``stands``: a leaf or a ledge that one vehicle met
    others may see past."""
    return np.asarray(gone & ~dilated(stands, base, 1))
