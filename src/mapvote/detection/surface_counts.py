"""Evidence per voxel where a hit knows its own place: in how many scans was a voxel's surface met, in how many crossed.

A hit speaks for what lies within its own error, HIT_REACH_M, and for nothing beside that: a wall half a metre from
where one stood is another wall. A voxel that the map holds is met by a hit so near it, any other one by a hit in it;
and what was met is not crossed in the same scan, whatever grazed past. Crossed is a voxel if one scan's rays pass it
and the voxels above and below it: of a slab (roof, awning, ceiling) they reach only one of the two.

It is counted, too, in how many scans a ray passed a voxel at all, and met nothing there. Where beams lie wider apart
than voxels no scan's rays pass a voxel and those above and below it; what drove there, or was pulled down, would
otherwise never meet with anything that speaks against it.

Counts are kept as those of a survey (detection/counters.py), with a word a cell of what any ray ever passed.
"""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.columns import TOP_BIT
from mapvote.core.grid import Lattice
from mapvote.core.types import F32, U64
from mapvote.detection.counters import PLANES, add_one, count_of, halve, is_full
from mapvote.detection.near_hits import near_hits
from mapvote.detection.packed_tiles import Overlap, PackedTiles
from mapvote.perception.frontend import Observation

CROSSED, MET, PASSES = 0, PLANES, 2 * PLANES
PASSED = 3 * PLANES
WORDS = 3 * PLANES + 1
"""Words a cell: the three counters, and what any ray passed."""
_LOWEST, _HIGHEST = np.uint64(0b11), np.uint64(1) << np.uint64(TOP_BIT - 1)
"""The ground bounds the lowest voxel, the end of the word the highest."""


@numba.njit(cache=True, nogil=True)
def _gather(planes: U64, part: Overlap, apart: U64, near: U64, passed: U64, occupied: U64, ground_z: F32) -> None:
    """Add to a tile's ``planes`` the ``part`` of one scan's window that lies on it."""
    for r in range(part.row, part.end_row):
        for c in range(part.col, part.end_col):
            if np.isnan(ground_z[r, c]) or not near[r, c] | passed[r, c]:
                continue
            cell, rays, mapped = planes[r + part.down, c + part.right], passed[r, c], occupied[r, c]
            above, below = rays >> np.uint64(1) | _HIGHEST, rays << np.uint64(1) | _LOWEST
            crossed = rays & above & below & ~near[r, c]
            met = (near[r, c] & mapped) | apart[r, c]
            missed = rays & ~near[r, c]
            cell[PASSED] |= rays
            if is_full(cell, CROSSED, crossed) or is_full(cell, MET, met) or is_full(cell, PASSES, missed):
                halve(cell, 3)
            add_one(cell, CROSSED, crossed)
            add_one(cell, MET, met)
            add_one(cell, PASSES, missed)


@numba.njit(cache=True, nogil=True)
def times_crossed(cell: U64, bit: int, every: int) -> int:
    """How often a mapped voxel of a cell (WORDS,) was crossed: by single scans, or by the rays of all together.

    These pass it and the voxels above and below it one after the other; of the three that were passed least counts,
    and of its passes only one of ``every`` so many.
    """
    passes = count_of(cell, PASSES, bit)
    above = count_of(cell, PASSES, bit + 1) if bit + 1 < TOP_BIT else passes
    below = count_of(cell, PASSES, bit - 1) if bit > 1 else passes
    return max(count_of(cell, CROSSED, bit), min(passes, min(above, below)) // every)


class SurfaceEvidence:
    """Counters of a drive by tile: (256, 256, WORDS) uint64: crossed, met, passes, then what rays passed.

    Memory is bounded by the tiles around the vehicle, and some hundred kilobytes for each that it has left.
    """

    def __init__(self, lattice: Lattice) -> None:
        self.tiles = PackedTiles(lattice, WORDS)

    def count(self, seen: Observation) -> U64:
        """Count one scan; returns (rows, cols) words of voxels that it struck and nothing of the map explains."""
        view, here = seen.view, seen.reference
        near, apart = near_hits(seen)
        for planes, part in self.tiles.under(view.grid):
            _gather(planes, part, apart, near, view.passed, here.occupied, here.ground_z)
        self.tiles.leave(view.grid)
        return apart
