"""NDT finds motions that are known by construction, and says how far it may be trusted."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapvote.core.geometry import exp, from_xyz_rpy, inverse, rotation_angle, transform
from mapvote.core.types import F64, Registration, Scan
from mapvote.localisation import ndt
from mapvote.localisation.ndt import NdtMap, PosePrior, best_of, build_ndt, likeliest, refine, thin_for_levels
from mapvote.localisation.prepare import deskew, twist_between
from streets import street, surface

T_TRUE = from_xyz_rpy(3.0, -1.0, 1.8, 0.01, -0.015, 0.3)


@pytest.fixture(scope="module")
def ndt_map() -> NdtMap:
    return build_ndt(street(1, 2.0))


@pytest.fixture(scope="module")
def scan() -> F64:
    return transform(inverse(T_TRUE), street(2))


def register(ndt_map: NdtMap, points: F64, guess: F64, **how: Any) -> Registration:
    return refine(ndt_map, thin_for_levels(points), guess, **how)


def errors(T: F64) -> tuple[float, float]:
    return float(np.linalg.norm(T[:3, 3] - T_TRUE[:3, 3])), float(np.degrees(rotation_angle(inverse(T_TRUE) @ T)))


@settings(max_examples=15, deadline=None)
@given(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7), st.floats(-0.2, 0.2), st.floats(-0.05, 0.05))
def test_a_known_motion_is_recovered(ndt_map: NdtMap, scan: F64, dx: float, dy: float, dz: float, yaw: float) -> None:
    guess = T_TRUE @ from_xyz_rpy(dx, dy, dz, 0.0, 0.0, yaw)
    result = register(ndt_map, scan, guess)
    shift, turn = errors(result.T_map_lidar)
    assert result.converged
    assert shift < 0.02
    assert turn < 0.05
    assert result.inlier_share > 0.9


def test_the_answer_does_not_depend_on_where_in_the_world_the_street_lies(scan: F64) -> None:
    offset = np.array([600_000.0, -5_600_000.0, 300.0])
    far = build_ndt(street(1, 2.0) + offset)
    guess = T_TRUE.copy()
    guess[:3, 3] += offset + np.array([0.3, 0.2, 0.0])
    result = register(far, scan, guess)
    result.T_map_lidar[:3, 3] -= offset
    assert errors(result.T_map_lidar)[0] < 0.02


def test_a_wrong_pose_shows_in_score_and_inliers(ndt_map: NdtMap, scan: F64) -> None:
    right = register(ndt_map, scan, T_TRUE)
    lost = register(ndt_map, scan, T_TRUE @ from_xyz_rpy(60.0, 40.0, 0.0, 0.0, 0.0, 1.0))
    assert lost.score < 0.5 * right.score
    assert lost.inlier_share < 0.5 * right.inlier_share


def test_no_overlap_at_all_is_an_answer_not_an_error(ndt_map: NdtMap, scan: F64) -> None:
    result = register(ndt_map, scan, T_TRUE @ from_xyz_rpy(1e6, 0.0, 0.0))
    assert result.inlier_share == 0.0
    assert result.score == 0.0
    assert np.isfinite(result.covariance).all()
    empty = register(ndt_map, np.zeros((0, 3)), T_TRUE)
    assert empty.inlier_share == 0.0


def test_covariance_covers_the_error_over_many_scans(monkeypatch: pytest.MonkeyPatch) -> None:
    """Normalised squared errors average 6 when the covariance is right; a factor of 4 either way is accepted.

    The map of this test is exact, so the part of the covariance that stands for the map's own error is left out.
    """
    monkeypatch.setattr(ndt, "MAP_SIGMA_M", 0.0)
    monkeypatch.setattr(ndt, "MAP_SIGMA_RAD", 0.0)
    ndt_map = build_ndt(street(1, 2.0))
    squares = []
    for seed in range(10, 30):
        points = transform(inverse(T_TRUE), street(seed, 0.5))
        result = register(ndt_map, points, T_TRUE, first_level=1)
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
    result = register(bare, points, from_xyz_rpy(0.0, 0.0, 1.9))
    assert abs(result.T_map_lidar[2, 3] - 1.8) < 0.02
    sigma = np.sqrt(np.diag(result.covariance))
    assert sigma[0] > 3 * sigma[2]


def test_a_precise_prior_decides_what_the_geometry_leaves_open() -> None:
    rng = np.random.default_rng(6)
    corridor = build_ndt(
        np.concatenate([surface(rng, 20_000, (-90, -6, 0), (90, 6, 0)), surface(rng, 20_000, (-90, 6, 0), (90, 6, 8))]),
    )
    points = np.concatenate(
        [surface(rng, 6_000, (-40, -6, -1.8), (40, 6, -1.8)), surface(rng, 6_000, (-40, 6, -1.8), (40, 6, 6.2))]
    )
    prior = PosePrior(from_xyz_rpy(0.5, 0.0, 1.8), 0.02, np.radians(0.05))
    guess = from_xyz_rpy(0.0, 0.1, 1.7)
    held = register(corridor, points, guess, prior=prior)
    np.testing.assert_allclose(held.T_map_lidar[:3, 3], [0.5, 0.0, 1.8], atol=0.06)


@settings(max_examples=25, deadline=None)
@given(st.floats(-15, 15), st.floats(-3, 3), st.floats(-0.6, 0.6), st.integers(0, 2**31))
def test_deskew_undoes_the_motion_of_a_scan(speed: float, sideways: float, yaw_rate: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    still = rng.uniform(-50, 50, (200, 3))
    time_s = rng.uniform(-0.05, 0.05, 200).astype(np.float32)
    twist = np.array([speed, sideways, 0.1, 0.02, -0.03, yaw_rate])
    moments = zip(time_s.astype(np.float64), still, strict=True)
    seen = np.array([transform(inverse(exp(t * twist)), point[None])[0] for t, point in moments])
    points = deskew(Scan(0, seen.astype(np.float32), time_s), twist)
    np.testing.assert_allclose(points, still, atol=2e-3)
    np.testing.assert_allclose(twist_between(np.eye(4), exp(0.1 * twist), 0.1), twist, atol=1e-9)


def test_of_many_guesses_the_likeliest_come_first_and_the_best_of_them_is_refined(ndt_map: NdtMap, scan: F64) -> None:
    away = [8.0, -5.0, 0.4, 3.0, -12.0]
    guesses, clouds = [T_TRUE @ from_xyz_rpy(x, 0.5 * x, 0.0) for x in away], thin_for_levels(scan)
    assert likeliest(ndt_map, clouds[0], guesses, 2)[0] is guesses[2]
    assert len(likeliest(ndt_map, clouds[0], guesses, 9, points=50)) == len(guesses)
    assert errors(best_of(ndt_map, clouds, guesses, 3).T_map_lidar)[0] < 0.02
    lost = best_of(ndt_map, clouds, guesses[:2], 1)
    assert lost.score == register(ndt_map, scan, likeliest(ndt_map, clouds[0], guesses[:2], 1)[0]).score
