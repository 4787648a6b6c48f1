"""Counts of each voxel over a drive, four scans at a time.

The counters of the cells around a vehicle are 6 MB, more than any cache keeps from one scan to the next. So scans wait,
and with each scan a quarter of the rows takes in the last four: their words are summed in registers, and each cell's
counters are read and written once. The counts are those of one scan after the other.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapvote.core.columns import TOP_BIT
from mapvote.core.grid import TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.kernel import inlined, kernel
from mapvote.core.types import F32, I32, U64
from mapvote.rules.packed_tiles import COUNT_PLANES, OpenTile, Overlap, PackedTiles, add_four, add_one

CROSSED, HIT, PASSES, PASSED = 0, COUNT_PLANES, 2 * COUNT_PLANES, 3 * COUNT_PLANES
"""First plane of each counter of a cell, and the last of its WORDS: voxels through which any ray ever went."""
WORDS = PASSED + 1
_LOWEST, _HIGHEST = np.uint64(0b11), np.uint64(1) << np.uint64(TOP_BIT - 1)


class ScanWords(NamedTuple):
    """Words of the voxels of one scan, (rows, cols) of its window each."""

    passed: U64
    """Rays went through the voxel."""
    near: U64
    """A return lies so near that it proves nothing of the voxel's emptiness."""
    hit: U64
    """A return lies in the voxel."""
    ground_z: F32
    """Height of the ground, map metres; NaN where it is unknown: heights mean nothing there, nothing is counted."""
    spans: I32
    """(rows, 2) of each row the first cell with rays or a hit, and the one behind the last: half of all cells lie
    between them."""


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A scan that some bands of rows have not taken in yet."""

    number: int
    words: ScanWords
    parts: dict[TileIndex, Overlap]
    """Where its window lies on each tile."""


class VoxelCounts:
    """The counters of a drive: WORDS words for each cell."""

    AT_ONCE = 4
    """Scans that are entered together, and bands of a tile's rows: :func:`_enter_scans` is written for so many."""

    def __init__(self, lattice: Lattice) -> None:
        self._tiles = PackedTiles(lattice, WORDS)
        self._waiting: deque[_Waiting] = deque()
        self._count = 0
        no_words = np.zeros((1, 1), np.uint64)
        no_ground = np.zeros((1, 1), np.float32)
        self._none = _Waiting(-1, ScanWords(no_words, no_words, no_words, no_ground, np.zeros((1, 2), np.int32)), {})
        """Takes the place of a scan where fewer than AT_ONCE are entered."""
        self._entered = [0] * self.AT_ONCE
        """How many scans each band has taken in."""
        self._row = np.zeros((3 * self.AT_ONCE + 2) * TILE_CELLS, np.uint64)
        """Scratch of :func:`_enter_scans`: the words of one row of a tile. Of each scan the voxels that rays went
        through without a return near, those of them that were crossed, those hit; of all scans the voxels that rays
        went through, and these and those hit."""

    def enter(self, view: Grid, words: ScanWords) -> None:
        """Count one scan, whose window is ``view``."""
        parts = {tile: self._tiles.overlap(tile, view) for tile in view.tiles()}
        self._waiting.append(_Waiting(self._count, words, parts))
        self._count += 1
        self._enter_band(self._count % self.AT_ONCE)
        while self._waiting and self._waiting[0].number < min(self._entered):
            self._waiting.popleft()
        self._tiles.leave(view)

    def settled(self) -> PackedTiles:
        """The counters by tile, with all scans so far."""
        for band in range(self.AT_ONCE):
            self._enter_band(band)
        self._waiting.clear()
        return self._tiles

    def _enter_band(self, band: int) -> None:
        """Enter the scans that wait into one band of rows of each tile that they lie on."""
        scans = [one for one in self._waiting if one.number >= self._entered[band]]
        scans += [self._none] * (self.AT_ONCE - len(scans))
        self._entered[band] = self._count
        words = tuple(one.words for one in scans)
        first = band * TILE_CELLS // self.AT_ONCE
        last = first + TILE_CELLS // self.AT_ONCE
        nowhere = Overlap(0, 0, 0, 0, 0, 0)
        reached = (
            tile
            for one in scans
            for tile, part in one.parts.items()
            if part.row + part.down < last and part.end_row + part.down > first
        )
        for tile in dict.fromkeys(reached):
            parts = tuple(one.parts.get(tile, nowhere) for one in scans)
            _enter_scans(self._tiles.near(tile), first, last, parts, words, self._row)


