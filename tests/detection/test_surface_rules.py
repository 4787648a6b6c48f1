"""The rules of surfaces that look beyond a cell: what is enough, and what is a thing of its own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.types import U64, Bool, CellState
from mapvote.detection.evidence import NEW_A_CELL, NEW_ENOUGH, SUPPORT, Facts, enough, judge_window

SIDE = 20
NOTHING = np.zeros((SIDE, SIDE), np.uint64)
EVEN = np.zeros((SIDE, SIDE), np.int32)
"""As often hit as passed."""


def words(*marks: tuple[int, int, int]) -> U64:
    out = NOTHING.copy()
    for row, col, word in marks:
        out[row, col] = word
    return out


def alone(voxels: U64, others: Bool | None = None) -> bool:
    """Whether all cells with ``voxels``, fewer than SUPPORT, are a thing of its own."""
    cells = voxels != 0
    found = enough(voxels, 0, np.zeros((SIDE, SIDE), np.bool_) if others is None else others, EVEN)
    assert not found[~cells].any()
    return bool(found[cells].all())


def test_two_voxels_on_the_ground_on_top_of_each_other_are_a_thing() -> None:
    assert alone(words((5, 5, 0b110)))
    assert alone(words((5, 5, 0b110), (5, 6, 0b110))), "a bollard on the border of two cells"


@pytest.mark.parametrize(
    ("voxels", "why"),
    [
        (words((5, 5, 0b10)), "one voxel alone"),
        (words((5, 5, 0b1010)), "two that do not touch"),
        (words((5, 5, 0b110000)), "in the air"),
        (words((5, 5, 0b110), (6, 6, 0b110000)), "a part of it in the air"),
        (words((5, 5, 0b10), (5, 6, 0b10)), "no taller than a kerb"),
    ],
)
def test_specks_are_no_things(voxels: U64, why: str) -> None:
    assert not alone(voxels), why


def test_what_touches_something_else_is_no_thing_of_its_own() -> None:
    others = np.zeros((SIDE, SIDE), np.bool_)
    others[7, 7] = True
    assert alone(words((5, 5, 0b110)), others=others)
    assert not alone(words((6, 6, 0b110)), others=others)


@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9), st.integers(1, 2**59)), max_size=12),
    st.sampled_from([0, NEW_A_CELL]),
)
def test_what_is_enough_is_asked_of_groups_and_not_of_cells(marks: list[tuple[int, int, int]], a_cell: int) -> None:
    voxels = words(*((2 * row, 2 * col, word << 4) for row, col, word in marks))  # no two cells touch, none the ground
    assert np.array_equal(enough(voxels, a_cell, voxels != 0, EVEN), np.bitwise_count(voxels) >= SUPPORT)


@given(st.integers(1, SIDE), st.integers(1, 8))
def test_what_is_new_needs_more_the_more_cells_it_has_and_at_most_so_much(cells: int, voxels_a_cell: int) -> None:
    voxels = words(*((5, col, (1 << voxels_a_cell) - 1 << 4) for col in range(cells)))
    needed = min(SUPPORT + NEW_A_CELL * (cells - 1), NEW_ENOUGH)
    assert enough(voxels, NEW_A_CELL, voxels != 0, EVEN)[5, 0] == (cells * voxels_a_cell >= needed)


def test_a_cell_goes_along_that_touches_what_went_if_rays_passed_half_of_it_and_nothing_stands() -> None:
    """A row of cells from a pole that went. Of the others rays passed half of what is mapped (P) or less (N); in S
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
