"""The rule of evidence on one page: the counts of each voxel over a drive, and the state of each cell by its counts.

In one scan, returns of moving objects left out:

    mapped voxel  hit if a return lies within hit_reach_m of it, in whichever voxel the return lies
    other voxel   hit if a return lies in it that has no mapped voxel so near: a return that the map explains is not new
    any voxel     passed if a ray goes through it and no return lies within hit_reach_m of it;
                  crossed if it is passed, and rays go through the voxels above and below it too

A ray that grazes a slab (roof, awning, ceiling) goes through only one of the two. The ground bounds the lowest voxel,
the end of the word the highest. Over a drive's scans a voxel has h hits, c crossings and p passes; a and b are the
passes of the voxels above and below it.

    C = max(c, min(p, a, b) / together)
    mapped voxel: gone if C >= gone_rays + hit_rays h; else it stands if h >= 1
    free voxel:   new if h >= 1 + new_rays c

A cell is empty if a voxel of it is gone and none stands. An 8-connected group of A cells that are empty, or that have
new voxels, with N such voxels, is *enough* if

    N >= min(support + a (A - 1), new_enough), a = 0 for gone voxels, new_a_cell for new ones,

or if it is a separate small object on the ground.

    changed-empty     empty cells that are enough, and cells that touch them, directly or through each other, in which
                      nothing stands and rays passed half of the mapped voxels
    changed-occupied  cells with new voxels that are enough, if sum h >= sum p over the group. Voxels that were hit
                      where the map knew nothing are new within reach_cells of changed-empty

A surface that rises less than ``min_height_m`` over the ground is never gone. SurfaceRule holds the numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapvote.core.columns import TOP_BIT, layer_bit
from mapvote.core.grid import CELL_SIZE
from mapvote.core.groups import groups_of, widened
from mapvote.core.kernel import inlined, kernel
from mapvote.core.record import record
from mapvote.core.types import F32, F64, I32, NO_VOTE, U8, U64, Bool, CellState
from mapvote.perception.frontend import Observation
from mapvote.perception.placement import cells_and_obstacles
from mapvote.rules.packed_tiles import COUNT_PLANES, Overlap, count_of
from mapvote.rules.voxel_counts import CROSSED, HIT, PASSED, PASSES, ScanWords, VoxelCounts


@record(votes=True)
@dataclass(frozen=True, slots=True)
class SurfaceRule:
    """Numbers of the rule. Set on corner 1 and 2, street 2 and KITTI 0001 in blocks of 12 and 25 scans; docs/method.md
    names the scene that needs each."""

    hit_reach_m: float = 0.1
    """Distance from a voxel at which a return still hits it: range noise and pose sigma together, three times over."""
    gone_rays: int = 3
    """Scans that must have crossed a mapped voxel without hits: two may be an error of two poses."""
    hit_rays: int = 8
    """Further scans that must have crossed it, for each hit."""
    together: int = 2
    """Scans whose rays cross a voxel only together count as one crossing of so many."""
    new_rays: float = 0.5
    """Hits that a free voxel needs beside the first, for each scan that crossed it."""
    support: int = 6
    """Voxels of a change: a pole of 1.8 m, half a square metre."""
    new_a_cell: int = 2
    """Further voxels for each further cell of a new object: thinner ones are noise."""
    new_enough: int = 40
    """Voxels that are enough for a new object of any size: large, low objects have few a cell."""
    reach_cells: int = 3
    """Cells behind a deleted surface, 0.9 m, within which it may have hidden another surface."""


SURFACE_RULE = SurfaceRule()

NO_VOXELS = np.uint64(0)


def count_scan(counts: VoxelCounts, seen: Observation, rule: SurfaceRule = SURFACE_RULE) -> U64:
    """Count one scan in the ``counts`` of a drive, a vehicle's or a survey's. Returns (rows, cols) words of the voxels
    that hold a return which the map does not explain."""
    near, hit, apart, spans = near_hits(seen, rule)
    ground_z = np.ascontiguousarray(seen.reference.ground_z)
    counts.enter(seen.view.grid, ScanWords(seen.view.passed, near, hit, ground_z, spans))
    return apart


def near_hits(seen: Observation, rule: SurfaceRule = SURFACE_RULE) -> tuple[U64, U64, U64, I32]:
    """(near, hit, apart, spans) of one scan, words (rows, cols): the voxels within ``hit_reach_m``, along each axis, of
    a return that stands still; the voxels that are hit; those of them that are not the map's. ``spans`` (rows, 2): of
    each row the first cell with rays or a hit, and the one behind the last."""
    here = seen.reference
    scan = seen.scan
    grid = seen.view.grid
    near, apart = np.zeros((2, *grid.shape), dtype=np.uint64)
    hit = np.empty(grid.shape, dtype=np.uint64)
    cell = scan.cell if here is scan.reference else cells_and_obstacles(scan.rows, scan.origin_map, here)[0]
    x, y, z = map(float, scan.origin_map)
    from_corner = x - grid.x0, y - grid.y0, z
    chosen = np.empty(len(cell) + 1, np.int32)
    outer = scan.outer if here is scan.reference else here  # whole: a copy of the window would take longer
    wide = outer.grid.cols
    corner = (grid.row0 - outer.grid.row0) * wide + grid.col0 - outer.grid.col0
    occupied = np.ascontiguousarray(outer.occupied).reshape(-1)
    mapped = np.ascontiguousarray(here.base).reshape(-1), occupied, corner, wide
    marked = np.ascontiguousarray(seen.view.passed).reshape(-1), near.reshape(-1), hit.reshape(-1), apart.reshape(-1)
    spans = np.empty((len(near), 2), np.int32)
    reach = rule.hit_reach_m / CELL_SIZE
    _mark_near(
        scan.rows, cell, scan.obstacle, seen.moving, from_corner, reach, grid.shape, mapped, marked, spans, chosen
    )
    return near, hit, apart, spans


@kernel
def _mark_near(
    points: F32, cell: I32, obstacle: Bool, moving: Bool, origin: tuple[float, float, float], reach: float,
    shape: tuple[int, int], mapped: tuple[I32, U64, int, int], marked: tuple[U64, U64, U64, U64], spans: I32,
    chosen: I32,
) -> None:  # fmt: skip
    """:func:`near_hits` of the points (3, n) from ``origin``, which is given from the corner of planes of this
    ``shape``, all flat: ``marked`` passed, near, hit, apart; ``mapped`` base, the words of a wider plane, the cell of
    it at which these begin, and its columns. ``reach``: cells, below a half, so that a return reaches two cells or one
    along each axis. Four are always entered, be they one: no branch to predict. A voxel near a return is hit if it is
    the map's. ``chosen`` (n + 1,): scratch."""
    base, occupied, corner, wide = mapped
    passed, near, hit, apart = marked
    rows, cols = shape
    east = points[0]
    north = points[1]
    up = points[2]
    x0, y0, z0 = origin
    per_m = 1.0 / CELL_SIZE
    count = np.uint64(0)
    for i in range(np.uint64(0), np.uint64(len(cell))):
        chosen[count] = i
        count += np.uint64(obstacle[i] & (not moving[i]))
    for k in range(np.uint64(0), count):
        p = np.uint64(chosen[k])
        if cell[p] < 0:
            continue
        x = (np.float64(east[p]) + x0) * per_m
        y = (np.float64(north[p]) + y0) * per_m
        z = (np.float64(up[p]) + z0) * per_m
        lowest = np.int64(np.floor(z - reach))
        highest = np.int64(np.floor(z + reach))
        left = np.int64(max(x - reach, 0.0))
        right = min(np.int64(x + reach), np.int64(cols - 1))
        first = np.int64(max(y - reach, 0.0))
        last = min(np.int64(y + reach), np.int64(rows - 1))
        a = np.uint64(first * cols + left)
        b = np.uint64(first * cols + right)
        c = np.uint64(last * cols + left)
        d = np.uint64(last * cols + right)
        of_a = _layers(lowest, highest, base[a])
        of_b = _layers(lowest, highest, base[b])
        of_c = _layers(lowest, highest, base[c])
        of_d = _layers(lowest, highest, base[d])
        near[a] |= of_a
        near[b] |= of_b
        near[c] |= of_c
        near[d] |= of_d
        lower = corner + first * wide
        upper = corner + last * wide
        explained = of_a & occupied[np.uint64(lower + left)] | of_b & occupied[np.uint64(lower + right)]
        if not explained | of_c & occupied[np.uint64(upper + left)] | of_d & occupied[np.uint64(upper + right)]:
            at = np.uint64(cell[p])
            layer = np.int64(np.floor((np.float64(up[p]) + z0) / CELL_SIZE))  # as all say in which voxel a point lies
            apart[at] |= _layers(layer, layer, base[at])
    for r in range(rows):
        begin = np.uint64(r * cols)
        of_map = np.uint64(corner + r * wide)
        west = np.int32(cols)
        east = np.int32(0)
        for i in range(np.uint64(0), np.uint64(cols)):
            struck = near[begin + i] & occupied[of_map + i] | apart[begin + i]
            hit[begin + i] = struck
            empty = struck | passed[begin + i] == 0
            west = min(west, np.int32(cols) if empty else np.int32(i))
            east = max(east, np.int32(0) if empty else np.int32(np.int32(i) + 1))
        spans[r, 0] = west
        spans[r, 1] = east


