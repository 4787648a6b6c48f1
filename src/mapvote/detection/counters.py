"""Evidence per voxel over the drives of a survey: in how many scans was it struck, in how many seen through.

Two counters a voxel, kept as bit planes: plane k of a cell is a 64-bit word that holds bit k of the
counts of its 64 voxels, so that one scan adds to a whole column with a few word operations. A voxel that the map
holds counts as struck if anything near it was hit (8 neighbouring cells, one layer up or down), and
then not as seen through, whatever grazed past it in the same scan; any other voxel must be hit itself.
Cells whose ground the map does not know gather nothing: heights would mean nothing there, and the map knows nothing.
"""

from __future__ import annotations

import numba
import numpy as np

from mapvote.core.columns import TOP_BIT, neighbourhood
from mapvote.core.grid import Lattice
from mapvote.core.types import F32, I32, U64, Reference
from mapvote.detection.packed_tiles import Overlap, PackedTiles
from mapvote.perception.raycast import ScanView

PLANES = 7
"""Counts up to 127 scans; a cell that would pass it is halved as a whole, which keeps its ratios."""
OPEN_SHARE = 0.1
"""A voxel is open if the voxels above and below it were seen through in more than this share of its own times."""
_THROUGH, _STRUCK = 0, PLANES
WORDS = 2 * PLANES
"""Words a cell: the two counters."""
_BESIDE = np.int64(1)
"""One cell to all sides; no literal, for which :func:`neighbourhood` would be compiled once more."""


@numba.njit(cache=True, nogil=True)
def is_full(planes: U64, first: int, word: np.uint64) -> bool:
    """Whether one of ``word``'s voxels has reached the highest count."""
    for k in range(first + PLANES - 1, first - 1, -1):
        word &= planes[k]
    return word != 0


@numba.njit(cache=True, nogil=True)
def add_one(planes: U64, first: int, word: np.uint64) -> None:
    """Add 1 to the counts of ``word``'s voxels: a ripple-carry adder over 64 voxels at once."""
    for k in range(first, first + PLANES):
        carry = planes[k] & word
        planes[k] ^= word
        word = carry
        if not word:
            break


@numba.njit(cache=True, nogil=True)
def halve(planes: U64, counters: int) -> None:
    """The counts of all ``counters`` of a cell: what is weighed against each other keeps its ratio."""
    for first in range(0, counters * PLANES, PLANES):
        for k in range(first, first + PLANES - 1):
            planes[k] = planes[k + 1]
        planes[first + PLANES - 1] = 0


@numba.njit(cache=True, nogil=True)
def count_of(planes: U64, first: int, bit: int) -> int:
    """The count of one voxel: ``first`` is 0 for seen through, PLANES for struck."""
    value = 0
    for k in range(PLANES):
        value |= int((planes[first + k] >> np.uint64(bit)) & np.uint64(1)) << k
    return value


@numba.njit(cache=True, nogil=True)
def is_open(planes: U64, bit: int) -> bool:
    """Whether rays went through a voxel from side to side, and did not only graze it along a slab.

    A roof, an awning or a ceiling is thinner than a voxel: rays that graze it pass through its voxel, but of the voxels
    above and below they reach only one. The ground bounds the lowest voxel, the end of the word the highest.
    """
    through = count_of(planes, _THROUGH, bit)
    above = count_of(planes, _THROUGH, bit + 1) if bit + 1 < TOP_BIT else through
    below = count_of(planes, _THROUGH, bit - 1) if bit > 1 else through
    return min(above, below) > OPEN_SHARE * through


@numba.njit(cache=True, nogil=True)
def _gather(
    planes: U64, part: Overlap, hit: U64, passed: U64, occupied: U64, ground_z: F32, base: I32
) -> None:  # fmt: skip
    """Add to a tile's ``planes`` the ``part`` of one scan's window that lies on it."""
    for r in range(np.uint64(part.row), np.uint64(part.end_row)):
        for c in range(np.uint64(part.col), np.uint64(part.end_col)):
            through, struck, mapped = passed[r, c] & ~hit[r, c], hit[r, c], occupied[r, c]
            if not (through | struck | mapped) or np.isnan(ground_z[r, c]):
                continue
            if mapped:
                near = neighbourhood(hit, base, np.int64(r), np.int64(c), _BESIDE) & mapped
                struck = (struck & ~mapped) | near
                through &= ~near
            if through or struck:
                cell = planes[np.uint64(np.int64(r) + part.down), np.uint64(np.int64(c) + part.right)]
                if is_full(cell, _THROUGH, through) or is_full(cell, _STRUCK, struck):
                    halve(cell, 2)
                add_one(cell, _THROUGH, through)
                add_one(cell, _STRUCK, struck)


class Evidence:
    """Counters of a drive by tile: (256, 256, WORDS) uint64, seen through first, struck after.

    Memory is bounded by the tiles around the vehicle, and some hundred kilobytes for each that it has left.
    """

    def __init__(self, lattice: Lattice) -> None:
        self.tiles = PackedTiles(lattice, WORDS)

    def count(self, view: ScanView, reference: Reference) -> None:
        """Count a scan seen against ``reference``."""
        here = reference.occupied, reference.ground_z, reference.base
        for planes, part in self.tiles.under(view.grid):
            _gather(planes, part, view.hit, view.passed, *here)
        self.tiles.leave(view.grid)


@numba.njit(cache=True, nogil=True)
def free_words(planes: U64, occupied: U64) -> U64:
    """(rows, cols) voxels that were seen through in two scans or more, never struck, and that the map does not hold."""
    out = np.zeros(occupied.shape, dtype=np.uint64)
    for r in range(occupied.shape[0]):
        for c in range(occupied.shape[1]):
            struck, often = occupied[r, c], np.uint64(0)
            for k in range(PLANES):
                struck |= planes[r, c, _STRUCK + k]
                if k > 0:
                    often |= planes[r, c, _THROUGH + k]
            out[r, c] = often & ~struck
    return out


def newly_free(planes: U64, here: Reference) -> U64:
    """:func:`free_words` of a tile, but for cells that the map knows: those need not be sent."""
    free = free_words(planes, here.occupied)
    if here.free is not None:
        free[here.free != 0] = 0
    return free
