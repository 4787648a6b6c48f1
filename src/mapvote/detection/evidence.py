"""The evidence of a drive, a vehicle's or a survey's: in how many scans each voxel was hit, crossed and passed.

A return speaks for the surfaces within its own error, HIT_REACH_M, in whichever voxel they lie, and for nothing beside
them: a wall half a metre from where one stood is another wall. In one scan

* a mapped voxel is *hit* if a return lies within HIT_REACH_M of it; any other voxel if a return lies in it that has no
  mapped voxel so near, because what the map explains is nothing new beside it;
* a voxel is *passed* if a ray goes through it and no return lies within HIT_REACH_M of it;
* a voxel is *crossed* if it is passed, and rays pass the voxels above and below it too. A ray that grazes a slab (roof,
  awning, ceiling) passes only one of the two. The ground bounds the lowest voxel, the end of the word the highest.

Each count is kept as PLANES bit planes: plane k of a cell is a 64-bit word with bit k of the counts of the cell's 64
voxels, so that one scan is added to a whole column with a few word operations. Returns of moving objects count for
nothing. Cells without known ground gather nothing: heights mean nothing there.
"""

from __future__ import annotations

import numpy as np

from mapvote.core.columns import TOP_BIT, layer_bit
from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import F32, F64, I32, U64, Bool
from mapvote.detection.packed_tiles import Overlap, PackedTiles
from mapvote.perception.frontend import Observation
from mapvote.perception.raycast import find_obstacles

HIT_REACH_M = 0.1
"""Range noise and pose sigma together, three times over."""
PLANES = 7
"""Counts up to 127 scans."""
CROSSED, HIT, PASSES = 0, PLANES, 2 * PLANES
"""First plane of each counter."""
PASSED = 3 * PLANES
"""The word of voxels that any ray ever passed."""
WORDS = 3 * PLANES + 1
"""Words of a cell."""
_LOWEST, _HIGHEST = np.uint64(0b11), np.uint64(1) << np.uint64(TOP_BIT - 1)


class Evidence:
    """Counters of a drive by tile: (256, 256, WORDS) uint64: crossed, hit, passes, then what any ray passed.

    Memory is bounded by the tiles around the vehicle, and some hundred kilobytes for each that it has left.
    """

    def __init__(self, lattice: Lattice) -> None:
        self.tiles = PackedTiles(lattice, WORDS)

    def count(self, seen: Observation) -> U64:
        """Count one scan; returns (rows, cols) words of voxels that hold a return which the map does not explain."""
        view, here = seen.view, seen.reference
        near, apart = near_hits(seen)
        for planes, part in self.tiles.under(view.grid):
            _count_scan(planes, part, apart, near, view.passed, here.occupied, here.ground_z)
        self.tiles.leave(view.grid)
        return apart


def near_hits(seen: Observation) -> tuple[U64, U64]:
    """(near, apart), (rows, cols) words each: the voxels within HIT_REACH_M of a return of a still obstacle; and those
    that hold such a return which has no mapped voxel so near."""
    here, scan, grid = seen.reference, seen.scan, seen.view.grid
    near, apart = np.zeros((2, *grid.shape), dtype=np.uint64)
    cell = scan.cell if here is scan.reference else find_obstacles(scan.points_map, here)[1]
    chosen, reach, corner = scan.obstacle & ~seen.moving, HIT_REACH_M / CELL_SIZE, (grid.x0, grid.y0)
    _mark_near(
        scan.points_map, cell, chosen, here.base.ravel(), here.occupied.ravel(), grid.shape[1], corner,
        reach, near.ravel(), apart.ravel(),
    )  # fmt: skip
    return near, apart


