"""Rule C: which new hits beside mapped ones an error of pose explains."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.core.types import U8, CellState
from mapvote_lab.evaluation.columns_v1.regions import unexplained

UE, CO = CellState.UNCHANGED_EMPTY, CellState.CHANGED_OCCUPIED


def plane(*marks: tuple[slice | int, slice | int, int], side: int = 40) -> U8:
    out = np.full((side, side), UE, dtype=np.uint8)
    for rows, cols, state in marks:
        out[rows, cols] = state
    return out


@pytest.mark.parametrize(("reach", "kept"), [(1, 1), (3, 3), (6, 6)])
def test_new_hits_beside_mapped_ones_count_as_far_from_free_standing_ones_as_the_reach(reach: int, kept: int) -> None:
    states = plane((10, slice(10, 22), CO))
    beside = np.zeros(states.shape, dtype=np.bool_)
    beside[10, 11:22] = True  # only the first cell stands free
    given_up = unexplained(states, beside, reach)
    assert given_up.sum() == 11 - kept
    assert not given_up[10, : 11 + kept].any()


def test_hits_that_all_lie_beside_mapped_ones_are_given_up() -> None:
    states = plane((10, slice(10, 14), CO))
    assert unexplained(states, states == CO, 6).sum() == 4
    assert not unexplained(states, np.zeros(states.shape, dtype=np.bool_), 6).any()


@pytest.mark.parametrize(("row", "col"), [(9, 9), (9, 10), (10, 9), (11, 11), (12, 10), (8, 10), (10, 12)])
def test_the_reach_is_a_square(row: int, col: int) -> None:
    states = plane((slice(5, 16), slice(5, 16), CO))
    beside = np.ones(states.shape, dtype=np.bool_)
    beside[10, 10] = False
    assert unexplained(states, beside, 1)[row, col] == (max(abs(row - 10), abs(col - 10)) > 1)


def test_the_reach_goes_along_changed_cells_only() -> None:
    states = plane((10, 10, CO), (10, 12, CO))
    beside = np.zeros(states.shape, dtype=np.bool_)
    beside[10, 12] = True
    assert unexplained(states, beside, 6)[10, 12]
