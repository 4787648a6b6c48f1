"""Paths: what a ballot tells of the road driven."""

from __future__ import annotations

import numpy as np
import pytest

from mapvote.codec.arrays import pack_plane
from mapvote.codec.path import check_path, pack_path, unpack_path
from mapvote.core.grid import Lattice
from mapvote.core.types import MapvoteError


def test_a_kilometre_is_told_every_five_metres_in_two_hundred_bytes() -> None:
    driven = np.column_stack([np.arange(0.0, 1000.0, 1.1), np.full(910, -40.0), np.full(910, 1.9)])
    packed = pack_path(list(driven), Lattice())
    cells = unpack_path(packed)
    assert len(packed) < 200
    assert 160 <= len(cells) <= 200
    (
        rows,
        cols,
    ) = Lattice().cells_of(driven[[0, -1]])
    assert cells[[0, -1]].tolist() == np.column_stack([rows, cols]).tolist()
    assert (np.hypot(*np.diff(cells, axis=0)[:-1].T) * 0.3 >= 4.7).all()


def test_nobody_drove_far_from_where_he_voted() -> None:
    packed = pack_path([np.array([10.0, 10.0]), np.array([200.0, 10.0])], Lattice())
    check_path(packed, [(0, 0), (0, 1)])
    with pytest.raises(MapvoteError, match="tile 0,2, far from where the drive voted"):
        check_path(packed, [(0, 0)])


def test_a_path_that_is_not_whole_is_refused() -> None:
    with pytest.raises(MapvoteError, match="not a multiple of 8"):
        unpack_path(pack_plane(np.zeros(3, np.int32)))
    with pytest.raises(MapvoteError, match="larger than"):
        unpack_path(pack_plane(np.zeros((100_001, 2), np.int32)))
    with pytest.raises(MapvoteError, match="damaged"):
        unpack_path(b"no frame")