@kernel
def _mark_near(
    points: F64, cell: I32, chosen: Bool, base: I32, occupied: U64, cols: int, corner: tuple[float, float],
    reach: float, near: U64, apart: U64,
) -> None:  # fmt: skip
    """Enter into ``near`` the voxels that come within ``reach`` cells, along each axis, of the points, and into
    ``apart`` the voxel of each that has none of the map's so near; the planes are flat, ``cols`` wide."""
    last_row, last_col = len(base) // cols - 1, cols - 1
    for i in range(np.uint64(0), np.uint64(len(points))):
        if not chosen[i] or cell[i] < 0:
            continue
        x, y = (points[i, 0] - corner[0]) / CELL_SIZE, (points[i, 1] - corner[1]) / CELL_SIZE
        left, right = max(int(x - reach), 0), min(int(x + reach), last_col)
        first, last = cols * max(int(y - reach), 0), cols * min(int(y + reach), last_row)
        z = points[i, 2] / CELL_SIZE
        lowest, highest = int(np.floor(z - reach)), int(np.floor(z + reach))
        mapped = np.uint64(0)
        for column in (first + left, first + right, last + left, last + right):  # mostly the same one four times
            word = _column(np.uint64(column), lowest, highest, base)
            near[np.uint64(column)] |= word
            mapped |= occupied[np.uint64(column)] & word
        if not mapped:
            layer = int(np.floor(z))
            apart[np.uint64(cell[i])] |= _column(np.uint64(cell[i]), layer, layer, base)


@inlined
def _column(cell: int, lowest: int, highest: int, base: I32) -> np.uint64:
    """The word of the layers ``lowest`` to ``highest`` of the world in one column."""
    low, high = layer_bit(lowest, base[cell]), layer_bit(highest, base[cell])
    return (np.uint64(2) << np.uint64(high)) - (np.uint64(1) << np.uint64(low))


@kernel
def _count_scan(planes: U64, part: Overlap, apart: U64, near: U64, passed: U64, occupied: U64, ground_z: F32) -> None:
    """Add to a tile's ``planes`` the ``part`` of one scan's window that lies on it."""
    for r in range(part.row, part.end_row):
        for c in range(part.col, part.end_col):
            if np.isnan(ground_z[r, c]) or not near[r, c] | passed[r, c]:
                continue
            cell, rays, missed = planes[r + part.down, c + part.right], passed[r, c], passed[r, c] & ~near[r, c]
            cell[PASSED] |= rays
            crossed = missed & (rays >> np.uint64(1) | _HIGHEST) & (rays << np.uint64(1) | _LOWEST)
            full = (
                _add_one(cell, CROSSED, crossed),
                _add_one(cell, HIT, (near[r, c] & occupied[r, c]) | apart[r, c]),
                _add_one(cell, PASSES, missed),
            )
            if full[0] | full[1] | full[2]:  # halve all counts of the cell: what is weighed keeps its ratios
                for counter in range(3):
                    first = counter * PLANES
                    for k in range(first, first + PLANES - 1):
                        cell[k] = cell[k + 1]
                    cell[first + PLANES - 1] = full[counter]


@kernel
def _add_one(cell: U64, first: int, word: np.uint64) -> np.uint64:
    """Add 1 to the counts of ``word``'s voxels: a ripple-carry adder over 64 voxels at once. Returns the carry: the
    voxels whose count would exceed PLANES bits."""
    for k in range(first, first + PLANES):
        carry = cell[k] & word
        cell[k] ^= word
        word = carry
        if not word:
            break
    return word


@kernel
def count_of(cell: U64, first: int, bit: int) -> int:
    """The count of one voxel of a cell (WORDS,); ``first`` is the counter's first plane."""
    value = 0
    for k in range(PLANES):
        value |= int((cell[first + k] >> np.uint64(bit)) & np.uint64(1)) << k
    return value


@kernel
def least_passed(cell: U64, bit: int) -> int:
    """In how many scans rays passed voxel ``bit`` of a cell (WORDS,), the voxel above or the one below, whichever they
    passed least: all scans together crossed it at most so often. Its ends are bounded as in one scan."""
    least = count_of(cell, PASSES, bit)
    if bit + 1 < TOP_BIT:
        least = min(least, count_of(cell, PASSES, bit + 1))
    return min(least, count_of(cell, PASSES, bit - 1)) if bit > 1 else least


def free_words(planes: U64, occupied: U64) -> U64:
    """(rows, cols) voxels that two scans or more passed, none hit, and that the map does not hold."""
    hit = np.bitwise_or.reduce(planes[..., HIT : HIT + PLANES], axis=-1)
    often = np.bitwise_or.reduce(planes[..., PASSES + 1 : PASSES + PLANES], axis=-1)
    return np.asarray(often & ~(occupied | hit))
