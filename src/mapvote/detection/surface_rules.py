"""The rule of surfaces on one page: what a drive's counts say of every cell of a window of tiles (docs/method.md)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from mapvote.core.kernel import kernel
from mapvote.core.types import F32, F64, I32, NO_VOTE, U8, U64, Bool, CellState
from mapvote.detection.evidence import CROSSED, HIT, PASSED, PASSES, PLANES, count_of, least_passed
from mapvote.detection.packed_tiles import Overlap

# Set on corner 1 and 2, street 2 and KITTI 0001 in blocks of 12 and 25 scans; docs/method.md says what needs each.
HIT_RAYS = 8
"""Scans that crossed a mapped voxel, against one that hit it."""
GONE_RAYS = 3
"""Scans that must have crossed it beyond those: two may be an error of two poses."""
TOGETHER = 2
"""Scans whose rays cross it only together count as one of so many."""
NEW_RAYS = 0.5
"""Of the scans in which a free voxel was hit, one against two that crossed it."""
SUPPORT = 6
"""Voxels by which something gone must be decided, in its 8-connected cells: a pole of 1.8 m, half a square metre."""
NEW_A_CELL, NEW_ENOUGH = 2, 40
"""Something new needs SUPPORT voxels in its first cell, so many more in each other cell, and so many at most. What is
thinner is noise beside what stands. The bound keeps large low things."""
REACH_CELLS = 3
"""How far what went reaches: .9 m. So far behind it its new side may lie, and what no ray could decide goes with it."""
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


class WindowStates(NamedTuple):
    """What the drive says of each cell, and by which voxels: (rows, cols)."""

    states: U8
    gone: U64
    remnants: U64
    new: U64


def no_facts(shape: tuple[int, int]) -> VoxelFacts:
    """Of a window in which nothing was counted."""
    gone, stands, unmet, new, beyond, passed = (np.zeros(shape, np.uint64) for _ in range(6))
    return VoxelFacts(gone, stands, unmet, new, beyond, passed, np.zeros(shape, np.int32), np.zeros(shape, np.int32))


@kernel
def times_crossed(cell: U64, bit: int) -> int:
    """C of :func:`judge_window` for a mapped voxel of a cell (WORDS,)."""
    return max(count_of(cell, CROSSED, bit), least_passed(cell, bit) // TOGETHER)


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
                hit = count_of(cell, HIT, bit)
                if mapped & one:
                    crossed = times_crossed(cell, bit)
                    if crossed >= GONE_RAYS + HIT_RAYS * hit:
                        out.gone[r, c] |= one
                    elif hit:
                        out.stands[r, c] |= one
                    elif crossed:
                        out.unmet[r, c] |= one
                elif hit >= 1 + NEW_RAYS * count_of(cell, CROSSED, bit):
                    if known_free[r, c] & one:
                        out.new[r, c] |= one
                        out.balance[r, c] += hit - count_of(cell, PASSES, bit)
                        out.hits[r, c] += hit
                    else:
                        out.beyond[r, c] |= one


def judge_window(drive: VoxelFacts, occupied: U64, height_m: F32, min_height_m: float) -> WindowStates:
    """What a drive says of a window, of which the map knows (rows, cols) the ``occupied`` voxels and how high they rise
    over the ground, not finite where there are none.

    Of a voxel, over the drive's scans: h hits, c crossed, p passes (detection/evidence.py); a and b the passes of the
    voxels above and below it.

        C = max(c, min(p, a, b) / TOGETHER)
        mapped voxel:  gone if C >= GONE_RAYS + HIT_RAYS h;  else stands if h >= 1
        free voxel:    new if h >= 1 + NEW_RAYS c

    A cell is empty if a voxel of it is gone and none stands. Of an 8-connected group of empty cells with N gone voxels

        changed-empty  if N >= SUPPORT, or it is a thing of its own on the ground

    and with it what :func:`grown` and :func:`fallen` say. Of an 8-connected group of A cells with N
    new voxels, among them those that were hit beyond what the map knew within REACH_CELLS of changed-empty,

        changed-occupied  if sum h >= sum p, and
                          N >= min(SUPPORT + NEW_A_CELL (A - 1), NEW_ENOUGH) or it is a thing of its own on the ground

    What rises less than ``min_height_m`` is never gone.
    """
    mapped, nothing = occupied != 0, drive.gone | drive.stands == 0
    high = mapped & (height_m >= min_height_m)
    gone: U64 = np.where(high, drive.gone, NOTHING)
    beyond: U64 = np.where(mapped, NOTHING, drive.beyond)
    states = np.full(mapped.shape, NO_VOTE, dtype=np.uint8)
    states[drive.passed != 0] = CellState.UNCHANGED_EMPTY
    states[(mapped & (drive.passed != 0)) | (beyond != 0)] = CellState.UNDETERMINED
    states[drive.stands != 0] = CellState.UNCHANGED_OCCUPIED

    empty = (gone != 0) & (drive.stands == 0)
    firm = supported(empty, gone, SUPPORT) | on_its_own(empty, gone, occupied, mapped & ~empty)
    crossed = high & (drive.stands == 0) & ((drive.gone | drive.unmet) != 0)
    states[empty] = CellState.UNDETERMINED
    states[grown(firm, crossed)] = CellState.CHANGED_EMPTY
    undecided = high & nothing & _hollow_below(occupied, drive.passed)
    states[fallen(states, undecided, REACH_CELLS)] = CellState.CHANGED_EMPTY
    went = states == CellState.CHANGED_EMPTY
    gone = np.where(went, occupied, gone)

    near = ndimage.maximum_filter(went, 2 * REACH_CELLS + 1, mode="constant")
    new: U64 = np.bitwise_or(np.where(mapped, NOTHING, drive.new), np.where(near, beyond, NOTHING))
    cells = new != 0
    enough = np.minimum(SUPPORT + NEW_A_CELL * (_over_groups(cells, cells) - 1), NEW_ENOUGH)
    firm = supported(cells, new, enough) | on_its_own(cells, new, new, occupied & ~gone != 0)
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


def fallen(states: U8, adrift: Bool, reach: int) -> Bool:
    """(rows, cols) cells that fall: what stood on things that are gone, and no ray could reach, is gone with them.

    The roof of a demolished house, too high for the sensor once nothing is behind it. An ``adrift`` cell goes with the
    changed-empty or the unchanged-occupied cell that is nearer, so that of two roofs that meet only one falls; a
    connected group of those that go falls if a changed-empty cell lies within ``reach`` cells of it.
    """
    gone, kept = states == CellState.CHANGED_EMPTY, states == CellState.UNCHANGED_OCCUPIED
    if not (gone.any() and adrift.any()):
        return np.zeros_like(adrift)
    to_gone = _steps_to(gone)
    goes = adrift & (to_gone < _steps_to(kept)) if kept.any() else adrift
    return grown(goes & (to_gone <= reach), goes)


def _steps_to(cells: Bool) -> I32:
    """(rows, cols) how many steps, diagonal ones too, it is to the nearest of ``cells``; there must be one."""
    return np.asarray(ndimage.distance_transform_cdt(~cells, metric="chessboard"))


def _hollow_below(occupied: U64, passed: U64) -> Bool:
    """(rows, cols) mapped cells with something under their lowest voxel, half of which or more rays passed."""
    under = np.where(occupied != 0, (occupied & (~occupied + np.uint64(1))) - np.uint64(1), NOTHING)
    return np.asarray((under != 0) & (2 * np.bitwise_count(under & passed) >= np.bitwise_count(under)))
