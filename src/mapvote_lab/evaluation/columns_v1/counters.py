"""Evidence per voxel over a drive: in how many scans was it struck, in how many seen through (rules A to C).

Counted as a first map's voxels are (detection/counters.py). A voxel that the map holds counts as struck if anything
near it was hit (8 neighbouring cells, one layer up or down), and then not as seen through, whatever grazed past it in
the same scan; any other voxel must be hit itself. Two more words a cell say of its mapped voxels, whatever lies next to
them, whether a hit ever fell into them, or beside them within its own error, and whether a ray ever went through
(rule I).
"""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.columns import neighbourhood
from mapvote.core.grid import Lattice
from mapvote.core.types import F32, I32, U8, U64, Reference
from mapvote.detection.evidence import PLANES, add_one, halve, is_full
from mapvote.detection.packed_tiles import Overlap, PackedTiles
from mapvote.perception.raycast import ScanView, Sight

_THROUGH, _STRUCK = 0, PLANES
STRUCK_ITSELF, THROUGH_ITSELF = 2 * PLANES, 2 * PLANES + 1
WORDS = 2 * PLANES + 2
"""Words a cell: the two counters, and what is said of mapped voxels themselves."""
_BEHIND = int(Sight.BEHIND)


@numba.njit(cache=True, nogil=True)
def _gather(
    planes: U64, part: Overlap,
    hit: U64, passed: U64, sight: U8, occupied: U64, ground_z: F32, base: I32, reach: int, by_ray: bool, veto: bool,
    touched: U64,
) -> None:  # fmt: skip
    """Add to a tile's ``planes`` the ``part`` of one scan's window that lies on it."""
    for r in range(np.uint64(part.row), np.uint64(part.end_row)):
        for c in range(np.uint64(part.col), np.uint64(part.end_col)):
            through, struck, mapped = passed[r, c] & ~hit[r, c], hit[r, c], occupied[r, c]
            if not (through | struck | mapped) or np.isnan(ground_z[r, c]):
                continue
            if mapped:
                near = (
                    neighbourhood(hit, base, np.int64(r), np.int64(c), reach) & mapped if veto else hit[r, c] & mapped
                )
                if not by_ray and sight[r, c] >= _BEHIND and not hit[r, c]:
                    through |= mapped
                struck = (struck & ~mapped) | near
                through &= ~near
            if through or struck:
                cell = planes[np.uint64(np.int64(r) + part.down), np.uint64(np.int64(c) + part.right)]
                if mapped:
                    cell[STRUCK_ITSELF] |= (hit[r, c] | touched[r, c]) & mapped
                    if reach == 1:  # where a scan is not sure of its pose, single voxels mean nothing
                        cell[THROUGH_ITSELF] |= passed[r, c] & mapped & ~hit[r, c]
                if is_full(cell, _THROUGH, through) or is_full(cell, _STRUCK, struck):
                    halve(cell, 2)
                add_one(cell, _THROUGH, through)
                add_one(cell, _STRUCK, struck)


class ColumnEvidence:
    """Counters of a drive by tile: (256, 256, WORDS) uint64, seen through first, struck after, then the last two.

    Memory is bounded by the tiles around the vehicle, and some hundred kilobytes for each that it has left.
    """

    def __init__(self, lattice: Lattice, by_ray: bool = True, veto: bool = True) -> None:
        """``by_ray`` (rule A): a mapped voxel is seen through only by a ray through it, else wherever the cell was
        visible. ``veto`` (rule B): hits near a mapped voxel strike it, else only hits in it."""
        self.by_ray, self.veto = by_ray, veto
        self.tiles = PackedTiles(lattice, WORDS)

    def count(self, view: ScanView, reference: Reference, reach: int = 1, touched: U64 | None = None) -> None:
        """Count a scan seen against ``reference``; ``reach`` cells around a hit it may stand for (pose uncertainty).
        ``touched`` (rows, cols): voxels within a hit's own error, for rule I; else only those that were hit."""
        touched = view.hit if touched is None else touched
        for planes, part in self.tiles.under(view.grid):
            _gather(
                planes, part, view.hit, view.passed, view.sight,
                reference.occupied, reference.ground_z, reference.base, reach, self.by_ray, self.veto,
                touched,
            )  # fmt: skip
        self.tiles.leave(view.grid)


def ever(planes: U64, first: int) -> U64:
    """(rows, cols) voxels whose count, which begins at ``first``, is not 0."""
    return np.asarray(np.bitwise_or.reduce(planes[..., first : first + PLANES], axis=-1))
