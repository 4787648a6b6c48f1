"""What a scan adds to the evidence of each voxel: hit, passed, held against a reference bit by bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import make_map, make_tile, one_scan, wall
from mapvote.core.columns import TOP_BIT
from mapvote.core.grid import TILE_CELLS, Grid, Lattice
from mapvote.core.point_map import PointMap
from mapvote.core.reference import reference_window
from mapvote.core.types import F64
from mapvote.detection.evidence import (
    CROSSED,
    HIT,
    PASSED,
    PASSES,
    WORDS,
    count_scan,
    free_words,
    least_passed,
    near_hits,
)
from mapvote.detection.packed_tiles import PLANES, PackedTiles, count_of
from mapvote.perception.frontend import Observation
from mapvote.perception.raycast import ScanView

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
