"""The rule of surfaces on one page: what a drive's counts say of every cell of a window of tiles (docs/method.md)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from mapvote.core.kernel import kernel
from mapvote.core.types import F32, F64, I32, NO_VOTE, U8, U64, Bool, CellState
from mapvote.detection.evidence import HIT, PASSED, PASSES, PLANES, count_of, times_crossed
from mapvote.detection.packed_tiles import Overlap

# With HIT_REACH_M nine numbers. docs/decisions/evidence.md says what each was set by.
HIT_RAYS = 16
"""Scans that crossed a mapped voxel, against one that hit it."""
GONE_RAYS = 3
"""Scans that must have crossed it beyond those: two may be an error of two poses."""
NEW_RAYS = 0.25
"""Of the scans in which a free voxel was hit, one against four that crossed it."""
SUPPORT = 6
"""Voxels by which something gone must be decided, in its 8-connected cells: a pole of 1.8 m, half a square metre."""
NEW_VOXELS, NEW_A_CELL, NEW_ENOUGH = 4, 2, 40
"""Voxels that something new of A cells must be decided by: 4 + 2 A, or 40. What is thinner is noise beside what stands.
The bound of 40 keeps large low things."""
MOVED_CELLS = 3
"""How far behind what went its new side may lie: .9 m."""
_AROUND = np.ones((3, 3))
_LOW = np.uint64(0b1111)
"""A column that has one of these voxels begins within 1.2 m of the ground."""
NOTHING = np.uint64(0)


class VoxelFacts(NamedTuple):
    """What the counts say of each voxel of a window: column words (rows, cols)."""

    gone: U64
    stands: U64
    unmet: U64
    """Mapped, crossed, but neither gone nor ever hit."""
    new: U64
    beyond: U64
    """As new, but the map did not know the voxel to be free."""
    passed: U64
    """What any ray passed."""
    balance: I32
    """Over a cell's new voxels: in how many scans they were hit, less in how many they were passed."""
    hits: I32
    """Over a cell's new voxels: in how many scans they were hit."""


class Mapped(NamedTuple):
    """What the map knows of the same window, (rows, cols)."""

    occupied: U64
    known_free: U64
    base: I32
    height_m: F32
    """How high its points rise over the ground; not finite where there are none."""


class WindowStates(NamedTuple):
    """What the drive says of each cell, and by which voxels: (rows, cols)."""

    states: U8
    gone: U64
    remnants: U64
    new: U64


def no_facts(shape: tuple[int, int]) -> VoxelFacts:
    """Of a window in which nothing was counted."""
    return VoxelFacts(*(np.zeros(shape, kind) for kind in [np.uint64] * 6 + [np.int32] * 2))


@kernel
def weigh_voxels(planes: U64, part: Overlap, occupied: U64, known_free: U64, out: VoxelFacts) -> None:
    """Fill the ``part`` of a window that lies on a tile from its counters (256, 256, WORDS): the first lines of
    :func:`judge_window`. ``out`` comes empty (:func:`no_facts`)."""
    for r in range(part.row, part.end_row):
        for c in range(part.col, part.end_col):
            cell, mapped = planes[r + part.down, c + part.right], occupied[r, c]
            out.passed[r, c] = cell[PASSED]
            asked = mapped
            for k in range(PLANES):
                asked |= cell[HIT + k]
            for bit in range(64 if asked else 0):
                one = np.uint64(1) << np.uint64(bit)
                if not asked & one:
                    continue
                hit, crossed = count_of(cell, HIT, bit), times_crossed(cell, bit)
                if mapped & one:
                    if crossed >= GONE_RAYS + HIT_RAYS * hit:
                        out.gone[r, c] |= one
                    elif hit:
                        out.stands[r, c] |= one
                    elif crossed:
                        out.unmet[r, c] |= one
                elif hit >= 1 + NEW_RAYS * crossed:
                    if known_free[r, c] & one:
                        out.new[r, c] |= one
                        out.balance[r, c] += hit - count_of(cell, PASSES, bit)
                        out.hits[r, c] += hit
                    else:
                        out.beyond[r, c] |= one


