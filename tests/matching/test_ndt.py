"""NDT finds motions that are known by construction, and says how far it may be trusted. Its kernels, against the same
formulas written plainly in numpy, in float64 and pair by pair."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.geometry import exp, from_xyz_rpy, hat, inverse, log, rotation_angle, transform
from mapvote.core.types import F64, PosePrior
from mapvote.matching import ndt
from mapvote.matching.matcher import best_of, likeliest
from mapvote.matching.ndt import CUTOFF_E, INLIER_E, Room
from mapvote.matching.ndt_map import NDT_WINDOW, NdtMap, build_ndt
from mapvote.matching.ndt_voxels import NdtGrid
from mapvote.matching.prepare import in_rows, thin_for_levels
from streets import street, surface

T_TRUE = from_xyz_rpy(3.0, -1.0, 1.8, 0.01, -0.015, 0.3)
SIX = [(0, 0, 0), *(tuple(sign * np.eye(3, dtype=int)[axis]) for axis, sign in itertools.product(range(3), (1, -1)))]


@pytest.fixture(scope="module")
def ndt_map() -> NdtMap:
    return build_ndt(street(1, 2.0))


@pytest.fixture(scope="module")
def scan() -> F64:
    return transform(inverse(T_TRUE), street(2))


def errors(T: F64) -> tuple[float, float]:
    return float(np.linalg.norm(T[:3, 3] - T_TRUE[:3, 3])), float(np.degrees(rotation_angle(inverse(T_TRUE) @ T)))


@settings(max_examples=15, deadline=None)
@given(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7), st.floats(-0.2, 0.2), st.floats(-0.05, 0.05))
def test_a_known_motion_is_recovered(ndt_map: NdtMap, scan: F64, dx: float, dy: float, dz: float, yaw: float) -> None:
    guess = T_TRUE @ from_xyz_rpy(dx, dy, dz, 0.0, 0.0, yaw)
    result = ndt_map.refine(thin_for_levels(scan), guess)
    shift, turn = errors(result.T_map_lidar)
    assert result.converged
    assert shift < 0.02
    assert turn < 0.05
    assert result.inlier_share > 0.9


def test_the_answer_does_not_depend_on_where_in_the_world_the_street_lies(scan: F64) -> None:
    offset = np.array([600_000.0, -5_600_000.0, 300.0])
    guess = T_TRUE.copy()
    guess[:3, 3] += offset + np.array([0.3, 0.2, 0.0])
    result = build_ndt(street(1, 2.0) + offset).refine(thin_for_levels(scan), guess)
    result.T_map_lidar[:3, 3] -= offset
    assert errors(result.T_map_lidar)[0] < 0.02


def test_a_wrong_pose_shows_in_score_and_inliers_and_no_overlap_at_all_is_no_error(ndt_map: NdtMap, scan: F64) -> None:
    clouds = thin_for_levels(scan)
    right = ndt_map.refine(clouds, T_TRUE)
    lost = ndt_map.refine(clouds, T_TRUE @ from_xyz_rpy(60.0, 40.0, 0.0, 0.0, 0.0, 1.0))
    assert lost.score < 0.5 * right.score
    assert lost.inlier_share < 0.5 * right.inlier_share
    off, empty = thin_for_levels(scan), thin_for_levels(np.zeros((0, 3)))
    for nowhere in (ndt_map.refine(off, T_TRUE @ from_xyz_rpy(1e6, 0, 0)), ndt_map.refine(empty, T_TRUE)):
        assert nowhere.inlier_share == nowhere.score == 0.0
        assert np.isfinite(nowhere.covariance).all()


def test_covariance_covers_the_error_over_many_scans() -> None:
    """Normalised squared errors average 6 when the covariance is right; a factor of 4 either way is accepted.

    The map of this test is exact, so the part of the covariance that stands for the map's own error is left out.
    """
    ndt_map = NdtMap(np.zeros(3), numbers=replace(NDT_WINDOW, map_sigma_m=0.0, map_sigma_deg=0.0))
    ndt_map.enter(street(1, 2.0))
    squares = []
    for seed in range(10, 30):
        points = transform(inverse(T_TRUE), street(seed, 0.5))
        result = ndt_map.refine(thin_for_levels(points), T_TRUE, first_level=1)
        R = result.T_map_lidar[:3, :3] @ T_TRUE[:3, :3].T
        turn = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        error = np.concatenate([result.T_map_lidar[:3, 3] - T_TRUE[:3, 3], turn])
        squares.append(error @ np.linalg.solve(result.covariance, error))
        np.testing.assert_allclose(result.covariance, result.covariance.T, atol=1e-12)
    assert 6 / 4 < np.mean(squares) < 6 * 4


def test_a_road_without_houses_does_not_know_where_along_it_one_is() -> None:
    rng = np.random.default_rng(5)
    bare = build_ndt(surface(rng, 30_000, (-60, -8, 0), (60, 8, 0)))
    points = surface(rng, 8_000, (-40, -7, -1.8), (40, 7, -1.8))
    result = bare.refine(thin_for_levels(points), from_xyz_rpy(0.0, 0.0, 1.9))
    assert abs(result.T_map_lidar[2, 3] - 1.8) < 0.02
    sigma = np.sqrt(np.diag(result.covariance))
    assert sigma[0] > 3 * sigma[2]


def test_a_precise_prior_decides_what_the_geometry_leaves_open() -> None:
    rng = np.random.default_rng(6)
    corridor = [surface(rng, 20_000, (-90, -6, 0), (90, 6, 0)), surface(rng, 20_000, (-90, 6, 0), (90, 6, 8))]
    seen = [surface(rng, 6_000, (-40, -6, -1.8), (40, 6, -1.8)), surface(rng, 6_000, (-40, 6, -1.8), (40, 6, 6.2))]
    prior = PosePrior(from_xyz_rpy(0.5, 0.0, 1.8), 0.02, np.radians(0.05))
    clouds = thin_for_levels(np.concatenate(seen))
    held = build_ndt(np.concatenate(corridor)).refine(clouds, from_xyz_rpy(0.0, 0.1, 1.7), prior)
    np.testing.assert_allclose(held.T_map_lidar[:3, 3], [0.5, 0.0, 1.8], atol=0.06)


def test_the_likeliest_guesses_come_first_and_the_best_of_them_is_refined(ndt_map: NdtMap, scan: F64) -> None:
    away = [8.0, -5.0, 0.4, 3.0, -12.0]
    guesses, clouds = [T_TRUE @ from_xyz_rpy(x, 0.5 * x, 0.0) for x in away], thin_for_levels(scan)
    assert likeliest(ndt_map, clouds[0], guesses, 2)[0] is guesses[2]
    assert len(likeliest(ndt_map, clouds[0], guesses, 9, points=50)) == len(guesses)
    assert errors(best_of(ndt_map, clouds, guesses, 3).T_map_lidar)[0] < 0.02
    lost = best_of(ndt_map, clouds, guesses[:2], 1)
    assert lost.score == ndt_map.refine(clouds, likeliest(ndt_map, clouds[0], guesses[:2], 1)[0]).score


Sums = tuple[F64, F64, F64, float, float]


def by_hand(grid: NdtGrid, points: F64, T: F64) -> Sums:
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


def compiled(grid: NdtGrid, points: F64, T: F64, room: Room) -> Sums:
    H, M, g = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 1))
    ndt.pair_up(len(points), T, grid.window, grid.voxels.cells, room)
    likelihood, inliers = ndt.linearise(len(points), room, H, M, g)
    return H, M, g[:, 0], likelihood, inliers


def unpaired(grid: NdtGrid, points: F64, T: F64) -> Room:
    room = ndt.room_for(len(points))
    ndt.arrange(in_rows(points), T, grid.window, room)
    return room


def assert_equal(found: Sums, wanted: Sums, rtol: float, atol: float) -> None:
    for a, b in zip(map(np.asarray, found), map(np.asarray, wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=atol * max(1.0, float(np.abs(b).max())))


@pytest.mark.parametrize("level", [0, 1, 2])
def test_one_step_sums_what_the_book_says(ndt_map: NdtMap, scan: F64, level: int) -> None:
    T = T_TRUE @ from_xyz_rpy(0.1, -0.05, 0.02, 0.0, 0.0, 0.01)
    points, grid = scan[::40].astype(np.float32).astype(np.float64), ndt_map.levels[level]
    wanted = by_hand(grid, points, T)
    assert_equal(compiled(grid, points, T, unpaired(grid, points, T)), wanted, 1e-4, 2e-5)
    assert ndt_map.likelihood(in_rows(points), T[None], level)[0] == pytest.approx(wanted[3], rel=1e-4)


def test_a_scan_that_moved_is_paired_as_if_for_the_first_time(ndt_map: NdtMap, scan: F64) -> None:
    grid, points = ndt_map.levels[2], scan[::40]
    room = unpaired(grid, points, T_TRUE)
    for shift in (0.0, 0.01, 0.3, 5.0, 1e4, 0.0):
        T = T_TRUE @ from_xyz_rpy(shift, 0.5 * shift, 0.0, 0.0, 0.0, 0.001 * min(shift, 1.0))
        assert_equal(compiled(grid, points, T, room), compiled(grid, points, T, unpaired(grid, points, T)), 1e-3, 1e-4)


def test_the_inverse_of_six_by_six_is_numpys() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        A = rng.normal(size=(9, 6)) * [1, 1, 1, 30, 30, 30]
        found = np.empty((6, 6))
        ndt.inverse_of(A.T @ A, np.empty((6, 6)), found)
        np.testing.assert_allclose(found @ (A.T @ A), np.eye(6), atol=1e-6)


def test_a_turn_is_the_same_by_rodrigues_and_by_the_exponential() -> None:
    for step in ([0.1, 0.2, 0.3, 0.02, -0.03, 0.5], [0.0, 0.0, 0.0, 1e-10, 0.0, 0.0], [1.0, 0.0, 0.0, 2.0, 1.0, 1.5]):
        T = T_TRUE.copy()
        ndt._move(T, np.array(step).reshape(6, 1), *np.empty((3, 3, 3)))
        turned = exp(np.r_[0.0, 0.0, 0.0, step[3:]])[:3, :3] @ T_TRUE[:3, :3]
        np.testing.assert_allclose(T[:3, :3], turned, atol=1e-12)
        np.testing.assert_allclose(T[:3, 3] - T_TRUE[:3, 3], step[:3], atol=1e-12)
        between = np.eye(4)
        between[:3, :3] = T[:3, :3] @ T_TRUE[:3, :3].T
        back = np.empty((6, 1))
        ndt._to_prior(T_TRUE, T, np.empty((3, 3)), back)  # the step from there to here
        np.testing.assert_allclose(back[:3, 0], step[:3], atol=1e-12)
        np.testing.assert_allclose(back[3:, 0], log(between)[3:], atol=1e-9)
