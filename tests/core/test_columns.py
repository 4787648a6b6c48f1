"""Columns of neighbouring cells are compared at the same height of the world."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.columns import dilated, rebased

SIDE, ALL = 5, (1 << 64) - 1


@given(
    arrays(np.uint64, (SIDE, SIDE), elements=st.integers(0, 2**62)),
    arrays(np.int32, (SIDE, SIDE), elements=st.integers(-5, 5)),
    st.integers(1, 2),
)
@settings(max_examples=20, deadline=None)
def test_a_neighbourhood_is_the_union_over_neighbours_at_world_height(
    word: np.ndarray, base: np.ndarray, reach: int
) -> None:
    near, within = 0, slice(2 - reach, 3 + reach)
    layers = (base[within, within] - base[2, 2]).ravel().tolist()
    for one, above in zip(word[within, within].ravel().tolist(), layers, strict=True):
        near |= one << above if above >= 0 else one >> -above
    near &= ALL
    assert int(dilated(word, base, reach)[2, 2]) == (near | near << 1 | near >> 1) & ALL


def test_shifting_a_column_drops_what_leaves_it() -> None:
    words, layers = np.array([0b11, 0b11, 1, 1 << 63], np.uint64), np.array([2, -1, 64, -64], np.int32)
    assert rebased(words, layers).tolist() == [0b1100, 0b1, 0, 0]
