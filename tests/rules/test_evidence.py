"""The rule of evidence: what a scan adds to the counts of each voxel, what they say of it, and what is enough."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from hand_made import make_map, make_tile, one_scan, wall
from mapvote.core.columns import TOP_BIT
from mapvote.core.geometry import rows_from
from mapvote.core.grid import CELL_SIZE, TILE_CELLS, Grid, Lattice
from mapvote.core.point_map import PointMap
from mapvote.core.reference import reference_window
from mapvote.core.types import F64, I32, U64, Bool, CellState, Reference
from mapvote.perception.frontend import Observation, PlacedScan
from mapvote.perception.placement import find_obstacles
from mapvote.perception.raycast import ScanView
from mapvote.rules.evidence import (
    SURFACE_RULE,
    Facts,
    count_scan,
    enough,
    free_words,
    judge_window,
    least_passed,
    near_hits,
    weigh_voxels,
)
from mapvote.rules.packed_tiles import COUNT_PLANES, Overlap, count_of
from mapvote.rules.voxel_counts import CROSSED, HIT, PASSED, PASSES, WORDS, VoxelCounts

ROWS, COLS = range(100, 104), range(100, 105)
FULL = 2**COUNT_PLANES - 1


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
    """(crossed, hit, passes, passed) of one voxel, by the words of rules/evidence.py."""

    def has(plane: np.ndarray, k: int = bit) -> bool:
        return bool(int(plane[r, c]) >> k & 1)

    passed, (near, hits, apart, _) = seen.view.passed, near_hits(seen)
    above = bit + 1 >= TOP_BIT or has(passed, bit + 1)
    below = bit <= 1 or has(passed, bit - 1)
    crossed = has(passed) and above and below and not has(near)
    hit = has(near) if has(seen.reference.occupied) else has(apart)
    assert hit == has(hits)
    return crossed, hit, has(passed) and not has(near), has(passed)


@given(
    st.lists(st.tuples(*[st.floats(29.8, 31.6)] * 2, st.floats(0.35, 3.0)), min_size=1, max_size=5),
    st.integers(0, 1000),
)
@settings(max_examples=20, deadline=None)
def test_the_counts_of_a_voxel_follow_from_each_scan(offsets: list[tuple[float, float, float]], seed: int) -> None:
    point_map = street()
    seen = seen_from(point_map, np.array(offsets), seed)
    counts = VoxelCounts(point_map.lattice)
    count_scan(counts, seen)
    counted = counts.settled()[0, 0]
    for r in ROWS:
        for c in COLS:
            cell = counted[r, c]
            for bit in range(1, TOP_BIT):
                often = [bool(count_of(cell, first, bit)) for first in (CROSSED, HIT, PASSES)]
                assert (*often, bool(int(cell[PASSED]) >> bit & 1)) == told_of(seen, r, c, bit)


def test_a_window_across_tiles_counts_each_cell_where_it_lies() -> None:
    point_map, window = street(), Grid(Lattice(), -5, 7, 120, 110)
    here = reference_window(point_map, window)
    seen, none = one_scan(point_map, np.zeros((0, 3))), np.zeros(window.shape, np.uint64)
    passed, ground_z = none.copy(), np.zeros(window.shape, np.float32)
    places = {(-5, 7): 4, (-1, 40): 5, (0, 20): 6, (101, 102): 7}
    for (row, col), bit in places.items():
        passed[row + 5, col - 7] = np.uint64(1 << bit)
    view = ScanView(window, none.astype(np.int32), none, passed, np.zeros((0, 0), np.uint8))
    counts = VoxelCounts(point_map.lattice)
    count_scan(counts, replace(seen, view=view, reference=replace(here, ground_z=ground_z)))
    counted = counts.settled()
    for (row, col), bit in places.items():
        planes = counted[row // TILE_CELLS, 0]
        assert planes[row % TILE_CELLS, col, PASSED] == np.uint64(1 << bit)
    assert sum(np.count_nonzero(counted[tile][..., PASSED]) for tile in counted) == len(places)


def test_a_cell_in_which_a_count_is_full_is_halved_as_a_whole_and_its_ratios_stay() -> None:
    point_map = street()
    counts = VoxelCounts(point_map.lattice)
    hit = np.array([[102.5 * 0.3, 102.5 * 0.3, 1.05]])  # where nothing is mapped
    empty = np.array([[104.5 * 0.3, 104.5 * 0.3, 1.05]])
    for scan in range(FULL + 1):
        count_scan(counts, one_scan(point_map, hit if scan % 4 == 0 else empty))
    cell = counts.settled()[0, 0][102, 102]
    assert count_of(cell, PASSES, 10) == (FULL + 1) // 2, "128 do not fit"
    assert count_of(cell, HIT, 3) == 32 // 2
    assert count_of(cell, PASSES, 3) == 96 // 2
    assert cell[PASSED] == ~np.uint64(0), "what rays ever passed is no count"


def cell_with(bit: int, passes: tuple[int, int, int]) -> np.ndarray:
    """(WORDS,) of a cell: ``passes`` of the voxel below ``bit``, of it, of the one above."""
    cell = np.zeros(WORDS, np.uint64)
    for k in range(COUNT_PLANES):
        for beside, often in zip((-1, 0, 1), passes, strict=True):
            if 0 <= bit + beside < TOP_BIT:
                cell[PASSES + k] |= np.uint64((often >> k & 1) << bit + beside)
    return cell


@given(st.integers(1, TOP_BIT - 1), st.tuples(*[st.integers(0, FULL)] * 3))
@example(1, (0, 2, 2))
@example(2, (1, 2, 2))
@example(TOP_BIT - 2, (2, 2, 1))
@example(TOP_BIT - 1, (2, 2, 0))
def test_the_joint_crossings_of_a_voxel_are_the_least_passes_of_three_voxels(
    bit: int, passes: tuple[int, int, int]
) -> None:
    below, own, above = passes
    asked = [own] + [below] * (bit > 1) + [above] * (bit + 1 < TOP_BIT)
    assert least_passed(cell_with(bit, passes), bit) == min(asked)


def test_a_voxel_is_free_if_two_scans_passed_it_and_none_hit_it() -> None:
    planes = np.zeros((3, 1, WORDS), np.uint64)
    planes[2, 0, PASSES + 1] = 0b1110  # passed by two scans
    planes[2, 0, PASSES] = 0b10000  # by one
    planes[2, 0, HIT] = 0b0100
    assert free_words(planes).tolist() == [[0], [0], [0b1010]]


def test_cells_with_unknown_ground_count_nothing() -> None:
    point_map = street()
    seen = one_scan(point_map, np.array([[30.7, 30.7, 1.05]]))
    unknown = replace(seen.reference, ground_z=np.full_like(seen.reference.ground_z, np.nan))
    counts = VoxelCounts(point_map.lattice)
    count_scan(counts, replace(seen, reference=unknown))
    assert not any(planes.any() for planes in counts.settled().values())


SIDE = 7


def bare_scan(points: np.ndarray, base: np.ndarray, moving: np.ndarray, occupied: np.ndarray) -> Observation:
    """A scan over a window of SIDE by SIDE cells whose columns begin at the layers ``base``; no ray is followed."""
    grid = Grid(Lattice(0.05, -0.1), 3, -4, SIDE, SIDE)
    none = np.full(grid.shape, np.inf, np.float32)
    words, counts = np.zeros(grid.shape, np.uint64), np.zeros(grid.shape, np.int32)
    ground_z = (base * CELL_SIZE).astype(np.float32)
    reference = Reference(grid, ground_z, base, occupied, counts, none, -none, None)
    obstacle, cell = find_obstacles(points, reference)
    up, covariance, origin = np.array([0.0, 0.0, 1.0]), 4e-4 * np.eye(3), np.zeros(3)
    scan = PlacedScan(0, rows_from(points, origin), origin, up, covariance, reference, reference, obstacle, cell)
    view = ScanView(grid, counts, words, words, np.zeros((0, 0), np.uint8))
    return Observation(scan, moving, view, reference)


def by_boxes(here: Observation) -> np.ndarray:
    """(rows, cols) words: every voxel whose box, widened by the reach, holds a point that counts."""
    grid, base = here.view.grid, here.reference.base
    near, (x, y) = np.zeros(grid.shape, np.uint64), grid.centres()
    stands = here.scan.points_map[here.scan.obstacle & ~here.moving & (here.scan.cell >= 0)]
    for r, c in np.ndindex(*grid.shape):
        off_x, off_y = stands[:, 0] - x[c], stands[:, 1] - y[r]
        reach = SURFACE_RULE.hit_reach_m
        for z in stands[np.maximum(np.abs(off_x), np.abs(off_y)) <= CELL_SIZE / 2 + reach, 2]:
            for layer in range(
                int(np.floor((z - SURFACE_RULE.hit_reach_m) / CELL_SIZE)),
                int((z + SURFACE_RULE.hit_reach_m) // CELL_SIZE) + 1,
            ):
                near[r, c] |= np.uint64(1) << np.uint64(np.clip(layer - base[r, c], 0, TOP_BIT))
    return near


@settings(max_examples=60)
@given(st.integers(0, 2**31), st.integers(0, 40))
def test_a_return_hits_every_mapped_voxel_near_it_else_the_voxel_it_lies_in(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    base = rng.integers(-3, 4, (SIDE, SIDE)).astype(np.int32)
    mapped = rng.integers(0, 2**63, (SIDE, SIDE), np.uint64) & rng.integers(0, 2**63, (SIDE, SIDE), np.uint64)
    points = rng.uniform([-1.3, 0.7, -2.0], [1.1, 3.1, rng.choice([12.0, 24.0])], (n, 3))
    here = bare_scan(points, base, rng.random(n) < 0.2, mapped)
    struck = np.zeros_like(mapped)
    for k in np.flatnonzero(here.scan.obstacle & ~here.moving & (here.scan.cell >= 0)):
        if not (by_boxes(bare_scan(points[k : k + 1], base, np.array([False]), mapped)) & mapped).any():
            row, col = divmod(int(here.scan.cell[k]), SIDE)
            layer = int(points[k, 2] // CELL_SIZE) - base[row, col]
            struck[row, col] |= np.uint64(1) << np.uint64(np.clip(layer, 0, TOP_BIT))
    near, _, apart, _ = near_hits(here)
    assert np.array_equal(near, by_boxes(here))
    assert np.array_equal(apart, struck)


WIDE = 20
NOTHING = np.zeros((WIDE, WIDE), np.uint64)
EVEN = np.zeros((WIDE, WIDE), np.int32)
"""Hits and passes are equally many."""


def words(*marks: tuple[int, int, int]) -> U64:
    out = NOTHING.copy()
    for row, col, word in marks:
        out[row, col] = word
    return out


def alone(voxels: U64, others: Bool | None = None) -> bool:
    """Whether all cells with ``voxels``, fewer than SURFACE_RULE.support, are a thing of its own."""
    cells = voxels != 0
    found = enough(voxels, 0, np.zeros((WIDE, WIDE), np.bool_) if others is None else others, EVEN)
    assert not found[~cells].any()
    return bool(found[cells].all())


@pytest.mark.parametrize(
    ("voxels", "thing", "why"),
    [
        (words((5, 5, 0b110)), True, "two on the ground, on top of each other"),
        (words((5, 5, 0b110), (5, 6, 0b110)), True, "a bollard on the border of two cells"),
        (words((5, 5, 0b10)), False, "one voxel alone"),
        (words((5, 5, 0b1010)), False, "two that do not touch"),
        (words((5, 5, 0b110000)), False, "in the air"),
        (words((5, 5, 0b110), (6, 6, 0b110000)), False, "a part of it in the air"),
        (words((5, 5, 0b10), (5, 6, 0b10)), False, "no taller than a kerb"),
    ],
)
def test_two_voxels_on_top_of_each_other_on_the_ground_are_an_object_and_specks_are_none(
    voxels: U64, thing: bool, why: str
) -> None:
    assert alone(voxels) == thing, why


def test_voxels_that_touch_another_object_are_no_object_by_themselves() -> None:
    others = np.zeros((WIDE, WIDE), np.bool_)
    others[7, 7] = True
    assert alone(words((5, 5, 0b110)), others=others)
    assert not alone(words((6, 6, 0b110)), others=others)


@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9), st.integers(1, 2**59)), max_size=12),
    st.sampled_from([0, SURFACE_RULE.new_a_cell]),
)
def test_enough_counts_the_voxels_of_groups_and_not_of_cells(marks: list[tuple[int, int, int]], a_cell: int) -> None:
    voxels = words(*((2 * row, 2 * col, word << 4) for row, col, word in marks))  # no two cells touch, none the ground
    assert np.array_equal(enough(voxels, a_cell, voxels != 0, EVEN), np.bitwise_count(voxels) >= SURFACE_RULE.support)


@given(st.integers(1, WIDE), st.integers(1, 8))
def test_a_new_object_needs_more_voxels_the_more_cells_it_has_up_to_a_bound(cells: int, voxels_a_cell: int) -> None:
    voxels = words(*((5, col, (1 << voxels_a_cell) - 1 << 4) for col in range(cells)))
    needed = min(SURFACE_RULE.support + SURFACE_RULE.new_a_cell * (cells - 1), SURFACE_RULE.new_enough)
    assert enough(voxels, SURFACE_RULE.new_a_cell, voxels != 0, EVEN)[5, 0] == (cells * voxels_a_cell >= needed)


def test_a_cell_beside_a_deleted_one_is_deleted_if_rays_passed_half_of_it_and_nothing_stands() -> None:
    """A row of cells from a pole that went. In the others rays passed half of the mapped voxels (P) or less (N); in S
    something stands."""
    row = "PPPPPNPP", "NPP", "PSPP"
    gone_along = "PPPPP", "", "P"
    for cells, along in zip(row, gone_along, strict=True):
        facts, occupied = Facts.none((1, 12)), np.zeros((1, 12), np.uint64)
        occupied[0, : len(cells) + 1] = 0b1111110000
        facts.gone[0, 0] = facts.passed[0, 0] = 0b1111110000
        for k, said in enumerate(cells, 1):
            facts.passed[0, k] = 0b110001111 if said == "N" else 0b111000000
            facts.stands[0, k] = 0b10000 * (said == "S")
        rise_m = np.where(occupied != 0, np.float32(3.0), np.float32(np.nan))
        states = judge_window(facts, occupied, rise_m, 0.5)[0]
        assert np.flatnonzero(states == CellState.CHANGED_EMPTY).tolist() == list(range(len(along) + 1))


def weighed(mapped: int, free: int, **counts: int) -> Facts:
    """Facts of one cell whose voxel 5 has these counts; the voxels above and below it have the same ``passes``."""
    planes, bit = np.zeros((1, 1, WORDS), np.uint64), 5
    for first, name, word in ((CROSSED, "crossed", 0b010), (HIT, "met", 0b010), (PASSES, "passes", 0b111)):
        for k in range(COUNT_PLANES):
            planes[0, 0, first + k] = np.uint64((counts.get(name, 0) >> k & 1) * word << bit - 1)
    occupied, known_free = (np.full((1, 1), word << bit, np.uint64) for word in (mapped, free))
    out = Facts.none((1, 1))
    weigh_voxels(planes, Overlap(0, 1, 0, 1, 0, 0), occupied, known_free, out)
    return out


@given(crossed=st.integers(0, 120), passes=st.integers(0, 120), met=st.integers(0, 20))
def test_a_voxel_is_gone_if_its_crossings_outweigh_its_hits(crossed: int, passes: int, met: int) -> None:
    facts = weighed(1, 0, crossed=crossed, passes=passes, met=met)
    assert (facts.gone[0, 0] != 0) == (
        max(crossed, passes // SURFACE_RULE.together) >= SURFACE_RULE.gone_rays + SURFACE_RULE.hit_rays * met
    )
    assert (facts.stands[0, 0] != 0) == (met > 0 and facts.gone[0, 0] == 0)
    assert not (facts.new | facts.beyond).any()


@given(crossed=st.integers(0, 120), met=st.integers(0, 60), passes=st.integers(0, 127))
@example(crossed=0, met=1, passes=0)
def test_a_free_voxel_is_new_if_its_hits_outweigh_its_crossings(crossed: int, met: int, passes: int) -> None:
    facts = weighed(0, 1, crossed=crossed, met=met, passes=passes)
    new = facts.new[0, 0] != 0
    assert new == (met >= 1 + SURFACE_RULE.new_rays * crossed)
    assert [facts.hits[0, 0], facts.balance[0, 0]] == ([met, met - passes] if new else [0, 0])
    assert not (facts.gone | facts.stands | facts.beyond).any()


@given(
    cells=arrays(np.bool_, (6, 6)),
    met=arrays(np.int32, (6, 6), elements=st.integers(0, 50)),
    passes=arrays(np.int32, (6, 6), elements=st.integers(0, 50)),
)
def test_a_group_passed_more_often_than_hit_is_not_new(cells: Bool, met: I32, passes: I32) -> None:
    ground = np.zeros(cells.shape, np.uint64)
    pole = np.where(cells, np.uint64(2 * (1 << SURFACE_RULE.new_enough) - 2), np.uint64(0))
    facts = Facts.none(cells.shape)._replace(new=pole, balance=np.where(cells, met - passes, 0))
    came = judge_window(facts, ground, np.full(cells.shape, np.nan, np.float32), 0.5)[0] == CellState.CHANGED_OCCUPIED
    groups, count = ndimage.label(cells, np.ones((3, 3)))
    for k in range(1, count + 1):
        group = groups == k
        assert came[group].all() if met[group].sum() >= passes[group].sum() else not came[group].any()
    assert not came[~cells].any()
