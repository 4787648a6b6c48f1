"""What drove through the survey leaves no trail in the map, and what stands stays, however low it is."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.types import F64, I64
from mapvote.slam.clean_map import TALL_M, trails

LATTICE = Lattice()


def row_of(n: int, row: int, height_m: float = 1.0) -> F64:
    """(n, 3) a point in each of ``n`` cells in a row."""
    x = (np.arange(n) + 0.5) * CELL_SIZE
    return np.column_stack([x, np.full(n, (row + 0.5) * CELL_SIZE), np.full(n, height_m)])


def test_a_low_row_that_rays_passed_more_often_than_they_met_it_is_a_trail() -> None:
    points = np.concatenate([row_of(9, 0), row_of(9, 5)])
    balance = np.repeat(np.array([-3, 4]), 9)
    assert trails(points, balance, points[:, 2], LATTICE).tolist() == [True] * 9 + [False] * 9


def test_a_thing_is_judged_as_a_whole_and_keeps_the_edges_that_rays_pass() -> None:
    points = row_of(9, 0)
    edges = np.array([-5, 4, 4, 4, 4, 4, 4, 4, -9])
    assert not trails(points, edges, points[:, 2], LATTICE).any()
    assert trails(points, edges - 2, points[:, 2], LATTICE).all(), "it is passed once more often than met"


def test_what_rises_above_a_lorry_did_not_drive_and_nor_did_what_nobody_knows_the_height_of() -> None:
    points, passed = row_of(3, 0), np.full(3, -5)
    assert trails(points, passed, np.array([1.0, TALL_M, np.nan]), LATTICE).tolist() == [True, False, False]
    column = np.array([[0.1, 0.1, 1.0], [0.1, 0.1, 5.0]])
    assert not trails(column, np.full(2, -5), column[:, 2], LATTICE).any(), "one cell, and it rises to five metres"


def test_a_map_without_a_point_has_no_trail() -> None:
    assert trails(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0), LATTICE).shape == (0,)


@given(st.lists(st.tuples(st.integers(0, 12), st.integers(0, 12), st.integers(-9, 9)), min_size=1, max_size=40))
def test_in_whichever_order_points_come_they_are_judged_alike_and_met_ones_stay(
    cells: list[tuple[int, int, int]],
) -> None:
    points = np.array([[(c + 0.5) * CELL_SIZE, (r + 0.5) * CELL_SIZE, 1.0] for r, c, _ in cells])
    balance: I64 = np.array([b for _, _, b in cells])
    found = trails(points, balance, points[:, 2], LATTICE)
    turned = trails(points[::-1].copy(), balance[::-1].copy(), points[:, 2], LATTICE)
    np.testing.assert_array_equal(found, turned[::-1])
    assert not trails(points, np.abs(balance), points[:, 2], LATTICE).any()


def by_hand(cells: dict[tuple[int, int], int]) -> set[tuple[int, int]]:
    """The cells whose 8-connected group has a sum below zero."""
    left, out = set(cells), set()
    while left:
        group, ring = set(), {left.pop()}
        while ring:
            group |= ring
            ring = {(r + i, c + k) for r, c in ring for i in (-1, 0, 1) for k in (-1, 0, 1)} & left
            left -= ring
        out |= group if sum(cells[cell] for cell in group) < 0 else set()
    return out


@given(
    st.dictionaries(st.tuples(st.integers(-300, -290), st.integers(-6, 6)), st.integers(-9, 9), min_size=1, max_size=50)
)
def test_trails_are_the_groups_of_cells_that_touch_and_were_passed_more_often_on_either_side_of_the_origin(
    cells: dict[tuple[int, int], int],
) -> None:
    points = np.array([[(c + 0.5) * CELL_SIZE, (r + 0.5) * CELL_SIZE, 1.0] for r, c in cells])
    balance: I64 = np.array(list(cells.values()))
    found = trails(points, balance, points[:, 2], LATTICE)
    assert {cell for cell, is_trail in zip(cells, found, strict=True) if is_trail} == by_hand(cells)
