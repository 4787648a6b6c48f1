"""What a scan adds to the counts of each voxel, against a plain reference; what a hit speaks for, box by box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import make_map, make_tile, one_scan, wall
from mapvote.core.columns import TOP_BIT
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Grid, Lattice
from mapvote.core.point_map import PointMap
from mapvote.core.reference import reference_window
from mapvote.core.types import F64, Reference
from mapvote.detection.evidence import (
    CROSSED,
    HIT,
    HIT_REACH_M,
    PASSED,
    PASSES,
    WORDS,
    count_scan,
    free_words,
    least_passed,
    mark_near,
)
from mapvote.detection.packed_tiles import PLANES, PackedTiles, count_of
from mapvote.perception.frontend import Observation, PlacedScan
from mapvote.perception.raycast import ScanView, find_obstacles

ROWS, COLS = range(100, 104), range(100, 105)
FULL = 2**PLANES - 1


def street() -> PointMap:
    ground = wall([(r, c) for r in range(98, 107) for c in range(98, 108)], [0.0])
    mapped = wall([(101, c) for c in COLS], [0.45, 0.75, 1.05, 2.25])
    return make_map({(0, 0): make_tile(np.concatenate([mapped, ground]))})


def seen_from(point_map: PointMap, points: F64, seed: int) -> Observation:
    """A scan with these points, whose rays passed some voxels of each column, or none, and now and then hit a column
    that no ray passed."""
    seen, rng = one_scan(point_map, points), np.random.default_rng(seed)
    some = rng.integers(0, 2**63, seen.view.passed.shape, dtype=np.uint64)
    some |= rng.integers(0, 2**63, seen.view.passed.shape, dtype=np.uint64)
    seen.view.passed[:] = np.where(rng.random(some.shape) < 0.3, np.uint64(0), some)
    return seen


def near_hits(seen: Observation) -> tuple[np.ndarray, np.ndarray]:
    """(near, apart) of a scan: (rows, cols) words each."""
    here, scan, grid = seen.reference, seen.scan, seen.view.grid
    near, apart = np.zeros((2, *grid.shape), np.uint64)
    still, corner = scan.obstacle & ~seen.moving, (grid.x0, grid.y0)
    reach = HIT_REACH_M / CELL_SIZE
    mark_near(scan.points_map, scan.cell, still, here.base, here.occupied, corner, reach, near, apart)
    return near, apart


def told_of(seen: Observation, r: int, c: int, bit: int) -> tuple[bool, bool, bool, bool]:
    """(crossed, hit, passes, passed) of one voxel, by the words of detection/evidence.py."""

    def has(plane: np.ndarray, k: int = bit) -> bool:
        return bool(int(plane[r, c]) >> k & 1)

    passed, (near, apart) = seen.view.passed, near_hits(seen)
    above = bit + 1 >= TOP_BIT or has(passed, bit + 1)
    below = bit <= 1 or has(passed, bit - 1)
    crossed = has(passed) and above and below and not has(near)
    hit = has(near) if has(seen.reference.occupied) else has(apart)
    return crossed, hit, has(passed) and not has(near), has(passed)


@given(
    st.lists(st.tuples(*[st.floats(29.8, 31.6)] * 2, st.floats(0.35, 3.0)), min_size=1, max_size=5),
    st.integers(0, 1000),
)
@settings(max_examples=20, deadline=None)
def test_a_voxel_counts_what_one_scan_tells_of_it(offsets: list[tuple[float, float, float]], seed: int) -> None:
    point_map = street()
    seen = seen_from(point_map, np.array(offsets), seed)
    evidence = PackedTiles(point_map.lattice, WORDS)
    count_scan(evidence, seen)
    for r in ROWS:
        for c in COLS:
            cell = evidence[0, 0][r, c]
            for bit in range(1, TOP_BIT):
                counted = [bool(count_of(cell, first, bit)) for first in (CROSSED, HIT, PASSES)]
                assert (*counted, bool(int(cell[PASSED]) >> bit & 1)) == told_of(seen, r, c, bit)


def test_a_window_across_tiles_counts_each_cell_where_it_lies() -> None:
    point_map, window = street(), Grid(Lattice(), -5, 7, 120, 110)
    here = reference_window(point_map, window)
    seen, none = one_scan(point_map, np.zeros((0, 3))), np.zeros(window.shape, np.uint64)
    passed, ground_z = none.copy(), np.zeros(window.shape, np.float32)
    places = {(-5, 7): 4, (-1, 40): 5, (0, 20): 6, (101, 102): 7}
    for (row, col), bit in places.items():
        passed[row + 5, col - 7] = np.uint64(1 << bit)
    view = ScanView(window, none.astype(np.int32), none, passed, np.zeros((0, 0), np.uint8))
    evidence = PackedTiles(point_map.lattice, WORDS)
    count_scan(evidence, replace(seen, view=view, reference=replace(here, ground_z=ground_z)))
    for (row, col), bit in places.items():
        planes = evidence[row // TILE_CELLS, 0]
        assert planes[row % TILE_CELLS, col, PASSED] == np.uint64(1 << bit)
    assert sum(np.count_nonzero(evidence[tile][..., PASSED]) for tile in evidence) == len(places)


def test_a_cell_in_which_a_count_is_full_is_halved_as_a_whole_and_its_ratios_stay() -> None:
    point_map = street()
    evidence = PackedTiles(point_map.lattice, WORDS)
    hit = np.array([[102.5 * 0.3, 102.5 * 0.3, 1.05]])  # where nothing is mapped
    empty = np.array([[104.5 * 0.3, 104.5 * 0.3, 1.05]])
    for scan in range(FULL + 1):
        count_scan(evidence, one_scan(point_map, hit if scan % 4 == 0 else empty))
    cell = evidence[0, 0][102, 102]
    assert count_of(cell, PASSES, 10) == (FULL + 1) // 2, "128 do not fit"
    assert count_of(cell, HIT, 3) == 32 // 2
    assert count_of(cell, PASSES, 3) == 96 // 2
    assert cell[PASSED] == ~np.uint64(0), "what rays ever passed is no count"


def cell_with(bit: int, passes: tuple[int, int, int]) -> np.ndarray:
    """(WORDS,) of a cell: ``passes`` of the voxel below ``bit``, of it, of the one above."""
    cell = np.zeros(WORDS, np.uint64)
    for k in range(PLANES):
        for beside, often in zip((-1, 0, 1), passes, strict=True):
            if 0 <= bit + beside < TOP_BIT:
                cell[PASSES + k] |= np.uint64((often >> k & 1) << bit + beside)
    return cell


@given(st.integers(1, TOP_BIT - 1), st.tuples(*[st.integers(0, FULL)] * 3))
def test_rays_of_all_scans_together_cross_a_voxel_by_what_they_passed_least_of_three(
    bit: int, passes: tuple[int, int, int]
) -> None:
    below, own, above = passes
    asked = [own] + [below] * (bit > 1) + [above] * (bit + 1 < TOP_BIT)
    assert least_passed(cell_with(bit, passes), bit) == min(asked)


def test_rays_that_only_graze_a_roof_never_cross_it_whatever_their_number() -> None:
    assert least_passed(cell_with(7, (0, FULL, FULL)), 7) == 0
    assert least_passed(cell_with(7, (FULL, FULL, 0)), 7) == 0


def test_free_is_what_two_scans_passed_and_none_hit() -> None:
    planes = np.zeros((3, 1, WORDS), np.uint64)
    planes[2, 0, PASSES + 1] = 0b1110  # passed by two scans
    planes[2, 0, PASSES] = 0b10000  # by one
    planes[2, 0, HIT] = 0b0100
    assert free_words(planes).tolist() == [[0], [0], [0b1010]]


def test_cells_of_unknown_ground_gather_nothing() -> None:
    point_map = street()
    seen = one_scan(point_map, np.array([[30.7, 30.7, 1.05]]))
    unknown = replace(seen.reference, ground_z=np.full_like(seen.reference.ground_z, np.nan))
    evidence = PackedTiles(point_map.lattice, WORDS)
    count_scan(evidence, replace(seen, reference=unknown))
    assert not any(planes.any() for planes in evidence.values())


SIDE = 7


def bare_scan(
    points: np.ndarray, base: np.ndarray, moving: np.ndarray, occupied: np.ndarray | None = None
) -> Observation:
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
    here = bare_scan(rng.uniform(low, high, (n, 3)), base, rng.random(n) < 0.2)
    assert np.array_equal(near_hits(here)[0], by_boxes(here))


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.integers(0, 40))
def test_a_hit_that_speaks_for_a_mapped_voxel_strikes_no_other(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    base = rng.integers(-3, 4, (SIDE, SIDE)).astype(np.int32)
    mapped = rng.integers(0, 2**63, (SIDE, SIDE), np.uint64) & rng.integers(0, 2**63, (SIDE, SIDE), np.uint64)
    points = rng.uniform([-1.3, 0.7, -2.0], [1.1, 3.1, 12.0], (n, 3))
    here = bare_scan(points, base, rng.random(n) < 0.2, mapped)
    struck = np.zeros_like(mapped)
    for k in np.flatnonzero(here.scan.obstacle & ~here.moving & (here.scan.cell >= 0)):
        alone = bare_scan(points[k : k + 1], base, np.array([False]), mapped)
        if not (by_boxes(alone) & mapped).any():
            row, col = divmod(int(here.scan.cell[k]), SIDE)
            layer = int(points[k, 2] // CELL_SIZE) - base[row, col]
            struck[row, col] |= np.uint64(1) << np.uint64(np.clip(layer, 0, TOP_BIT))
    assert np.array_equal(near_hits(here)[1], struck)


def test_what_moves_and_what_is_ground_speaks_for_nothing() -> None:
    flat = np.zeros((SIDE, SIDE), np.int32)
    points = np.array([[0.0, 1.9, 0.1], [0.0, 1.9, 1.0]])
    assert not any(words.any() for words in near_hits(bare_scan(points, flat, np.array([False, True]))))


def test_no_hit_speaks_beyond_the_window() -> None:
    """Hits at all four borders of planes that lie in larger ones, which nobody may touch."""
    around, inner = np.zeros((2, SIDE + 2, SIDE + 2), np.uint64), np.s_[:, 1:-1, 1:-1]
    near, apart = around[inner]
    low, high = 0.01, SIDE * CELL_SIZE - 0.01
    points = np.array([[x, y, 1.0] for x in (low, 1.0, high) for y in (low, 1.0, high)])
    cell = (points[:, :2] // CELL_SIZE).astype(np.int32) @ np.array([1, SIDE], dtype=np.int32)
    chosen, reach = np.ones(len(points), np.bool_), HIT_REACH_M / CELL_SIZE
    mapped, base = np.zeros((SIDE, SIDE), np.uint64), np.zeros((SIDE, SIDE), np.int32)
    mark_near(points, cell, chosen, base, mapped, (0.0, 0.0), reach, near, apart)
    assert set(cell) <= set(np.flatnonzero(near))
    assert set(cell) == set(np.flatnonzero(apart))
    around[inner] = 0
    assert not around.any()
