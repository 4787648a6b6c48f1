"""What is put on a shelf is found again as it was, in as many blocks as it takes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapvote.detection import shelf
from mapvote.detection.shelf import Shelf


@given(st.lists(st.binary(max_size=40), max_size=20))
def test_everything_is_found_where_it_was_put(things: list[bytes]) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(shelf, "BLOCK", 32)
        full = Shelf()
        places = [full.put(thing) for thing in things]
    assert [full.read(place).tobytes() for place in places] == things


def test_a_thing_larger_than_a_block_has_one_of_its_own() -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(shelf, "BLOCK", 4)
        full = Shelf()
        first, second, third = full.put(b"abc"), full.put(b"larger than four"), full.put(b"d")
    assert [place.block for place in (first, second, third)] == [0, 1, 2]
    assert full.read(second).tobytes() == b"larger than four"
