"""Sparse column words are the plane they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import SHAPE, at_least, words_plane
from mapvote.codec.arrays import compress, pack_plane
from mapvote.codec.sparse_columns import Words, pack_words, unpack_sparse
from mapvote.core.types import MapvoteError

CELL = (10, 10)


@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 1e-4, 0.1, 1.0]))
@settings(max_examples=15, deadline=None)
def test_packed_or_not_they_are_the_plane(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    plane = np.where(rng.random(SHAPE) < share, rng.integers(1, 2**63, SHAPE), 0).astype(np.uint64)
    inside = rng.random(SHAPE) < 0.5
    for words in (Words.of(plane), unpack_sparse(pack_words(plane), "gone")):
        assert words.words.all()
        assert np.array_equal(at_least([words], 1), plane)
        for some in (words.within(inside), words.where(Words.whole(inside))):
            assert np.array_equal(at_least([some], 1), np.where(inside, plane, np.uint64(0)))
        assert not len(words.where(Words.whole(np.zeros(SHAPE, np.bool_))).cells)


@given(words=st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=8), k=st.integers(1, 5))
@settings(deadline=None)
def test_at_least_counts_bits(words: list[int], k: int) -> None:
    expected = sum(1 << b for b in range(64) if sum(w >> b & 1 for w in words) >= k)
    assert int(at_least([Words.of(words_plane({CELL: w})) for w in words], k)[CELL]) == expected


@pytest.mark.parametrize(
    "bad",
    [
        *(pack_plane(np.zeros(size, np.uint8)) for size in (8, 11, 256 * 256 * 10 + 10)),
        b"",
        b"no zstd frame",
        pack_words(words_plane({CELL: 7}))[:-1],
        pack_words(words_plane({CELL: 7})) + b"x",
        compress(bytes([3, 0, 0, 0]) + bytes([1, 1]) + bytes(14), 1),  # a cell twice
        compress(bytes([255, 1, 255, 0]) + bytes([1, 1]) + bytes(14), 1),  # beyond the tile
        compress(bytes([3, 0]) + bytes(8), 1),  # an empty word
    ],
)
def test_words_that_no_vehicle_wrote_are_refused(bad: bytes) -> None:
    with pytest.raises(MapvoteError, match="ballot: gone"):
        unpack_sparse(bad, "gone")
