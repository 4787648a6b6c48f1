"""Scans that are entered four at a time count as if they came one after the other."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.grid import TILE_CELLS, Grid, Lattice, TileIndex
from mapvote.core.types import U64
from mapvote.rules.packed_tiles import add_one
from mapvote.rules.voxel_counts import HIT, PASSED, PASSES, WORDS, ScanWords, VoxelCounts

LATTICE = Lattice()
SIDE = 5


def scan_words(rng: np.random.Generator) -> ScanWords:
    passed, near, hit = rng.integers(0, 2**63, (3, SIDE, SIDE), dtype=np.uint64)
    ground_z = np.where(rng.random((SIDE, SIDE)) < 0.2, np.nan, 0.0).astype(np.float32)
    west, east = rng.integers(0, SIDE, SIDE), rng.integers(0, SIDE, SIDE) + 1
    for words in (passed, hit):
        words[(np.arange(SIDE) < west[:, None]) | (np.arange(SIDE) >= east[:, None])] = 0
    return ScanWords(passed, near, hit, ground_z, np.column_stack([west, east]).astype(np.int32))


def count_one_by_one(cells: dict[tuple[int, int], U64], view: Grid, words: ScanWords) -> None:
    """The counts by cell of the lattice, each scan by itself."""
    for r in range(SIDE):
        for c in range(SIDE):
            if not np.isnan(words.ground_z[r, c]):
                cell = cells.setdefault((view.row0 + r, view.col0 + c), np.zeros(WORDS, np.uint64))
                rays = int(words.passed[r, c])
                missed = rays & ~int(words.near[r, c])
                crossed = missed & (rays >> 1 | 1 << 62) & (rays << 1 | 0b11)
                add_one(cell, (np.uint64(crossed), words.hit[r, c], np.uint64(missed)))
                cell[PASSED] |= np.uint64(rays)


def cells_of(tiles: dict[TileIndex, U64]) -> dict[tuple[int, int], list[int]]:
    found = {}
    for (row, col), planes in tiles.items():
        for r, c in np.argwhere(planes.any(axis=2)):
            found[row * TILE_CELLS + int(r), col * TILE_CELLS + int(c)] = planes[r, c].tolist()
    return found


@given(
    st.lists(st.tuples(st.integers(60, 66), st.integers(-3, 2)), max_size=11),
    st.sets(st.integers(0, 10), max_size=2),
    st.integers(0, 1000),
)
@settings(max_examples=25, deadline=None)
def test_scans_of_moving_windows_count_as_one_by_one(
    corners: list[tuple[int, int]], read_after: set[int], seed: int
) -> None:
    """The windows lie across two tiles and two bands; reading now and then changes nothing."""
    rng, counts, expected = np.random.default_rng(seed), VoxelCounts(LATTICE), dict[tuple[int, int], U64]()
    for i, (row, col) in enumerate(corners):
        view, words = Grid(LATTICE, row, col, SIDE, SIDE), scan_words(rng)
        counts.enter(view, words)
        count_one_by_one(expected, view, words)
        if i in read_after:
            counts.settled()
    assert cells_of(dict(counts.settled())) == {at: cell.tolist() for at, cell in expected.items() if cell.any()}


@pytest.mark.parametrize("first", [HIT, PASSES])
def test_a_counter_that_fills_up_is_halved_after_the_same_scan(first: int) -> None:
    rng, counts, expected = np.random.default_rng(first), VoxelCounts(LATTICE), dict[tuple[int, int], U64]()
    full = np.zeros((SIDE, SIDE, WORDS), np.uint64)
    full[..., first : first + 7] = rng.integers(0, 2**63, (SIDE, SIDE, 1), dtype=np.uint64)
    full[..., first] = 0  # 126 in these voxels
    view = Grid(LATTICE, 0, 0, SIDE, SIDE)
    counts.settled().near((0, 0)).planes[:SIDE, :SIDE] = full
    expected.update({(r, c): full[r, c].copy() for r in range(SIDE) for c in range(SIDE)})
    for _ in range(7):
        words = scan_words(rng)
        counts.enter(view, words)
        count_one_by_one(expected, view, words)
    assert cells_of(dict(counts.settled())) == {at: cell.tolist() for at, cell in expected.items()}