@inlined
def _take_row(words: ScanWords, part: Overlap, row: int, scan: int, out: U64) -> tuple[int, int]:
    """Enter the words of a tile's ``row`` in one of four scans, whose window lies on the tile by ``part``, into ``out``
    (see VoxelCounts). Returns the columns from and to which there are any."""
    r = row - part.down
    if r < part.row or r >= part.end_row:
        return TILE_CELLS, 0
    west = max(int(words.spans[r, 0]), part.col)
    east = min(int(words.spans[r, 1]), part.end_col)
    if west >= east:
        return TILE_CELLS, 0
    passed = words.passed[r]
    near = words.near[r]
    hits = words.hit[r]
    ground_z = words.ground_z[r]
    kind = np.uint64(TILE_CELLS)
    missed = np.uint64(3 * scan) * kind + np.uint64(west + part.right)
    crossed = missed + kind
    hit = crossed + kind
    rays = np.uint64(12) * kind + np.uint64(west + part.right)
    either = rays + kind
    none = np.uint64(0)
    for i in range(none, np.uint64(east - west)):
        j = np.uint64(west) + i
        counts = ground_z[j] == ground_z[j]
        here = passed[j] if counts else none
        struck = hits[j] if counts else none
        free = here & ~near[j]
        out[missed + i] = free
        out[crossed + i] = free & (here >> np.uint64(1) | _HIGHEST) & (here << np.uint64(1) | _LOWEST)
        out[hit + i] = struck
        out[rays + i] |= here
        out[either + i] |= here | struck
    return west + part.right, east + part.right


@kernel
def _enter_scans(
    opened: OpenTile, first: int, last: int, parts: tuple[Overlap, Overlap, Overlap, Overlap],
    scans: tuple[ScanWords, ScanWords, ScanWords, ScanWords], words: U64,
) -> None:  # fmt: skip
    """Enter four scans, the oldest first, into the rows ``first`` to ``last`` of a tile, on which their windows lie by
    ``parts``. A counter that is full is halved after the same scan as if they came one by one. ``words``: scratch that
    holds 0, and does so again afterwards, into which each row is taken by loops that vectorise."""
    planes, spans = opened
    kind = np.uint64(TILE_CELLS)
    for r in range(first, last):
        west = TILE_CELLS
        east = 0
        for k in range(4):
            begin, end = _take_row(scans[k], parts[k], r, k, words)
            west = min(west, begin)
            east = max(east, end)
        for c in range(np.uint64(west), np.uint64(max(west, east))):
            if not words[np.uint64(13) * kind + c]:
                continue
            spans[r, 0] = min(spans[r, 0], c)
            spans[r, 1] = max(spans[r, 1], c + np.uint64(1))
            cell = planes[np.uint64(r), c]
            cell[PASSED] |= words[np.uint64(12) * kind + c]
            b = c + np.uint64(3) * kind
            d = b + np.uint64(3) * kind
            e = d + np.uint64(3) * kind
            missed = words[c], words[b], words[d], words[e]
            crossed = words[c + kind], words[b + kind], words[d + kind], words[e + kind]
            hit = (
                words[c + np.uint64(2) * kind],
                words[b + np.uint64(2) * kind],
                words[d + np.uint64(2) * kind],
                words[e + np.uint64(2) * kind],
            )
            full = add_four(cell, PASSES, missed[0], missed[1], missed[2], missed[3])
            full |= add_four(cell, CROSSED, crossed[0], crossed[1], crossed[2], crossed[3])
            if hit[0] | hit[1] | hit[2] | hit[3]:
                full |= add_four(cell, HIT, hit[0], hit[1], hit[2], hit[3])
            if full:  # what was added is taken away again, as x - y = ~(~x + y), and the scans come one by one
                for k in range(PASSED):
                    cell[k] = ~cell[k]
                add_four(cell, PASSES, missed[0], missed[1], missed[2], missed[3])
                add_four(cell, CROSSED, crossed[0], crossed[1], crossed[2], crossed[3])
                add_four(cell, HIT, hit[0], hit[1], hit[2], hit[3])
                for k in range(PASSED):
                    cell[k] = ~cell[k]
                for k in range(4):
                    add_one(cell, (crossed[k], hit[k], missed[k]))
        for k in range(np.uint64(14)):
            for c in range(np.uint64(west), np.uint64(max(west, east))):
                words[k * kind + c] = np.uint64(0)
