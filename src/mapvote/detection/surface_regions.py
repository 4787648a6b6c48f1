"""What a drive's evidence says together: the rules of surfaces that look beyond a voxel, and beyond a cell.

Support makes a change, and not area: a pole is narrow and tall, a speck is neither. What few rays decided goes along
with what it touches. What stands is met at least as often as rays go by where it is. And what is new is not the rest
of what stands beside it, unless something there went.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from mapvote.core.types import F64, I32, U8, U64, Bool, CellState
from mapvote.detection.spreading import flooded, steps_to

SUPPORT = 6
"""Voxels that a change must be decided by, over its 8-connected cells: a pole of 1.8 m, or half a square metre.
docs/decisions/evidence.md has what other numbers do, of this and of those below."""
APART_SHARE = 0.25
"""Of the voxels of what is new, those that must touch nothing that stands."""
MOVED_CELLS = 3
"""How far behind what went its new side may lie: .9 m."""
_AROUND = np.ones((3, 3))
_LOW = np.uint64(0b1111)
"""A column that has one of these voxels begins within 1.2 m of the ground."""


def supported(cells: Bool, voxels: U64) -> Bool:
    """(rows, cols) those of ``cells`` whose 8-connected group has SUPPORT set bits in ``voxels`` (rows, cols)."""
    return np.asarray(cells & (_over_groups(cells, np.bitwise_count(voxels)) >= SUPPORT))


def on_its_own(cells: Bool, voxels: U64, whole: U64, others: Bool) -> Bool:
    """(rows, cols) those of ``cells`` whose 8-connected group is a thing of its own that stands on the ground, however
    small: a bollard. It touches none of the ``others``, each of its columns begins near the ground, half of its voxels
    ``whole`` are in ``voxels`` (all planes (rows, cols)), and two of these lie on top of each other."""
    size = _over_groups(cells, np.bitwise_count(voxels))
    tall = _over_groups(cells, voxels & (voxels >> np.uint64(1)) != 0) > 0
    tied = ndimage.binary_dilation(others, _AROUND) | (whole & _LOW == 0)
    alone = (_over_groups(cells, tied) == 0) & (2 * size >= _over_groups(cells, np.bitwise_count(whole)))
    return np.asarray(cells & tall & alone)


def stands_apart(cells: Bool, new: U64, near: U64, states: U8) -> Bool:
    """(rows, cols) those of ``cells`` whose 8-connected group stands apart from what stands: APART_SHARE of its voxels
    ``new`` are not ``near`` such (all planes (rows, cols)); else it is the rest of that, seen from where no survey
    drove. What lies by something that went, by ``states``, need not: that is its new side."""
    size, far = (_over_groups(cells, np.bitwise_count(words)) for words in (new, new & ~near))
    went = _over_groups(cells, _near_gone(states)) > 0
    return np.asarray(cells & (went | (far >= APART_SHARE * size)))


def new_sides(states: U8, beyond: U64) -> Bool:
    """(rows, cols) cells with voxels met ``beyond`` what the map knew, near what went by ``states`` (planes alike): the
    new side of what was set back."""
    return np.asarray((beyond != 0) & _near_gone(states))


def _near_gone(states: U8) -> Bool:
    return np.asarray(steps_to(states == CellState.CHANGED_EMPTY) <= MOVED_CELLS)


def lasting(cells: Bool, balance: I32) -> Bool:
    """(rows, cols) those of ``cells`` whose 8-connected group was met in as many scans as passed it, or more: by cell
    the ``balance`` is of the voxels in question, what they were met less what they were passed. What drove there was
    met once or twice, and passed many times before and after."""
    return np.asarray(cells & (_over_groups(cells, balance) >= 0))


def _over_groups(cells: Bool, amounts: U8 | I32 | Bool) -> F64:
    """(rows, cols) the sum of ``amounts`` (rows, cols) over the 8-connected group of ``cells`` that a cell is in."""
    group, count = ndimage.label(cells, structure=_AROUND)
    return np.asarray(np.bincount(group.ravel(), weights=amounts.ravel(), minlength=count + 1)[group])


def grown(strong: Bool, weak: Bool) -> Bool:
    """(rows, cols) ``strong`` cells, and ``weak`` ones that touch them (8) directly or through each other: hysteresis
    (Canny 1986). Few rays cross the far wall of what fell, and none of them met it."""
    return np.asarray(flooded(strong, strong | weak, strong.size))
