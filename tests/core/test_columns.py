"""Columns of neighbouring cells are compared at the same height of the world."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.columns import dilated, shifted

SIDE = 5


@given(
    arrays(np.uint64, (SIDE, SIDE), elements=st.integers(0, 2**62)),
    arrays(np.int32, (SIDE, SIDE), elements=st.integers(-5, 5)),
    st.integers(1, 2),
)
@settings(max_examples=20, deadline=None)
def test_a_neighbourhood_is_the_union_over_neighbours_at_world_height(
    word: np.ndarray, base: np.ndarray, reach: int
) -> None:
    out = dilated(word, base, reach)[2, 2]
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
        assert bool(int(out) >> bit & 1) == near


def test_shifting_a_column_drops_what_leaves_it() -> None:
    assert shifted(np.uint64(0b11), 2) == 0b1100
    assert shifted(np.uint64(0b11), -1) == 0b1
    assert shifted(np.uint64(1), 64) == shifted(np.uint64(1 << 63), -64) == 0