@inlined
def _layers(lowest: np.int64, highest: np.int64, base: np.int32) -> np.uint64:
    """The word of one layer of the world or two, ``lowest`` and ``highest``, in a column that begins at ``base``."""
    from_ = lowest - base
    if (from_ >= 0) & (highest - base <= TOP_BIT):
        return np.uint64(1 + 2 * (highest - lowest)) << np.uint64(from_)
    low = np.uint64(layer_bit(lowest, np.int64(base)))
    high = np.uint64(layer_bit(highest, np.int64(base)))
    return (np.uint64(2) << high) - (np.uint64(1) << low)


@kernel
def least_passed(cell: U64, bit: int) -> int:
    """min(p, a, b) of voxel ``bit`` of a cell (WORDS,); the ends of the word are bounded as in one scan."""
    least = count_of(cell, PASSES, bit)
    if bit + 1 < TOP_BIT:
        least = min(least, count_of(cell, PASSES, bit + 1))
    return min(least, count_of(cell, PASSES, bit - 1)) if bit > 1 else least


def free_words(planes: U64) -> U64:
    """(rows, cols) voxels that two scans or more passed and none hit."""
    hit = np.bitwise_or.reduce(planes[..., HIT : HIT + COUNT_PLANES], axis=-1)
    often = np.bitwise_or.reduce(planes[..., PASSES + 1 : PASSES + COUNT_PLANES], axis=-1)
    return np.asarray(often & ~hit)


