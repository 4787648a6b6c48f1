"""The rule of evidence on one page: what a drive counts of each voxel, and what its counts say of each cell.

In one scan, returns of moving objects left out:

    mapped voxel  hit if a return lies within HIT_REACH_M of it, in whichever voxel the return lies
    other voxel   hit if a return lies in it that has no mapped voxel so near: what the map explains is nothing new
    any voxel     passed if a ray goes through it and no return lies within HIT_REACH_M of it;
                  crossed if it is passed, and rays go through the voxels above and below it too

A ray that grazes a slab (roof, awning, ceiling) goes through only one of the two. The ground bounds the lowest voxel,
the end of the word the highest. Over a drive's scans a voxel has h hits, c crossings and p passes; a and b are the
passes of the voxels above and below it.

    C = max(c, min(p, a, b) / TOGETHER)
    mapped voxel: gone if C >= GONE_RAYS + HIT_RAYS h; else it stands if h >= 1
    free voxel:   new if h >= 1 + NEW_RAYS c

A cell is empty if a voxel of it is gone and none stands. Of an 8-connected group of A cells that are empty, or that
have new voxels, with N such voxels, *enough* is

    N >= min(SUPPORT + a (A - 1), NEW_ENOUGH), a = 0 for what is gone, NEW_A_CELL for what is new,

or that the group is a separate small object on the ground.

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

from mapvote.core.columns import TOP_BIT, layer_bit
from mapvote.core.grid import CELL_SIZE
from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import F32, F64, I32, NO_VOTE, U8, U64, Bool, CellState
from mapvote.perception.frontend import Observation
from mapvote.perception.raycast import find_obstacles
from mapvote.rules.packed_tiles import PLANES, Overlap, PackedTiles, add_one, count_of

# Set on corner 1 and 2, street 2 and KITTI 0001 in blocks of 12 and 25 scans; docs/method.md says what needs each.
HIT_REACH_M = 0.1
"""Range noise and pose sigma together, three times over."""
GONE_RAYS, HIT_RAYS = 3, 8
"""Scans that must have crossed a mapped voxel that none hit (two may be an error of two poses); more for each hit."""
TOGETHER = 2
"""Scans whose rays cross a voxel only together count as one of so many."""
NEW_RAYS = 0.5
"""Hits that a free voxel needs beside the first, for each scan that crossed it."""
SUPPORT = 6
"""Voxels of a change: a pole of 1.8 m, half a square metre."""
NEW_A_CELL, NEW_ENOUGH = 2, 40
"""Voxels more for each further cell of a new object, as thinner ones are noise; the most, for large low objects."""
REACH_CELLS = 3
"""How far behind a surface that is gone another may have been hidden: .9 m."""

CROSSED, HIT, PASSES, PASSED = 0, PLANES, 2 * PLANES, 3 * PLANES
"""First plane of each counter of a cell, and the last of its WORDS: voxels through which any ray ever went."""
WORDS = PASSED + 1
NOTHING = np.uint64(0)
_LOWEST, _HIGHEST = np.uint64(0b11), np.uint64(1) << np.uint64(TOP_BIT - 1)
_NEAR_GROUND = np.uint64(0b1111)
_AROUND = np.ones((3, 3))


def count_scan(evidence: PackedTiles, seen: Observation) -> U64:
    """Count one scan in the ``evidence`` of a drive, a vehicle's or a survey's: WORDS words a cell. Returns (rows,
    cols) words of the voxels that hold a return which the map does not explain."""
    view, here, scan, grid = seen.view, seen.reference, seen.scan, seen.view.grid
    near, apart = np.zeros((2, *grid.shape), dtype=np.uint64)
    cell = scan.cell if here is scan.reference else find_obstacles(scan.points_map, here)[1]
    still, corner = scan.obstacle & ~seen.moving, (grid.x0, grid.y0)
    mark_near(scan.points_map, cell, still, here.base, here.occupied, corner, HIT_REACH_M / CELL_SIZE, near, apart)
    for planes, part in evidence.under(grid):
        _enter_scan(planes, part, apart, near, view.passed, here.occupied, here.ground_z)
    evidence.leave(grid)
    return apart


@kernel
def mark_near(
    points: F64, cell: I32, chosen: Bool, base: I32, occupied: U64, corner: tuple[float, float], reach: float,
    near: U64, apart: U64,
) -> None:  # fmt: skip
    """Enter into ``near`` the voxels that come within ``reach`` cells, along each axis, of the points (n, 3), and into
    ``apart`` the voxel of each that has none of the map's so near: planes (rows, cols), ``cell`` (n,) flat in them."""
    rows, cols = occupied.shape
    for i in range(np.uint64(0), np.uint64(len(points))):
        if not chosen[i] or cell[i] < 0:
            continue
        x, y = (points[i, 0] - corner[0]) / CELL_SIZE, (points[i, 1] - corner[1]) / CELL_SIZE
        z, mapped = points[i, 2] / CELL_SIZE, np.uint64(0)
        for r in range(max(int(y - reach), 0), min(int(y + reach), rows - 1) + 1):
            for c in range(max(int(x - reach), 0), min(int(x + reach), cols - 1) + 1):
                word = _layers(int(np.floor(z - reach)), int(np.floor(z + reach)), base[r, c])
                near[r, c] |= word
                mapped |= occupied[r, c] & word
        if not mapped:
            r, c = divmod(cell[i], cols)
            apart[r, c] |= _layers(int(np.floor(z)), int(np.floor(z)), base[r, c])