def judge_window(drive: VoxelFacts, here: Mapped, min_height_m: float) -> WindowStates:
    """What a drive says of a window.

    Of a voxel, over the drive's scans: h times hit, p times passed; a and b the passes of the voxels above and below it
    (detection/evidence.py).

        crossed        C = min(p, a, b)
        mapped voxel:  gone if C >= GONE_RAYS + HIT_RAYS h;  else stands if h >= 1;  else unmet if C >= 1
        free voxel:    new if h >= 1 + NEW_RAYS C

    A cell is empty if a voxel of it is gone and none stands. Of an 8-connected group of empty cells with N gone voxels

        changed-empty     if N >= SUPPORT, or it is a thing of its own on the ground

    and with it cells that touch it, directly or through each other, in which a voxel is gone or unmet and none stands.
    Of an 8-connected group of A cells with N new voxels, among them those that were hit beyond what the map knew within
    MOVED_CELLS of changed-empty,

        changed-occupied  if sum h >= sum p, and
                          N >= min(NEW_VOXELS + NEW_A_CELL A, NEW_ENOUGH) or it is a thing of its own on the ground

    What rises less than ``min_height_m`` is never gone.
    """
    mapped = here.occupied != 0
    high = mapped & (here.height_m >= min_height_m)
    gone: U64 = np.where(high, drive.gone, NOTHING)
    beyond: U64 = np.where(mapped, NOTHING, drive.beyond)
    states = np.full(mapped.shape, NO_VOTE, dtype=np.uint8)
    states[drive.passed != 0] = CellState.UNCHANGED_EMPTY
    states[(mapped & (drive.passed != 0)) | (beyond != 0)] = CellState.UNDETERMINED
    states[drive.stands != 0] = CellState.UNCHANGED_OCCUPIED

    empty = (gone != 0) & (drive.stands == 0)
    firm = supported(empty, gone, SUPPORT) | on_its_own(empty, gone, here.occupied, mapped & ~empty)
    went = grown(firm, high & (drive.stands == 0) & ((drive.gone | drive.unmet) != 0))
    states[empty] = CellState.UNDETERMINED
    states[went] = CellState.CHANGED_EMPTY
    gone = np.where(went, here.occupied, gone)

    near = ndimage.maximum_filter(went, 2 * MOVED_CELLS + 1, mode="constant")
    new: U64 = np.bitwise_or(np.where(mapped, NOTHING, drive.new), np.where(near, beyond, NOTHING))
    cells = new != 0
    enough = np.minimum(NEW_VOXELS + NEW_A_CELL * _over_groups(cells, cells), NEW_ENOUGH)
    firm = supported(cells, new, enough) | on_its_own(cells, new, new, here.occupied & ~gone != 0)
    states[cells] = CellState.UNDETERMINED
    states[firm & lasting(cells, drive.balance)] = CellState.CHANGED_OCCUPIED
    return WindowStates(states, gone, np.where(drive.stands != 0, gone, NOTHING), new)


def supported(cells: Bool, voxels: U64, enough: float | F64) -> Bool:
    """(rows, cols) those of ``cells`` whose 8-connected group has ``enough`` set bits in ``voxels`` (rows, cols)."""
    return np.asarray(cells & (_over_groups(cells, np.bitwise_count(voxels)) >= enough))


def on_its_own(cells: Bool, voxels: U64, whole: U64, others: Bool) -> Bool:
    """(rows, cols) those of ``cells`` whose 8-connected group is a thing of its own that stands on the ground, however
    small: a bollard. It touches none of the ``others``, each of its columns begins near the ground, half of its voxels
    ``whole`` are in ``voxels`` (all planes (rows, cols)), and two of these lie on top of each other."""
    size = _over_groups(cells, np.bitwise_count(voxels))
    tall = _over_groups(cells, voxels & (voxels >> np.uint64(1)) != 0) > 0
    tied = ndimage.binary_dilation(others, _AROUND) | (whole & _LOW == 0)
    alone = (_over_groups(cells, tied) == 0) & (2 * size >= _over_groups(cells, np.bitwise_count(whole)))
    return np.asarray(cells & tall & alone)


def lasting(cells: Bool, balance: I32) -> Bool:
    """(rows, cols) those of ``cells`` whose 8-connected group was hit in as many scans as passed it, or more: by cell
    the ``balance`` is of the voxels in question, what they were hit less what they were passed. What drove there was
    hit once or twice, and passed many times before and after."""
    return np.asarray(cells & (_over_groups(cells, balance) >= 0))


def _over_groups(cells: Bool, amounts: U8 | I32 | Bool) -> F64:
    """(rows, cols) the sum of ``amounts`` (rows, cols) over the 8-connected group of ``cells`` that a cell is in."""
    group, count = ndimage.label(cells, structure=_AROUND)
    return np.asarray(np.bincount(group.ravel(), weights=amounts.ravel(), minlength=count + 1)[group])


def grown(strong: Bool, weak: Bool) -> Bool:
    """(rows, cols) ``strong`` cells, and ``weak`` ones that touch them (8) directly or through each other: hysteresis
    (Canny 1986). Few rays cross the far wall of what fell, and none of them hit it."""
    both = strong | weak
    return np.asarray(both & (_over_groups(both, strong) > 0))
