"""Planes of a tile as they are stored."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hand_made import SHAPE
from mapvote.codec.tile_planes import pack_memory, unpack_memory_plane
from mapvote.core.tile_history import PLANES, Memory


@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 1e-4, 0.1, 1.0]))
@settings(max_examples=8, deadline=None)
def test_what_a_tile_remembers_comes_back_whether_of_few_cells_or_of_all(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    planes = np.where(rng.random((PLANES, *SHAPE)) < share, rng.integers(1, 2**32, (PLANES, *SHAPE)), 0)
    digest, packed = pack_memory(Memory.of(planes.astype(np.uint32)))
    np.testing.assert_array_equal(unpack_memory_plane(packed[digest], digest).planes, planes)