@inlined
def _layers(lowest: int, highest: int, base: int) -> np.uint64:
    """The word of the layers ``lowest`` to ``highest`` of the world in a column that begins at ``base``."""
    low, high = layer_bit(lowest, base), layer_bit(highest, base)
    return (np.uint64(2) << np.uint64(high)) - (np.uint64(1) << np.uint64(low))


@kernel
def _enter_scan(planes: U64, part: Overlap, apart: U64, near: U64, passed: U64, occupied: U64, ground_z: F32) -> None:
    """Add to a tile's ``planes`` the ``part`` of one scan's window that lies on it. Where the ground is unknown heights
    mean nothing, and nothing is counted."""
    for r in range(part.row, part.end_row):
        for c in range(part.col, part.end_col):
            if np.isnan(ground_z[r, c]) or not near[r, c] | passed[r, c]:
                continue
            cell, rays, missed = planes[r + part.down, c + part.right], passed[r, c], passed[r, c] & ~near[r, c]
            cell[PASSED] |= rays
            crossed = missed & (rays >> np.uint64(1) | _HIGHEST) & (rays << np.uint64(1) | _LOWEST)
            add_one(cell, (crossed, (near[r, c] & occupied[r, c]) | apart[r, c], missed))


@kernel
def least_passed(cell: U64, bit: int) -> int:
    """min(p, a, b) of voxel ``bit`` of a cell (WORDS,); the ends of the word are bounded as in one scan."""
    least = count_of(cell, PASSES, bit)
    if bit + 1 < TOP_BIT:
        least = min(least, count_of(cell, PASSES, bit + 1))
    return min(least, count_of(cell, PASSES, bit - 1)) if bit > 1 else least


def free_words(planes: U64) -> U64:
    """(rows, cols) voxels that two scans or more passed and none hit."""
    hit = np.bitwise_or.reduce(planes[..., HIT : HIT + PLANES], axis=-1)
    often = np.bitwise_or.reduce(planes[..., PASSES + 1 : PASSES + PLANES], axis=-1)
    return np.asarray(often & ~hit)


class Facts(NamedTuple):
    """What the counts say of a window, (rows, cols) each: words of voxels, ``beyond`` as ``new`` where the map did not
    know them to be free, ``passed`` by any ray; and over a cell's new voxels the sums of h and of h - p."""

    gone: U64
    stands: U64
    new: U64
    beyond: U64
    passed: U64
    hits: I32
    balance: I32

    @classmethod
    def none(cls, shape: tuple[int, int]) -> Facts:
        """Of a window in which nothing was counted."""
        return cls(*(np.zeros(shape, kind) for kind in [np.uint64] * 5 + [np.int32] * 2))


