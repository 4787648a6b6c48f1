"""Counters in bit planes against plain counting, and what strikes or clears a mapped voxel."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.columns import dilated, neighbourhood, shifted
from mapvote.core.grid import Lattice
from mapvote.detection.evidence import PLANES, Evidence, count_of, free_words
from small_window import AT, GRID, NOTHING, SIDE, middle, reference_of, view_of, words


@given(st.lists(st.tuples(words, words), min_size=1, max_size=12))
@settings(max_examples=30, deadline=None)
def test_bit_planes_count_like_plain_counters(scans: list[tuple[np.ndarray, np.ndarray]]) -> None:
    evidence = Evidence(Lattice())
    through = np.zeros((SIDE, SIDE, 64), int)
    struck = np.zeros((SIDE, SIDE, 64), int)
    bits = np.arange(64, dtype=np.uint64)
    for hit, passed in scans:
        evidence.count(view_of(hit, passed), reference_of(NOTHING))
        is_hit = (hit[..., None] >> bits) & np.uint64(1) == 1
        struck += is_hit
        through += ((passed[..., None] >> bits) & np.uint64(1) == 1) & ~is_hit
    planes = evidence.tiles[(0, 0)]
    for r, c, bit in np.argwhere(through + struck >= 0)[:: 7 * SIDE]:
        cell = planes[10 + r, 10 + c]
        assert count_of(cell, 0, bit) == through[r, c, bit]
        assert count_of(cell, PLANES, bit) == struck[r, c, bit]


def test_a_full_counter_is_halved_with_its_cell_and_keeps_the_ratio() -> None:
    evidence = Evidence(Lattice())
    for i in range(400):
        evidence.count(view_of(middle(0b10 if i % 4 == 0 else 0), middle(0b10)), reference_of(NOTHING))
    cell = evidence.tiles[(0, 0)][AT]
    through, struck = count_of(cell, 0, 1), count_of(cell, PLANES, 1)
    assert 60 < through < 128
    assert abs(through / struck - 3.0) < 0.2


def test_a_hit_next_to_a_mapped_voxel_strikes_it_and_vetoes_the_rays_that_grazed_past() -> None:
    hit = NOTHING.copy()
    hit[3, 3] = 0b1000  # one cell and one layer off
    evidence = Evidence(Lattice())
    evidence.count(view_of(hit, middle(0b100)), reference_of(middle(0b100)))
    cell = evidence.tiles[(0, 0)][AT]
    assert (count_of(cell, 0, 2), count_of(cell, PLANES, 2)) == (0, 1)


def test_a_hit_two_cells_away_from_a_mapped_voxel_does_not_strike_it() -> None:
    hit = NOTHING.copy()
    hit[2, 4] = 0b100
    evidence = Evidence(Lattice())
    evidence.count(view_of(hit, middle(0b100)), reference_of(middle(0b100)))
    cell = evidence.tiles[(0, 0)][AT]
    assert (count_of(cell, 0, 2), count_of(cell, PLANES, 2)) == (1, 0)


def test_on_a_slope_neighbouring_columns_are_compared_at_the_same_height() -> None:
    ground = np.zeros(GRID.shape)
    ground[:, 3:] = 0.9  # three layers up
    hit = NOTHING.copy()
    hit[2, 3] = 0b1  # 0.9 m to 1.2 m: bit 3 of the middle column
    evidence = Evidence(Lattice())
    evidence.count(view_of(hit, middle(0)), reference_of(middle(0b1000), ground))
    assert count_of(evidence.tiles[(0, 0)][AT], PLANES, 3) == 1


def test_cells_of_unknown_ground_gather_nothing() -> None:
    ground = np.full(GRID.shape, np.nan)
    evidence = Evidence(Lattice())
    evidence.count(view_of(middle(1), middle(2)), reference_of(NOTHING, ground))
    assert not evidence.tiles[(0, 0)].any()


def test_free_is_what_was_seen_through_twice_never_struck_and_not_mapped() -> None:
    evidence = Evidence(Lattice())
    for hit, passed in ((0, 0b1110), (0, 0b0110), (0b0100, 0b0010)):
        evidence.count(view_of(middle(hit), middle(passed)), reference_of(NOTHING))
    assert free_words(evidence.tiles[(0, 0)], np.zeros((256, 256), np.uint64))[AT] == 0b0010
    occupied = np.full((256, 256), 0b0010, np.uint64)
    assert free_words(evidence.tiles[(0, 0)], occupied)[AT] == 0


@given(words, arrays(np.int32, (SIDE, SIDE), elements=st.integers(-5, 5)), st.integers(1, 2))
@settings(max_examples=20, deadline=None)
def test_dilation_is_the_union_over_neighbours_at_world_height(word: np.ndarray, base: np.ndarray, reach: int) -> None:
    out = dilated(word, base, reach)
    occupied = {
        (r, c, int(base[r, c]) + bit)
        for r, c in np.ndindex(SIDE, SIDE)
        for bit in range(64)
        if int(word[r, c]) >> bit & 1
    }
    for bit in range(64):
        near = any(
            (2 + i, 2 + j, int(base[2, 2]) + bit + k) in occupied and 0 <= bit + k < 64
            for i in range(-reach, reach + 1)
            for j in range(-reach, reach + 1)
            for k in (-1, 0, 1)
        )
        assert bool(int(out[2, 2]) >> bit & 1) == near
    assert neighbourhood(word, base, 2, 2, reach) == out[2, 2]


def test_shifting_a_column_drops_what_leaves_it() -> None:
    assert shifted(np.uint64(0b11), 2) == 0b1100
    assert shifted(np.uint64(0b11), -1) == 0b1
    assert shifted(np.uint64(1), 64) == shifted(np.uint64(1 << 63), -64) == 0


def test_free_words_are_told_of_windows_of_any_shape() -> None:
    planes = np.zeros((3, 1, 2 * PLANES), np.uint64)
    planes[2, 0, 1] = 1 << 5  # seen through twice
    assert free_words(planes, np.zeros((3, 1), np.uint64)).tolist() == [[0], [0], [1 << 5]]
