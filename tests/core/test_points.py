"""Voxels partition a cloud; the ground follows the road and stays under walls."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapvote.core.grid import Grid, Lattice
from mapvote.core.ground import ground_surface
from mapvote.core.voxels import voxel_downsample, voxel_keys


@given(st.integers(0, 2**31), st.integers(1, 400))
def test_downsampling_keeps_one_point_of_every_voxel(seed: int, n: int) -> None:
    points = np.random.default_rng(seed).uniform(-3.0, 3.0, (n, 3))
    keys = voxel_keys(points, 0.0, 0.0)
    kept = voxel_downsample(points, 0.3)
    assert len(set(keys[kept].tolist())) == len(kept) == len(set(keys.tolist()))
    np.testing.assert_array_equal(voxel_downsample(points[kept], 0.3), np.arange(len(kept)))


def _cloud(z: np.ndarray, xy: np.ndarray) -> np.ndarray:
    return np.column_stack([xy, z])


def test_the_ground_follows_a_ramp_and_ignores_a_wall_and_an_awning() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0.0, 30.0, (40_000, 2))
    road = _cloud(0.10 * xy[:, 0], xy)
    wall = np.column_stack([np.full(4000, 15.05), rng.uniform(0, 30, 4000), 1.5 + rng.uniform(0.2, 6.0, 4000)])
    awning = _cloud(4.0 + 0 * xy[:2000, 0], np.column_stack([rng.uniform(20, 22, 2000), rng.uniform(5, 9, 2000)]))
    ground = ground_surface(np.vstack([road, wall, awning]), Grid(Lattice(), 0, 0, 100, 100))
    x = 0.3 * (np.arange(100) + 0.5)
    assert np.isfinite(ground).all()
    assert np.abs(ground - 0.10 * x[None, :]).max() < 0.06


def test_ground_far_from_any_point_is_unknown() -> None:
    patch = np.array([[0.5, 0.5, 7.0], [0.8, 0.5, 7.0], [0.5, 0.8, 7.0]])
    ground = ground_surface(patch, Grid(Lattice(), 0, 0, 100, 100), reach_m=3.0)
    assert ground[1, 1] == 7.0
    assert np.isnan(ground[50, 50])


def test_a_reflection_below_the_road_does_not_sink_the_ground() -> None:
    xy = np.random.default_rng(1).uniform(0.0, 30.0, (40_000, 2))
    reflections = np.array([[9.0, 9.0, -5.4], [10.1, 9.6, -4.6], [21.0, 3.0, -23.0]])
    ground = ground_surface(np.vstack([_cloud(0.0 * xy[:, 0], xy), reflections]), Grid(Lattice(), 0, 0, 100, 100))
    assert np.abs(ground).max() < 0.07  # one cell of grade: the cells with reflections are filled in


def test_a_cluster_of_reflections_below_the_road_does_not_sink_the_ground_either() -> None:
    """As behind a van in KITTI drive 0005: twenty points within a metre, four metres below the road."""
    rng = np.random.default_rng(2)
    xy = rng.uniform(0.0, 30.0, (40_000, 2))
    cluster = np.column_stack([rng.uniform(12.0, 13.0, (20, 2)), rng.normal(-4.0, 0.1, 20)])
    ground = ground_surface(np.vstack([_cloud(0.0 * xy[:, 0], xy), cluster]), Grid(Lattice(), 0, 0, 100, 100))
    assert np.abs(ground).max() < 0.3  # two cells of grade


def test_a_kerb_and_a_sunken_yard_stay_ground() -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform(0.0, 30.0, (60_000, 2))
    z = np.where(xy[:, 0] > 15.0, 0.15, 0.0) - 1.5 * ((xy[:, 1] > 20.0) & (xy[:, 1] < 26.0))
    ground = ground_surface(_cloud(z, xy), Grid(Lattice(), 0, 0, 100, 100))
    assert np.abs(ground[:30, :49]).max() < 0.05
    assert np.abs(ground[:30, 52:] - 0.15).max() < 0.06
    assert np.abs(ground[70:85, :49] + 1.5).max() < 0.05
