"""What fusing a tile leaves in the store."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import DTypeLike

from mapvote.codec.arrays import unpack_bytes
from mapvote.core.grid import CELLS, TILE_CELLS
from mapvote.core.types import N_STATES
from mapvote.core.voting import VOTE_UNIT
from mapvote.server.store.decisions import pack_tally, unpack_tally_plane


@pytest.mark.parametrize(
    ("dtype", "unit", "most", "width"),
    [
        (np.uint8, VOTE_UNIT, 16, 1),
        (np.uint16, VOTE_UNIT, 256, 1),
        (np.uint16, VOTE_UNIT, 257, 2),
        (np.int32, VOTE_UNIT, 256, 4),
        (np.int32, 1, 2**31, 4),
    ],
    ids=["few votes", "whole votes", "more than a byte holds", "as one-stage sums them", "large sums"],
)
def test_a_tally_comes_back_as_it_was_whatever_it_is_written_in(
    dtype: DTypeLike, unit: int, most: int, width: int
) -> None:
    rng = np.random.default_rng(1)
    planes = (rng.integers(0, most, (N_STATES, TILE_CELLS, TILE_CELLS)) * unit).astype(dtype)
    planes.flat[0] = (most - 1) * unit
    packed = pack_tally(np.moveaxis(planes, 0, -1))
    assert len(unpack_bytes(packed, 4 * N_STATES * CELLS, "tally")) == width * N_STATES * CELLS
    again = unpack_tally_plane(packed)
    assert again.dtype == np.int32
    np.testing.assert_array_equal(again, np.moveaxis(planes, 0, -1))