class Facts(NamedTuple):
    """Words of voxels of a window by their counts, (rows, cols) each, and sums over each cell's new voxels."""

    gone: U64
    stands: U64
    new: U64
    """New where the map knew them to be free."""
    beyond: U64
    """New where the map did not know them to be free."""
    passed: U64
    """Passed by any ray."""
    hits: I32
    """Sum of h over the new voxels of the cell."""
    balance: I32
    """Sum of h - p over the new voxels of the cell."""

    @classmethod
    def none(cls, shape: tuple[int, int]) -> Facts:
        """The facts of a window in which nothing was counted."""
        return cls(*(np.zeros(shape, kind) for kind in [np.uint64] * 5 + [np.int32] * 2))


def weigh_voxels(
    planes: U64, part: Overlap, occupied: U64, known_free: U64, out: Facts, rule: SurfaceRule = SURFACE_RULE
) -> None:
    """Fill the ``part`` of a window that lies on a tile from the tile's counters (256, 256, WORDS), by the voxels that
    the map holds and knows to be free (rows, cols). ``out`` comes empty."""
    bounds = rule.gone_rays, rule.hit_rays, rule.together, rule.new_rays
    _weigh_voxels(planes, part, occupied, known_free, bounds, out)


@kernel
def _weigh_voxels(
    planes: U64, part: Overlap, occupied: U64, known_free: U64, bounds: tuple[int, int, int, float], out: Facts
) -> None:
    """:func:`weigh_voxels`; ``bounds``: gone_rays, hit_rays, together, new_rays."""
    gone_rays, hit_rays, together, new_rays = bounds
    for r in range(part.row, part.end_row):
        for c in range(part.col, part.end_col):
            cell = planes[r + part.down, c + part.right]
            mapped = occupied[r, c]
            out.passed[r, c] = cell[PASSED]
            mapped_or_hit = mapped
            for k in range(COUNT_PLANES):
                mapped_or_hit |= cell[HIT + k]
            for bit in range(64 if mapped_or_hit else 0):
                one = np.uint64(1) << np.uint64(bit)
                if not mapped_or_hit & one:
                    continue
                hits = count_of(cell, HIT, bit)
                crossed = count_of(cell, CROSSED, bit)
                if mapped & one:
                    if max(crossed, least_passed(cell, bit) // together) >= gone_rays + hit_rays * hits:
                        out.gone[r, c] |= one
                    elif hits:
                        out.stands[r, c] |= one
                elif hits >= 1 + new_rays * crossed:
                    if known_free[r, c] & one:
                        out.new[r, c] |= one
                        out.hits[r, c] += hits
                        out.balance[r, c] += hits - count_of(cell, PASSES, bit)
                    else:
                        out.beyond[r, c] |= one


def judge_window(
    drive: Facts, occupied: U64, height_m: F32, min_height_m: float, rule: SurfaceRule = SURFACE_RULE
) -> tuple[U8, U64, U64]:
    """(states, gone, new), (rows, cols) each, of a window of which the map knows the ``occupied`` voxels and how high
    they rise over the ground, not finite where there are none. ``gone`` are the voxels that went, of changed-empty
    cells and of cells that stand, ``new`` those that came."""
    # The state of each cell by its own voxels.
    mapped = occupied != 0
    stands = drive.stands != 0
    passed = drive.passed != 0
    high = mapped & (height_m >= min_height_m)
    gone: U64 = np.where(high, drive.gone, NO_VOXELS)
    beyond: U64 = np.where(mapped, NO_VOXELS, drive.beyond)
    states = np.full(mapped.shape, NO_VOTE, dtype=np.uint8)
    states[passed] = CellState.UNCHANGED_EMPTY
    states[(mapped & passed) | (beyond != 0)] = CellState.UNDETERMINED
    states[stands] = CellState.UNCHANGED_OCCUPIED

    # Empty cells that are enough, and those that touch them.
    empty: Bool = (gone != 0) & ~stands
    firm = enough(np.where(empty, gone, NO_VOXELS), 0, mapped & ~empty, np.zeros_like(drive.balance), rule)
    seen_through = 2 * np.bitwise_count(occupied & drive.passed) >= np.bitwise_count(occupied)
    went = grown(firm, high & ~stands & seen_through)
    states[went] = CellState.CHANGED_EMPTY
    gone = np.where(went, occupied, gone)

    # New voxels, also those that a deleted surface may have hidden.
    near = widened(went, rule.reach_cells)
    new: U64 = np.bitwise_or(np.where(mapped, NO_VOXELS, drive.new), np.where(near, beyond, NO_VOXELS))
    states[new != 0] = CellState.UNDETERMINED
    states[enough(new, rule.new_a_cell, occupied & ~gone != 0, drive.balance, rule)] = CellState.CHANGED_OCCUPIED
    return states, np.where(went | stands, gone, NO_VOXELS), new


def enough(voxels: U64, a_cell: int, others: Bool, balance: I32, rule: SurfaceRule = SURFACE_RULE) -> Bool:
    """(rows, cols) cells whose 8-connected group has enough ``voxels`` (rows, cols), ``a_cell`` more for each further
    cell, and no negative ``balance``. Two voxels on top of each other are enough for a separate small object on the
    ground (a bollard): it touches none of the ``others``, and its columns begin within 1.2 m of the ground."""
    cells = voxels != 0
    here = voxels[cells]
    near_ground = np.uint64(0b1111)
    tall = here & (here >> np.uint64(1)) != 0
    tied = widened(others, 1)[cells] | (here & near_ground == 0)
    one = np.ones(len(here), np.bool_)
    amounts = np.bitwise_count(here), one, tall, tied, balance[cells]
    size, count, talls, ties, left = over_groups(cells, *amounts)
    large = size >= np.minimum(rule.support + a_cell * (count - 1), rule.new_enough)
    out = np.zeros(cells.shape, np.bool_)
    out[cells] = (left >= 0) & (large | ((talls > 0) & (ties == 0)))
    return out


def grown(strong: Bool, weak: Bool) -> Bool:
    """(rows, cols) ``strong`` cells, and ``weak`` ones connected to them (8): hysteresis (Canny 1986).
    Few rays cross the far wall of a demolished house."""
    both = strong | weak
    out = np.zeros(both.shape, np.bool_)
    out[both] = over_groups(both, strong[both])[0] > 0
    return out


def over_groups(cells: Bool, *amounts: U8 | I32 | Bool) -> list[F64]:
    """For each of ``amounts`` (m,), of the m ``cells`` (rows, cols) row by row, its sums (m,) over the 8-connected
    group that a cell is in."""
    of_cell = groups_of(cells.astype(np.uint64), 1, *np.nonzero(cells))[cells]
    return [np.asarray(np.bincount(of_cell, amount), np.float64)[of_cell] for amount in amounts]
