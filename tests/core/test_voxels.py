"""The growing cloud is plain bookkeeping: means and counts per voxel, whatever the order of growth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mapvote.core.grid import CELL_SIZE, Lattice
from mapvote.core.types import F64
from mapvote.core.voxels import VoxelCloud, first_of_each, found_among, grouped, voxel_downsample, voxel_keys


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.2, 30), st.sampled_from([0.0, 5e5]))
def test_every_voxel_holds_the_mean_of_its_points_one_after_the_other_and_counts_its_scans(
    seed: int, spread: float, offset: float
) -> None:
    """To the last bit: what a scan has in a voxel goes on from what was in it. Skipped points leave no trace."""
    rng = np.random.default_rng(seed)
    cloud = VoxelCloud(Lattice(offset, 0.0))
    first: dict[int, F64] = {}
    moments: dict[int, F64] = {}
    count: dict[int, int] = {}
    scans: dict[int, int] = {}
    for n in (300, 0, 2000, 700):
        scan, skip = rng.normal((offset, 0.0, 0.0), spread, (n, 3)), rng.random(n) < 0.2
        cloud.enter(scan, skip)
        for key, point in zip(voxel_keys(scan[~skip], offset, 0.0).tolist(), scan[~skip], strict=True):
            origin = first.setdefault(key, point)
            moments[key] = moments.get(key, np.zeros(3)) + (point - origin)
            count[key] = count.get(key, 0) + 1
        for key in set(voxel_keys(scan[~skip], offset, 0.0).tolist()):
            scans[key] = scans.get(key, 0) + 1
    expected = np.array([first[key] + moments[key] / count[key] for key in sorted(first)])
    np.testing.assert_array_equal(cloud.points()[0], expected)
    assert cloud.points()[1].tolist() == [scans[key] for key in sorted(first)]


def test_it_grows_past_its_first_table() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-60, 60, (100_000, 3))
    cloud = VoxelCloud(Lattice())
    cloud.enter(points)
    assert len(cloud) == len(voxel_downsample(points, CELL_SIZE))
    cloud.enter(points)
    assert (cloud.points()[1] == 2).all()
    assert len(cloud) == len(cloud.points()[0]) == len(voxel_downsample(points, CELL_SIZE))


@given(st.lists(st.integers(1, 40), max_size=300))
def test_the_first_of_each_key_is_found_in_the_order_of_the_keys_coming(keys: list[int]) -> None:
    _, first = np.unique(np.array(keys, dtype=np.int64), return_index=True)
    np.testing.assert_array_equal(grouped(np.array(keys, dtype=np.int64))[1], np.sort(first))
    np.testing.assert_array_equal(first_of_each(np.array(keys, dtype=np.int64)), np.sort(first))


FEW = st.sampled_from([0.0, -0.0, 1.0, 1.5, float("nan")])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(data=st.data(), n=st.integers(0, 30), m=st.integers(0, 30))
def test_rows_are_found_as_their_bytes_are(dtype: type, data: st.DataObject, n: int, m: int) -> None:
    rows, others = (data.draw(arrays(dtype, (k, 3), elements=FEW)) for k in (n, m))
    known = {row.tobytes() for row in others}
    assert found_among(rows, others).tolist() == [row.tobytes() in known for row in rows]


def test_an_edited_cloud_is_told_from_the_one_before() -> None:
    old = np.random.default_rng(1).uniform(0, 76, (20_000, 3)).astype(np.float32)
    new = np.concatenate([old[5000:], old[:300] + np.float32(0.25)])
    assert np.flatnonzero(~found_among(old, new)).tolist() == list(range(5000))
    assert np.flatnonzero(~found_among(new, old)).tolist() == list(range(15_000, 15_300))


@given(st.integers(0, 2**31), st.integers(1, 400))
def test_downsampling_keeps_one_point_of_every_voxel(seed: int, n: int) -> None:
    points = np.random.default_rng(seed).uniform(-3.0, 3.0, (n, 3))
    keys = voxel_keys(points, 0.0, 0.0)
    kept = voxel_downsample(points, 0.3)
    assert len(set(keys[kept].tolist())) == len(kept) == len(set(keys.tolist()))
    np.testing.assert_array_equal(voxel_downsample(points[kept], 0.3), np.arange(len(kept)))
