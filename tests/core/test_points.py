"""Voxels partition a cloud."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.voxels import voxel_downsample, voxel_keys


@given(st.integers(0, 2**31), st.integers(1, 400))
def test_downsampling_keeps_one_point_of_every_voxel(seed: int, n: int) -> None:
    points = np.random.default_rng(seed).uniform(-3.0, 3.0, (n, 3))
    keys = voxel_keys(points, 0.0, 0.0)
    kept = voxel_downsample(points, 0.3)
    assert len(set(keys[kept].tolist())) == len(kept) == len(set(keys.tolist()))
    np.testing.assert_array_equal(voxel_downsample(points[kept], 0.3), np.arange(len(kept)))
