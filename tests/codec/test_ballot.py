"""New points and their intensity in ballots."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import Say, make_ballot, states_plane, two_walls, unpack_all, wall
from mapvote.codec.arrays import pack_plane
from mapvote.codec.ballot import decode, encode, pack_points, unpack_offer, unpack_points
from mapvote.core.types import MapvoteError

POINTS = unpack_points(pack_points(wall([(3, 3)], [0.5, 0.8, 1.1])))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 255), max_size=64))
def test_intensity_comes_back_beside_its_points(values: list[int]) -> None:
    points = np.repeat(POINTS[:1], len(values), axis=0)
    bright = np.array(values, dtype=np.uint8)
    sent = make_ballot(two_walls(), {(0, 0): Say(states_plane(), new_points=points)})
    tile = msgspec.structs.replace(sent.tiles[0], intensity=pack_plane(bright))
    got = decode(encode(msgspec.structs.replace(sent, tiles=[tile])))
    unpack_all(got)
    back, intensity = unpack_offer(got.tiles[0].new_points, got.tiles[0].intensity)
    assert back is not None
    assert intensity is not None
    assert back.tobytes() == points.tobytes()
    assert intensity.tolist() == values


def test_a_ballot_without_intensity_has_none_and_every_point_must_have_one() -> None:
    points = pack_points(POINTS)
    assert unpack_offer(points, None)[1] is None
    with pytest.raises(MapvoteError, match="2 bytes, expected 3"):
        unpack_offer(points, pack_plane(np.zeros(2, np.uint8)))
    with pytest.raises(MapvoteError, match="none of those"):
        unpack_offer(None, pack_plane(np.zeros(2, np.uint8)))
