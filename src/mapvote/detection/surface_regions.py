"""What a drive's evidence says together: the rules of surfaces that look beyond a voxel, and beyond a cell.

Support makes a change, and not area: a pole is narrow and tall, a speck is neither. What few rays decided goes along
with what it touches. And what stands is met at least as often as rays go by where it is.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from mapvote.core.types import F64, I32, U8, U64, Bool
from mapvote.detection.spreading import flooded

SUPPORT = 6
"""Voxels that a change must be decided by, over its 8-connected cells: a pole of 1.8 m, or half a square metre.
docs/decisions/evidence.md has what other numbers do."""


def supported(cells: Bool, voxels: U64) -> Bool:
    """(rows, cols) those of ``cells`` whose 8-connected group has SUPPORT set bits in ``voxels`` (rows, cols)."""
    return np.asarray(cells & (_over_groups(cells, np.bitwise_count(voxels)) >= SUPPORT))


def lasting(cells: Bool, balance: I32) -> Bool:
    """(rows, cols) those of ``cells`` whose 8-connected group was met in as many scans as passed it, or more: by cell
    the ``balance`` is of the voxels in question, what they were met less what they were passed. What drove there was
    met once or twice, and passed many times before and after."""
    return np.asarray(cells & (_over_groups(cells, balance) >= 0))


def _over_groups(cells: Bool, amounts: U8 | I32) -> F64:
    """(rows, cols) the sum of ``amounts`` (rows, cols) over the 8-connected group of ``cells`` that a cell is in."""
    group, count = ndimage.label(cells, structure=np.ones((3, 3)))
    return np.asarray(np.bincount(group.ravel(), weights=amounts.ravel(), minlength=count + 1)[group])


def grown(strong: Bool, weak: Bool) -> Bool:
    """(rows, cols) ``strong`` cells, and ``weak`` ones that touch them (8) directly or through each other: hysteresis
    (Canny 1986). Few rays cross the far wall of what fell, and none of them met it."""
    return np.asarray(flooded(strong, strong | weak, strong.size))
