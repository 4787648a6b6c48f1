"""The rule of surfaces on one page: what a drive's counts say of every cell of a window of tiles (docs/method.md).

Of a voxel, over the drive's scans: h hits, c crossings, p passes (detection/evidence.py); a and b the passes of the
voxels above and below it.

    C = max(c, min(p, a, b) / TOGETHER)
    mapped voxel:  gone if C >= GONE_RAYS + HIT_RAYS h;  else it stands if h >= 1
    free voxel:    new if h >= 1 + NEW_RAYS c

A cell is empty if a voxel of it is gone and none stands. Of an 8-connected group of A cells that are empty, or that
have new voxels, with N such voxels, *enough* is

    N >= min(SUPPORT + a (A - 1), NEW_ENOUGH),  a = 0 for what is gone, NEW_A_CELL for what is new,

or that the group is a thing of its own on the ground.

    changed-empty     empty cells that are enough, and cells that touch them, directly or through each other, in which
                      nothing stands and rays passed half of the mapped voxels
    changed-occupied  cells with new voxels that are enough, if sum h >= sum p over the group; what was hit where the
                      map knew nothing is new within REACH_CELLS of changed-empty

What rises less than ``min_height_m`` over the ground is never gone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from mapvote.core.kernel import kernel
from mapvote.core.types import F32, F64, I32, NO_VOTE, U8, U64, Bool, CellState
from mapvote.detection.evidence import CROSSED, HIT, PASSED, PASSES, PLANES, count_of, least_passed
from mapvote.detection.packed_tiles import Overlap

# Set on corner 1 and 2, street 2 and KITTI 0001 in blocks of 12 and 25 scans; docs/method.md says what needs each.
GONE_RAYS = 3
"""Scans that must have crossed a mapped voxel that none hit: two may be an error of two poses."""
HIT_RAYS = 8
"""Scans more for each that hit it."""
TOGETHER = 2
"""Scans whose rays cross a voxel only together count as one of so many."""
NEW_RAYS = 0.5
"""Hits that a free voxel needs beside the first, for each scan whose rays crossed it."""
SUPPORT = 6
"""Voxels of a change: a pole of 1.8 m, half a square metre."""
NEW_A_CELL, NEW_ENOUGH = 2, 40
"""Voxels that something new needs for each further cell, because what is thinner is noise, and at most: the bound keeps
large low things."""
REACH_CELLS = 3
"""How far behind a surface that is gone another may have been hidden: .9 m."""
_AROUND = np.ones((3, 3))
_LOW = np.uint64(0b1111)
"""A column that has one of these voxels begins within 1.2 m of the ground."""
NOTHING = np.uint64(0)


class VoxelFacts(NamedTuple):
    """What the counts say of the voxels of a window: column words (rows, cols)."""

    gone: U64
    stands: U64
    new: U64
    beyond: U64
    """As new, but the map did not know the voxel to be free."""
    passed: U64
    """What any ray passed."""
    hits: I32
    """Over a cell's new voxels: the sum of h."""
    balance: I32
    """Over a cell's new voxels: the sum of h - p."""


class WindowStates(NamedTuple):
    """What the drive says of each cell, and by which voxels: (rows, cols)."""

    states: U8
    gone: U64
    remnants: U64
    new: U64


def no_facts(shape: tuple[int, int]) -> VoxelFacts:
    """Of a window in which nothing was counted."""
    return VoxelFacts(*(np.zeros(shape, kind) for kind in [np.uint64] * 5 + [np.int32] * 2))


