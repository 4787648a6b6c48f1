"""The probability of a change: what raises it, what lowers it, and what lies beside a cell."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.types import CellState
from mapvote.fusion.probability import alike_beside, change_probability

CHANGES = [CellState.CHANGED_OCCUPIED, CellState.CHANGED_EMPTY]


def of(state: CellState, votes: int, against: int, beside: int) -> float:
    asked = np.array([votes]), np.array([against]), np.array([beside])
    return float(change_probability(np.array([state], np.uint8), *asked)[0])


@pytest.mark.parametrize("state", CHANGES)
def test_a_vote_more_and_a_cell_more_beside_it_raise_it_and_one_against_does_not(state: CellState) -> None:
    assert of(state, 2, 0, 3) < of(state, 3, 0, 3)
    assert of(state, 2, 0, 3) < of(state, 2, 0, 4)
    assert of(state, 2, 1, 3) <= of(state, 2, 0, 3)


@pytest.mark.parametrize("state", CHANGES)
def test_ten_vehicles_are_told_as_the_three_that_it_was_fitted_to(state: CellState) -> None:
    assert of(state, 10, 0, 8) == of(state, 3, 0, 8) < 1.0


@given(st.dictionaries(st.tuples(st.integers(-6, 6), st.integers(-6, 6)), st.sampled_from([2, 3]), max_size=60))
def test_cells_of_a_kind_are_counted_around_each_as_by_hand(cells: dict[tuple[int, int], int]) -> None:
    rows, cols = (np.array([cell[k] for cell in cells], np.int64) for k in (0, 1))
    counted = alike_beside(rows, cols, np.array(list(cells.values()), np.int64))
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    assert counted.tolist() == [
        sum(cells.get((r + i, c + j)) == kind for i, j in steps) for (r, c), kind in cells.items()
    ]
