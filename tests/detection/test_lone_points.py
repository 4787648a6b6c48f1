"""Points that touch no other are no change of their own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.types import I32, NO_VOTE, U64, CellState
from mapvote.detection.surface_rules import FIRM_BESIDE, lone_cells, no_change

CE = CellState.CHANGED_EMPTY


@given(
    words=arrays(np.uint64, (3, 4), elements=st.integers(0, 2**6 - 1)),
    base=arrays(np.int32, (3, 4), elements=st.integers(-2, 2)),
)
def test_a_cell_is_lone_if_no_voxel_of_it_touches_another_on_whatever_ground(words: U64, base: I32) -> None:
    voxels = {(r, c, b + int(base[r, c])) for (r, c), w in np.ndenumerate(words) for b in range(6) if int(w) >> b & 1}

    def touches(r: int, c: int, z: int) -> bool:
        around = {(r + i, c + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)}
        return len(around & voxels) > 1

    expected = [
        [
            any(v[:2] == (r, c) for v in voxels) and not any(touches(*v) for v in voxels if v[:2] == (r, c))
            for c in range(4)
        ]
        for r in range(3)
    ]
    np.testing.assert_array_equal(lone_cells(words << np.uint64(10), base), expected)


@pytest.mark.parametrize("beside", range(9))
def test_a_lone_cell_goes_with_three_of_the_eight_around_it_or_not_at_all(beside: int) -> None:
    states = np.full((3, 3), NO_VOTE, np.uint8)
    states.ravel()[[0, 1, 2, 3, 5, 6, 7, 8][:beside]] = CE
    states[1, 1] = CE
    lone = np.zeros((3, 3), np.bool_)
    assert not no_change(states, lone).any()
    lone[1, 1] = True
    assert no_change(states, lone)[1, 1] == (beside < FIRM_BESIDE)
    assert no_change(states, lone).sum() == (beside < FIRM_BESIDE)