@kernel
def weigh_voxels(planes: U64, part: Overlap, occupied: U64, known_free: U64, out: VoxelFacts) -> None:
    """Fill the ``part`` of a window that lies on a tile from the tile's counters (256, 256, WORDS), by the voxels that
    the map holds and knows to be free (rows, cols). ``out`` comes empty (:func:`no_facts`)."""
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
                hits = count_of(cell, HIT, bit)
                if mapped & one:
                    crossed = max(count_of(cell, CROSSED, bit), least_passed(cell, bit) // TOGETHER)
                    if crossed >= GONE_RAYS + HIT_RAYS * hits:
                        out.gone[r, c] |= one
                    elif hits:
                        out.stands[r, c] |= one
                elif hits >= 1 + NEW_RAYS * count_of(cell, CROSSED, bit):
                    if known_free[r, c] & one:
                        out.new[r, c] |= one
                        out.hits[r, c] += hits
                        out.balance[r, c] += hits - count_of(cell, PASSES, bit)
                    else:
                        out.beyond[r, c] |= one


def judge_window(drive: VoxelFacts, occupied: U64, height_m: F32, min_height_m: float) -> WindowStates:
    """What a drive says of a window, of which the map knows (rows, cols) the ``occupied`` voxels and how high they rise
    over the ground, not finite where there are none."""
    mapped, stands, passed = occupied != 0, drive.stands != 0, drive.passed != 0
    high = mapped & (height_m >= min_height_m)
    gone: U64 = np.where(high, drive.gone, NOTHING)
    beyond: U64 = np.where(mapped, NOTHING, drive.beyond)
    states = np.full(mapped.shape, NO_VOTE, dtype=np.uint8)
    states[passed] = CellState.UNCHANGED_EMPTY
    states[(mapped & passed) | (beyond != 0)] = CellState.UNDETERMINED
    states[stands] = CellState.UNCHANGED_OCCUPIED

    empty: Bool = (gone != 0) & ~stands
    firm = enough(np.where(empty, gone, NOTHING), 0, mapped & ~empty)
    seen_through = 2 * np.bitwise_count(occupied & drive.passed) >= np.bitwise_count(occupied)
    went = grown(firm, high & ~stands & seen_through)
    states[went] = CellState.CHANGED_EMPTY
    gone = np.where(went, occupied, gone)

    near = ndimage.maximum_filter(went, 2 * REACH_CELLS + 1, mode="constant")
    new: U64 = np.bitwise_or(np.where(mapped, NOTHING, drive.new), np.where(near, beyond, NOTHING))
    (balance,) = over_groups(new != 0, drive.balance)
    came = enough(new, NEW_A_CELL, occupied & ~gone != 0) & (balance >= 0)
    states[new != 0] = CellState.UNDETERMINED
    states[came] = CellState.CHANGED_OCCUPIED
    return WindowStates(states, gone, np.where(stands, gone, NOTHING), new)


def enough(voxels: U64, a_cell: int, others: Bool) -> Bool:
    """(rows, cols) cells whose 8-connected group has enough ``voxels`` (rows, cols), ``a_cell`` more for each further
    cell, or is a thing of its own on the ground, however small: a bollard. It touches none of the ``others``, each of
    its columns begins near the ground, and two of its voxels lie on top of each other."""
    cells = voxels != 0
    tall = voxels & (voxels >> np.uint64(1)) != 0
    tied = ndimage.binary_dilation(others, _AROUND) | (voxels & _LOW == 0)
    size, count, talls, ties = over_groups(cells, np.bitwise_count(voxels), cells, tall, tied)
    large = size >= np.minimum(SUPPORT + a_cell * (count - 1), NEW_ENOUGH)
    return np.asarray(cells & (large | ((talls > 0) & (ties == 0))))


def over_groups(cells: Bool, *amounts: U8 | I32 | Bool) -> list[F64]:
    """For each of ``amounts`` (rows, cols) its sum over the 8-connected group of ``cells`` that a cell is in, (rows,
    cols)."""
    group, count = ndimage.label(cells, structure=_AROUND)
    flat = group.ravel()
    return [np.bincount(flat, weights=amount.ravel(), minlength=count + 1)[group] for amount in amounts]


def grown(strong: Bool, weak: Bool) -> Bool:
    """(rows, cols) ``strong`` cells, and ``weak`` ones that touch them (8) directly or through each other: hysteresis
    (Canny 1986). Few rays cross the far wall of a demolished house."""
    both = strong | weak
    (strongs,) = over_groups(both, strong)
    return np.asarray(both & (strongs > 0))
