"""What a hit speaks for, against every voxel's box held beside every point."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.columns import TOP_BIT
from mapvote.core.grid import CELL_SIZE, Grid, Lattice
from mapvote.core.types import Reference
from mapvote.detection.evidence import HIT_REACH_M, _mark_near, near_hits
from mapvote.perception.frontend import Observation, PlacedScan
from mapvote.perception.raycast import ScanView, find_obstacles

SIDE = 7


def seen(points: np.ndarray, base: np.ndarray, moving: np.ndarray, occupied: np.ndarray | None = None) -> Observation:
    """A scan over a window of SIDE by SIDE cells whose columns begin at the layers ``base``; no ray is followed."""
    grid = Grid(Lattice(0.05, -0.1), 3, -4, SIDE, SIDE)
    none = np.full(grid.shape, np.inf, np.float32)
    words, counts = np.zeros(grid.shape, np.uint64), np.zeros(grid.shape, np.int32)
    ground_z = (base * CELL_SIZE).astype(np.float32)
    mapped = words if occupied is None else occupied
    reference = Reference(grid, ground_z, base, mapped, counts, none, -none, None)
    obstacle, cell = find_obstacles(points, reference)
    up = np.array([0.0, 0.0, 1.0])
    scan = PlacedScan(0, points, np.zeros(3), up, 0.02, reference, reference, obstacle, cell)
    view = ScanView(grid, counts, words, words, np.zeros((0, 0), np.uint8))
    return Observation(scan, moving, view, reference)


def by_boxes(here: Observation) -> np.ndarray:
    """(rows, cols) words: every voxel whose box, widened by the reach, holds a point that counts."""
    grid, base = here.view.grid, here.reference.base
    near, (x, y) = np.zeros(grid.shape, np.uint64), grid.centres()
    stands = here.scan.points_map[here.scan.obstacle & ~here.moving & (here.scan.cell >= 0)]
    for r, c in np.ndindex(*grid.shape):
        off_x, off_y = stands[:, 0] - x[c], stands[:, 1] - y[r]
        for z in stands[np.maximum(np.abs(off_x), np.abs(off_y)) <= CELL_SIZE / 2 + HIT_REACH_M, 2]:
            for layer in range(int(np.floor((z - HIT_REACH_M) / CELL_SIZE)), int((z + HIT_REACH_M) // CELL_SIZE) + 1):
                near[r, c] |= np.uint64(1) << np.uint64(np.clip(layer - base[r, c], 0, TOP_BIT))
    return near


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.integers(0, 40))
def test_a_hit_speaks_for_every_voxel_whose_box_it_comes_within_reach_of(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    base = rng.integers(-3, 4, (SIDE, SIDE)).astype(np.int32)
    low, high = np.array([-1.3, 0.7, -2.0]), np.array([1.1, 3.1, 24.0])
    here = seen(rng.uniform(low, high, (n, 3)), base, rng.random(n) < 0.2)
    assert np.array_equal(near_hits(here)[0], by_boxes(here))


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.integers(0, 40))
def test_a_hit_that_speaks_for_a_mapped_voxel_strikes_no_other(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    base = rng.integers(-3, 4, (SIDE, SIDE)).astype(np.int32)
    mapped = rng.integers(0, 2**63, (SIDE, SIDE), np.uint64) & rng.integers(0, 2**63, (SIDE, SIDE), np.uint64)
    points = rng.uniform([-1.3, 0.7, -2.0], [1.1, 3.1, 12.0], (n, 3))
    here = seen(points, base, rng.random(n) < 0.2, mapped)
    struck = np.zeros_like(mapped)
    for k in np.flatnonzero(here.scan.obstacle & ~here.moving & (here.scan.cell >= 0)):
        alone = seen(points[k : k + 1], base, np.array([False]), mapped)
        if not (by_boxes(alone) & mapped).any():
            row, col = divmod(int(here.scan.cell[k]), SIDE)
            layer = int(points[k, 2] // CELL_SIZE) - base[row, col]
            struck[row, col] |= np.uint64(1) << np.uint64(np.clip(layer, 0, TOP_BIT))
    assert np.array_equal(near_hits(here)[1], struck)


def test_what_moves_and_what_is_ground_speaks_for_nothing() -> None:
    flat = np.zeros((SIDE, SIDE), np.int32)
    points = np.array([[0.0, 1.9, 0.1], [0.0, 1.9, 1.0]])
    assert not any(words.any() for words in near_hits(seen(points, flat, np.array([False, True]))))


def test_no_hit_speaks_beyond_the_window() -> None:
    """Hits at all four borders of planes that lie in larger ones, which nobody may touch."""
    around, inner = np.zeros((2, SIDE + 2, SIDE + 2), np.uint64), np.s_[:, 1:-1, 1:-1]
    near, apart = around[inner]
    low, high = 0.01, SIDE * CELL_SIZE - 0.01
    points = np.array([[x, y, 1.0] for x in (low, 1.0, high) for y in (low, 1.0, high)])
    cell = (points[:, :2] // CELL_SIZE).astype(np.int32) @ np.array([1, SIDE], dtype=np.int32)
    chosen, reach = np.ones(len(points), np.bool_), HIT_REACH_M / CELL_SIZE
    mapped, base = np.zeros((SIDE, SIDE), np.uint64), np.zeros((SIDE, SIDE), np.int32)
    _mark_near(points, cell, chosen, base, mapped, (0.0, 0.0), reach, near, apart)
    assert set(cell) <= set(np.flatnonzero(near))
    assert set(cell) == set(np.flatnonzero(apart))
    around[inner] = 0
    assert not around.any()
