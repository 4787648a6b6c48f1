"""The kernels of NDT against the same formulas written plainly in numpy, in float64 and pair by pair."""

import itertools

import numpy as np
import pytest

from mapvote.core.geometry import exp, from_xyz_rpy, hat, inverse, log, transform
from mapvote.core.types import F64
from mapvote.localisation.ndt import LEVELS, NdtGrid, NdtMap, build_ndt, fitnesses, in_rows, thin_for_levels
from mapvote.localisation.ndt_solver import (
    CUTOFF_E,
    INLIER_E,
    Pairs,
    _move,
    _to_prior,
    inverse_of,
    linearise,
    pair_up,
    room_for,
    room_to_work,
)
from streets import street

T_TRUE = from_xyz_rpy(3.0, -1.0, 1.8, 0.01, -0.015, 0.3)
SIX = [(0, 0, 0), *(tuple(sign * np.eye(3, dtype=int)[axis]) for axis, sign in itertools.product(range(3), (1, -1)))]


@pytest.fixture(scope="module")
def ndt_map() -> NdtMap:
    return build_ndt(street(1, 2.0))


@pytest.fixture(scope="module")
def cloud() -> F64:
    return transform(inverse(T_TRUE), street(2))[::40]


def by_hand(grid: NdtGrid, points: F64, T: F64) -> tuple[F64, F64, F64, float, float]:
    """H, M, g, mean likelihood and share of inliers of Magnusson's Eqs. (6.9), (6.12) and (6.13), reweighted."""
    size, rows, lowest = grid.level.voxel_m, grid.window.rows, grid.window.lowest
    H, M, g, likelihood, inliers = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), 0.0, 0
    for point in points @ T[:3, :3].T:
        x = point + T[:3, 3]
        own, nearest, gi = np.floor(x / size).astype(int), np.inf, np.zeros(6)
        J = np.hstack([np.eye(3), -hat(point)])
        for way in SIX:
            at = own + way - lowest
            if (at < 0).any() or (at >= rows.shape).any() or rows[tuple(at)] < 0:
                continue
            cell = grid.voxels.cells[rows[tuple(at)]]
            if not cell[3:].any():
                continue
            C = np.array([[cell[3], cell[4], cell[5]], [cell[4], cell[6], cell[7]], [cell[5], cell[7], cell[8]]])
            u = x - ((own + way + 0.5) * size + cell[:3])
            e = u @ C @ u
            nearest = min(nearest, e)
            w = np.exp(-0.5 * e) if e <= CUTOFF_E else 0.0
            H += w * J.T @ C @ J
            gi += w * J.T @ C @ u
        g += gi
        M += np.outer(gi, gi)
        likelihood += np.exp(-0.5 * nearest) if nearest <= CUTOFF_E else 0.0
        inliers += nearest < INLIER_E
    return H, M, g, likelihood / len(points), inliers / len(points)


def compiled(grid: NdtGrid, points: F64, T: F64, pairs: Pairs) -> tuple[F64, F64, F64, float, float]:
    H, M, g = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 1))
    work = room_to_work()
    pair_up(in_rows(points), T, grid.window, grid.near, grid.voxels.cells, pairs, work.moved, work.partner)
    likelihood, inliers = linearise(in_rows(points), pairs, T, H, M, g, work.sums, work.R, work.d)
    return H, M, g[:, 0], likelihood, inliers


def unpaired(points: F64, T: F64) -> Pairs:
    pairs = room_for(len(points))
    pairs.home[:] = -(1 << 30)
    pairs.origin[:] = T[:3, 3]
    return pairs


@pytest.mark.parametrize("level", [0, 1, 2])
def test_one_step_sums_what_the_book_says(ndt_map: NdtMap, cloud: F64, level: int) -> None:
    T, points = T_TRUE @ from_xyz_rpy(0.1, -0.05, 0.02, 0.0, 0.0, 0.01), cloud.astype(np.float32).astype(np.float64)
    grid = ndt_map.levels[level]
    found, wanted = compiled(grid, points, T, unpaired(points, T)), by_hand(grid, points, T)
    for name, a, b in zip(
        ("H", "M", "g", "likelihood", "inliers"), map(np.asarray, found), map(np.asarray, wanted), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-5 * np.abs(b).max(), err_msg=name)
    assert fitnesses(ndt_map, in_rows(points), T[None], level)[0] == pytest.approx(wanted[3], rel=1e-4)


def test_a_scan_that_moved_is_paired_as_if_for_the_first_time(ndt_map: NdtMap, cloud: F64) -> None:
    grid, pairs = ndt_map.levels[2], unpaired(cloud, T_TRUE)
    for shift in (0.0, 0.01, 0.3, 5.0, 1e4, 0.0):
        T = T_TRUE @ from_xyz_rpy(shift, 0.5 * shift, 0.0, 0.0, 0.0, 0.001 * min(shift, 1.0))
        again, anew = compiled(grid, cloud, T, pairs), compiled(grid, cloud, T, unpaired(cloud, T))
        for a, b in zip(map(np.asarray, again), map(np.asarray, anew), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * max(1.0, float(np.abs(b).max())))


def test_the_inverse_of_six_by_six_is_numpys() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        A = rng.normal(size=(9, 6)) * [1, 1, 1, 30, 30, 30]
        inverse = np.empty((6, 6))
        inverse_of(A.T @ A, np.empty((6, 6)), inverse)
        np.testing.assert_allclose(inverse @ (A.T @ A), np.eye(6), atol=1e-6)


def test_each_level_gets_one_point_a_voxel_and_no_beam_is_left_out(cloud: F64) -> None:
    beams = np.repeat(np.arange(32.0), 3000).reshape(32, 3000).T.ravel()  # firing by firing
    turn = np.repeat(np.linspace(0.0, 2 * np.pi, 3000), 32)
    points = np.stack([20 * np.cos(turn), 20 * np.sin(turn), beams], axis=1)
    for few, level in zip(thin_for_levels(points), LEVELS, strict=True):
        assert len(np.unique(few[2])) == 32
        voxels = np.floor(few / np.float32(level.points_m))
        assert len(np.unique(voxels, axis=1).T) == few.shape[1]


def test_a_turn_is_the_same_by_rodrigues_and_by_the_exponential() -> None:
    for step in ([0.1, 0.2, 0.3, 0.02, -0.03, 0.5], [0.0, 0.0, 0.0, 1e-10, 0.0, 0.0], [1.0, 0.0, 0.0, 2.0, 1.0, 1.5]):
        T = T_TRUE.copy()
        _move(T, np.array(step).reshape(6, 1), *np.empty((3, 3, 3)))
        turned = exp(np.r_[0.0, 0.0, 0.0, step[3:]])[:3, :3] @ T_TRUE[:3, :3]
        np.testing.assert_allclose(T[:3, :3], turned, atol=1e-12)
        np.testing.assert_allclose(T[:3, 3] - T_TRUE[:3, 3], step[:3], atol=1e-12)
        between = np.eye(4)
        between[:3, :3] = T[:3, :3] @ T_TRUE[:3, :3].T
        back = np.empty((6, 1))
        _to_prior(T_TRUE, T, np.empty((3, 3)), back)  # the step from there to here
        np.testing.assert_allclose(back[:3, 0], step[:3], atol=1e-12)
        np.testing.assert_allclose(back[3:, 0], log(between)[3:], atol=1e-9)
