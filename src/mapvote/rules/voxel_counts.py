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
from mapvote.core.kernel import kernel
from mapvote.core.types import F32, U64
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
        self._none = _Waiting(-1, ScanWords(no_words, no_words, no_words, np.zeros((1, 1), np.float32)), {})
        """Takes the place of a scan where fewer than AT_ONCE are entered."""
        self._entered = [0] * self.AT_ONCE
        """How many scans each band has taken in."""

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
        for tile in dict.fromkeys(tile for one in scans for tile in one.parts):
            parts = tuple(one.parts.get(tile, Overlap(0, 0, 0, 0, 0, 0)) for one in scans)
            if any(part.row + part.down < last and part.end_row + part.down > first for part in parts):
                _enter_scans(self._tiles.near(tile), first, last, parts, words)


@kernel
def _of_scan(words: ScanWords, part: Overlap, row: int, col: int) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """(passed, missed, crossed, hit) words of a tile's cell in one scan, whose window lies on the tile by ``part``:
    voxels that rays went through, those of them without a return near, those crossed, and those hit."""
    r = row - part.down
    c = col - part.right
    none = np.uint64(0)
    if r < part.row or r >= part.end_row or c < part.col or c >= part.end_col or np.isnan(words.ground_z[r, c]):
        return none, none, none, none
    rays = words.passed[r, c]
    missed = rays & ~words.near[r, c]
    crossed = missed & (rays >> np.uint64(1) | _HIGHEST) & (rays << np.uint64(1) | _LOWEST)
    return rays, missed, crossed, words.hit[r, c]


@kernel
def _enter_scans(
    opened: OpenTile, first: int, last: int, parts: tuple[Overlap, Overlap, Overlap, Overlap],
    scans: tuple[ScanWords, ScanWords, ScanWords, ScanWords],
) -> None:  # fmt: skip
    """Enter four scans, the oldest first, into the rows ``first`` to ``last`` of a tile, on which their windows lie by
    ``parts``. A counter that is full is halved after the same scan as if they came one by one."""
    planes, spans = opened
    west = TILE_CELLS
    east = 0
    for part in parts:
        if part.end_row > part.row:
            west = min(west, part.col + part.right)
            east = max(east, part.end_col + part.right)
    for r in range(first, last):
        for c in range(west, east):
            rays_a, missed_a, crossed_a, hit_a = _of_scan(scans[0], parts[0], r, c)
            rays_b, missed_b, crossed_b, hit_b = _of_scan(scans[1], parts[1], r, c)
            rays_c, missed_c, crossed_c, hit_c = _of_scan(scans[2], parts[2], r, c)
            rays_d, missed_d, crossed_d, hit_d = _of_scan(scans[3], parts[3], r, c)
            rays = rays_a | rays_b | rays_c | rays_d
            hit = hit_a | hit_b | hit_c | hit_d
            if not rays | hit:
                continue
            spans[r, 0] = min(spans[r, 0], c)
            spans[r, 1] = max(spans[r, 1], c + 1)
            cell = planes[r, c]
            cell[PASSED] |= rays
            full = add_four(cell, PASSES, missed_a, missed_b, missed_c, missed_d)
            full |= add_four(cell, CROSSED, crossed_a, crossed_b, crossed_c, crossed_d)
            if hit:
                full |= add_four(cell, HIT, hit_a, hit_b, hit_c, hit_d)
            if full:  # what was added is taken away again, as x - y = ~(~x + y), and the scans come one by one
                for k in range(PASSED):
                    cell[k] = ~cell[k]
                add_four(cell, PASSES, missed_a, missed_b, missed_c, missed_d)
                add_four(cell, CROSSED, crossed_a, crossed_b, crossed_c, crossed_d)
                add_four(cell, HIT, hit_a, hit_b, hit_c, hit_d)
                for k in range(PASSED):
                    cell[k] = ~cell[k]
                add_one(cell, (crossed_a, hit_a, missed_a))
                add_one(cell, (crossed_b, hit_b, missed_b))
                add_one(cell, (crossed_c, hit_c, missed_c))
                add_one(cell, (crossed_d, hit_d, missed_d))
