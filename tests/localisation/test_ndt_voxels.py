"""The map side of NDT: every voxel's distribution is that of its points, however and whenever they came."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.types import F64
from mapvote.localisation.ndt import Level, NdtGrid

SIZE, FLOOR_M = 2.0, 0.1
MIDDLE = np.array([3.0, -3.0, 1.0])
"""Of the voxel in which a cloud lies."""


def grid(size: float = SIZE, half_m: float = 10.0) -> NdtGrid:
    made = NdtGrid(Level(size, FLOOR_M, points_m=0.1, iterations=1), half_m)
    made.recentre(np.zeros(3))
    return made


def precision(of: NdtGrid, row: int) -> F64:
    c = of.voxels.cells[row, 3:]
    return np.array([[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]])


def row_at(of: NdtGrid, point: F64) -> int:
    i, j, k = np.floor(point / SIZE).astype(int) - of.window.lowest
    return int(of.window.rows[i, j, k])


def cloud(seed: int, n: int = 300) -> F64:
    """A slanted ellipsoid in the voxel from (2, -4, 0), too thick to count as flat."""
    rng = np.random.default_rng(seed)
    shape = rng.uniform(-0.1, 0.1, (3, 3)) + np.diag([0.15, 0.15, 0.3])
    return np.asarray(np.clip(rng.normal(0, 1, (n, 3)) @ shape.T, -0.99, 0.99) + MIDDLE)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_voxel_has_the_mean_of_its_points_and_the_inverse_of_their_widened_covariance(seed: int) -> None:
    """Less the precision of an even filling (less two deviations of its sample variance), but never below none."""
    points = cloud(seed)
    made = grid()
    made.enter(points)
    row = row_at(made, points[0])
    assert made.n == 1
    assert made.voxels.place[row].tolist() == [1, -2, 0]
    np.testing.assert_allclose(made.voxels.cells[row, :3], points.mean(axis=0) - MIDDLE, atol=1e-12)
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True))
    even = 1.0 / (SIZE**2 / 12.0 * (1.0 - 2.0 * np.sqrt(0.8 / len(points))) + FLOOR_M**2)
    weights = np.maximum(0.0, 1.0 / (values + FLOOR_M**2) - even)
    np.testing.assert_allclose(precision(made, row), vectors @ np.diag(weights) @ vectors.T, atol=1e-6)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_points_that_come_in_pieces_make_the_same_map(seed: int, pieces: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-8.0, 8.0, (400, 3))
    at_once, bit_by_bit = grid(), grid()
    at_once.enter(points)
    for piece in np.array_split(points, pieces):
        bit_by_bit.enter(piece)
    assert at_once.n == bit_by_bit.n == len({tuple(v) for v in np.floor(points / SIZE).astype(int).tolist()})
    np.testing.assert_array_equal(at_once.window.rows, bit_by_bit.window.rows)
    np.testing.assert_allclose(at_once.voxels.cells[: at_once.n], bit_by_bit.voxels.cells[: at_once.n], atol=1e-9)


def test_too_few_points_make_no_distribution_and_more_do() -> None:
    """Less two deviations of its sample variance, an even filling by three points is as sharp as any."""
    made = grid()
    points = np.array([[2.5, -3.0, 1.0], [2.6, -3.1, 1.5], [2.5, -3.1, 0.5], [2.6, -3.0, 0.2]])
    for n, told in ((1, False), (2, False), (3, False), (4, True)):
        made.enter(points[n - 1 : n])
        assert made.voxels.cells[0, 3:].any() == told


def test_a_flat_patch_knows_its_height_and_nothing_else() -> None:
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(0.1, 1.9, (500, 2)), rng.normal(1.0, 0.01, 500)])
    made = grid()
    made.enter(points)
    found = precision(made, 0)
    assert found[2, 2] > 50.0
    assert np.abs(found - np.diag(np.diag(found))).max() < 1.0
    assert found[:2, :2].max() < 0.5


def test_a_single_ring_on_the_road_is_no_wall() -> None:
    """A line is thin to all sides: taken at face value it would hold the next scan's ring where this one was."""
    rng = np.random.default_rng(3)
    along = rng.uniform(0.1, 1.9, 200)
    points = np.column_stack([along, 0.3 * along + 0.6, np.full(200, 1.0)]) + rng.normal(0, 0.005, (200, 3))
    made = grid()
    made.enter(points)
    found = precision(made, 0)
    assert found[2, 2] > 50.0
    assert found[:2, :2].max() < 0.5


def test_a_wall_knows_across_and_not_along() -> None:
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(0.1, 1.9, 500), rng.normal(1.0, 0.01, 500), rng.uniform(0.1, 1.9, 500)])
    made = grid()
    made.enter(points)
    found = precision(made, 0)
    assert found[1, 1] > 50.0
    assert max(found[0, 0], found[2, 2]) < 0.5


def test_points_outside_the_window_are_left_out_and_found_again_when_it_has_moved() -> None:
    made = grid()
    near, far = cloud(5), cloud(6) + np.array([14.0, 0.0, 0.0])
    made.enter(np.concatenate([near, far]))
    assert made.n == 1
    made.recentre(np.array([20.0, 0.0, 0.0]))
    assert (made.window.rows >= 0).sum() == 0, "what was entered before lies outside now"
    made.enter(far)
    assert row_at(made, far[0]) == 1
    made.recentre(np.zeros(3))
    assert row_at(made, near[0]) == 0
    before = made.voxels.cells[0].copy()
    made.recentre(np.array([10.0, 0.0, 0.0]))
    assert {row_at(made, near[0]), row_at(made, far[0])} == {0, 1}
    np.testing.assert_array_equal(made.voxels.cells[0], before)


@pytest.mark.parametrize("voxels", [1023, 1024, 1025, 2500])
def test_there_is_room_for_any_number_of_voxels(voxels: int) -> None:
    made = grid(size=0.5, half_m=20.0)
    index = np.arange(voxels)
    points = np.column_stack([index % 60, index // 60, 0 * index]) * 0.5 + np.array([-14.75, -14.75, 0.25])
    made.enter(np.repeat(points, 2, axis=0))
    assert made.n == voxels
    assert (made.window.rows >= 0).sum() == voxels
    assert (made.voxels.sums[:voxels, 0] == 2.0).all()
    assert len(made.voxels.place) <= max(2 * voxels, 1024), "rows are made for voxels, not for points"
