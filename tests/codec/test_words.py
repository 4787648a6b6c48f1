"""Column words travel as those that are not zero."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.codec.arrays import compress, unpack_bytes
from mapvote.codec.words import pack_words, unpack_sparse, unpack_words
from mapvote.core.types import U64, MapvoteError


def plane_of(marked: dict[int, int]) -> U64:
    plane = np.zeros(65536, dtype=np.uint64)
    plane[list(marked)] = np.array(list(marked.values()), dtype=np.uint64)
    return plane.reshape(256, 256)


@settings(max_examples=30, deadline=None)
@given(st.dictionaries(st.integers(0, 65535), st.integers(0, 2**64 - 1), max_size=30))
def test_words_come_back_as_they_went_in(marked: dict[int, int]) -> None:
    plane = plane_of(marked)
    data = pack_words(plane)
    np.testing.assert_array_equal(unpack_words(data, "gone"), plane)
    cells, words = unpack_sparse(data, "gone")
    np.testing.assert_array_equal(cells, np.flatnonzero(plane))
    np.testing.assert_array_equal(words, plane.reshape(-1)[cells])


def test_a_full_plane_and_an_empty_one_travel_too() -> None:
    for plane in (np.full((256, 256), ~np.uint64(0)), np.zeros((256, 256), np.uint64)):
        np.testing.assert_array_equal(unpack_words(pack_words(plane), "free"), plane)
    assert len(unpack_bytes(pack_words(plane), 10, "free")) == 0


@pytest.mark.parametrize(
    "raw",
    [
        b"x" * 9,
        bytes([3, 0, 0, 0]) + bytes([1, 1]) + bytes(14),
        bytes([255, 1, 255, 0]) + bytes([1, 1]) + bytes(14),
        bytes([3, 0]) + bytes(8),
    ],
    ids=["half a cell", "a cell twice", "beyond the tile", "an empty word"],
)
def test_what_no_vehicle_wrote_is_refused(raw: bytes) -> None:
    with pytest.raises(MapvoteError, match="ballot: free is damaged"):
        unpack_sparse(compress(raw, 1), "free")