@kernel
def weigh_voxels(planes: U64, part: Overlap, occupied: U64, known_free: U64, out: Facts) -> None:
    """Fill the ``part`` of a window that lies on a tile from the tile's counters (256, 256, WORDS), by the voxels that
    the map holds and knows to be free (rows, cols). ``out`` comes empty."""
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
                hits, crossed = count_of(cell, HIT, bit), count_of(cell, CROSSED, bit)
                if mapped & one:
                    if max(crossed, least_passed(cell, bit) // TOGETHER) >= GONE_RAYS + HIT_RAYS * hits:
                        out.gone[r, c] |= one
                    elif hits:
                        out.stands[r, c] |= one
                elif hits >= 1 + NEW_RAYS * crossed:
                    if known_free[r, c] & one:
                        out.new[r, c] |= one
                        out.hits[r, c] += hits
                        out.balance[r, c] += hits - count_of(cell, PASSES, bit)
                    else:
                        out.beyond[r, c] |= one


def judge_window(drive: Facts, occupied: U64, height_m: F32, min_height_m: float) -> tuple[U8, U64, U64]:
    """(states, gone, new), (rows, cols) each, of a window of which the map knows the ``occupied`` voxels and how high
    they rise over the ground, not finite where there are none. ``gone`` are the voxels that went, of changed-empty
    cells and of cells that stand, ``new`` those that came."""
    mapped, stands, passed = occupied != 0, drive.stands != 0, drive.passed != 0
    high = mapped & (height_m >= min_height_m)
    gone: U64 = np.where(high, drive.gone, NOTHING)
    beyond: U64 = np.where(mapped, NOTHING, drive.beyond)
    states = np.full(mapped.shape, NO_VOTE, dtype=np.uint8)
    states[passed] = CellState.UNCHANGED_EMPTY
    states[(mapped & passed) | (beyond != 0)] = CellState.UNDETERMINED
    states[stands] = CellState.UNCHANGED_OCCUPIED

    empty: Bool = (gone != 0) & ~stands
    firm = enough(np.where(empty, gone, NOTHING), 0, mapped & ~empty, np.zeros_like(drive.balance))
    seen_through = 2 * np.bitwise_count(occupied & drive.passed) >= np.bitwise_count(occupied)
    went = grown(firm, high & ~stands & seen_through)
    states[went] = CellState.CHANGED_EMPTY
    gone = np.where(went, occupied, gone)

    near = ndimage.maximum_filter(went, 2 * REACH_CELLS + 1, mode="constant")
    new: U64 = np.bitwise_or(np.where(mapped, NOTHING, drive.new), np.where(near, beyond, NOTHING))
    states[new != 0] = CellState.UNDETERMINED
    states[enough(new, NEW_A_CELL, occupied & ~gone != 0, drive.balance)] = CellState.CHANGED_OCCUPIED
    return states, np.where(went | stands, gone, NOTHING), new


def enough(voxels: U64, a_cell: int, others: Bool, balance: I32) -> Bool:
    """(rows, cols) cells whose 8-connected group has enough ``voxels`` (rows, cols), ``a_cell`` more for each further
    cell, and no negative ``balance``. Of a separate small object on the ground (a bollard) any two voxels on top of
    each other are enough: it touches none of the ``others``, and its columns begin within 1.2 m of the ground."""
    cells = voxels != 0
    tall = voxels & (voxels >> np.uint64(1)) != 0
    tied = ndimage.binary_dilation(others, _AROUND) | (voxels & _NEAR_GROUND == 0)
    size, count, talls, ties, left = over_groups(cells, np.bitwise_count(voxels), cells, tall, tied, balance)
    large = size >= np.minimum(SUPPORT + a_cell * (count - 1), NEW_ENOUGH)
    return np.asarray(cells & (left >= 0) & (large | ((talls > 0) & (ties == 0))))


def grown(strong: Bool, weak: Bool) -> Bool:
    """(rows, cols) ``strong`` cells, and ``weak`` ones connected to them (8): hysteresis (Canny 1986).
    Few rays cross the far wall of a demolished house."""
    both = strong | weak
    return np.asarray(both & (over_groups(both, strong)[0] > 0))


def over_groups(cells: Bool, *amounts: U8 | I32 | Bool) -> list[F64]:
    """For each of ``amounts`` (rows, cols) its sum over the 8-connected group of ``cells`` that a cell is in."""
    group, count = ndimage.label(cells, structure=_AROUND)
    return [np.bincount(group.ravel(), amount.ravel(), count + 1)[group] for amount in amounts]
